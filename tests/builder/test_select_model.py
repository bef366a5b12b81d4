import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest

from ambiguous_wild.builder import diagnosis
from ambiguous_wild.builder.diagnosis import PairFacts, check_registered
from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.builder.scene_record import _lost_photos, _parallax_warnings, parallax_deg, part_lines
from ambiguous_wild.core import AwError
from tests.io.model_maker import make_model

FACTS = PairFacts(
    features=1500, tried=45, verified=30, inliers=60, degenerate=0.2, forward=0.3, angle_deg=8.0
)


def summary(images, points=None):
    return {"images": images, "points": 10 * images if points is None else points}


def test_each_lost_photo_gets_its_reason():
    photos = [ScreenedPhoto(f"{n}.JPG", f"{n}.jpg") for n in "abc"]
    features = {"a.jpg": 900, "b.jpg": 12, "c.jpg": 900}
    left_out = {"b.jpg": "no registered photo agrees", "c.jpg": "two poses"}
    assert _lost_photos(photos, left_out, features) == [
        {"source": "b.JPG", "reason": "only 12 features"},
        {"source": "c.JPG", "reason": "two poses"},
    ]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"features": 80}, "too little texture"),
        ({"verified": 5}, "overlap too little"),
        ({"forward": 0.97}, "straight ahead"),
        ({"degenerate": 0.95}, "flat scene"),
        ({"angle_deg": 0.5}, "flat scene"),
        ({}, "do not chain"),
    ],
)
def test_the_reason_follows_the_figures(change, reason):
    assert reason in dataclasses.replace(FACTS, **change).reason(10)


TURNED = dataclasses.replace(FACTS, verified=12, degenerate=1.0, angle_deg=0.3)


@pytest.mark.parametrize(
    ("model", "photos", "skipped", "part", "facts", "message"),
    [
        (summary(3), 10, 0, 1, FACTS, None),
        (summary(3), 3, 0, 1, FACTS, None),
        (summary(8), 29, 0, 1, FACTS, r"registered 8 of 29 photos;.*needs 9"),
        (None, 4, 2, 1, FACTS, r"registered 0 of 4 photos, 2 were left out.*needs 3"),
        (
            summary(4, 0),
            12,
            0,
            1,
            TURNED,
            r"registered 4 of 12 photos with 0 points.*needs 4 and 10.*turned",
        ),
        (summary(4, 40), 12, 0, 1, TURNED, None),
        (summary(4, 400), 40, 0, 2, FACTS, None),  # the user asked for a small part
        (
            summary(4, 400),
            40,
            0,
            1,
            FACTS,
            "registered 4 of 40 photos",
        ),  # the first part is most of the place
    ],
)
def test_enough_photos_and_points_pass(tmp_path, monkeypatch, model, photos, skipped, part, facts, message):
    monkeypatch.setattr(diagnosis, "pair_facts", lambda *_: facts)
    with nullcontext() if message is None else pytest.raises(AwError, match=message):
        check_registered(model, photos, skipped, tmp_path / "x.db", {}, part)


def test_parallax_is_the_angle_under_which_points_are_seen():
    names = [f"{k}.jpg" for k in range(8)]
    model = make_model(names, points=300)
    # cameras 0.7 apart at the most, points 4 to 6 away
    expected = []
    centres = {i.image_id: -i.tvec for i in model.images.values()}
    for k in range(300):
        ids = model.points.track_image_ids[slice(*model.points.track_offsets[k : k + 2])]
        rays = [centres[int(i)] - model.points.xyz[k] for i in ids]
        units = [r / np.linalg.norm(r) for r in rays]
        expected.append(max(np.degrees(np.arccos(min(float(units[0] @ u), 1.0))) for u in units))
    assert parallax_deg(model) == pytest.approx(float(np.median(expected)), abs=1e-6)
    assert 3.0 < parallax_deg(model) < 9.0
    still = make_model(names, points=300)
    for image in still.images.values():
        image.tvec[:] *= 1e-3
    assert parallax_deg(still) < 0.01
    assert _parallax_warnings(model) == [] and "hardly moved" in _parallax_warnings(still)[0]
    assert (
        np.isnan(parallax_deg(make_model(names, points=0)))
        and _parallax_warnings(make_model(names, points=0)) == []
    )


def test_parts_are_named_with_the_option_that_builds_another():
    sources = {name: f"{name}.jpg" for name in "abcdefg"}
    line = part_lines([list("abcd"), list("efg")], sources, 1)[0]
    assert "2 parts" in line and "part 1 of 4 (a.jpg" in line and "part 2 of 3 (e.jpg" in line
    assert "--part 2 builds part 2" in line
    assert "--part 1 builds part 1" in part_lines([list("abcd"), list("efg")], sources, 2)[0]
    assert part_lines([list("abcd")], sources, 1) == []
