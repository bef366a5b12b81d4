import dataclasses
import sqlite3

import numpy as np
import pytest

from ambiguous_wild.builder.report import _parallax_warnings, parallax_deg
from ambiguous_wild.builder.select_model import (
    PairFacts,
    check_registered,
    choose_model,
    lost_photos,
)
from ambiguous_wild.core import AwError
from tests.io.model_maker import make_model, write_binary

FACTS = PairFacts(
    features=1500, tried=45, verified=30, inliers=60, degenerate=0.2, forward=0.3, angle_deg=8.0
)


def listing(*images):
    return [
        {"model": i, "images": n, "points": 10 * n, "error_px": 0.5, "track_length": 3.0}
        for i, n in enumerate(images)
    ]


def test_the_largest_model_is_taken_wherever_it_stands(tmp_path):
    for i, names in enumerate((["a.jpg", "b.jpg"], ["c.jpg", "d.jpg", "e.jpg"], ["f.jpg"])):
        write_binary(tmp_path / str(i), make_model(names))
    number, model = choose_model(tmp_path, listing(2, 3, 1))
    assert number == 1
    assert sorted(i.name for i in model.images.values()) == ["c.jpg", "d.jpg", "e.jpg"]
    tie = listing(3, 3, 1)
    tie[0]["points"], tie[1]["points"] = 5, 9
    assert choose_model(tmp_path, tie)[0] == 1


@pytest.fixture
def database(tmp_path):
    path = tmp_path / "database.db"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        db.execute("CREATE TABLE keypoints (image_id INTEGER, rows INTEGER)")
        db.execute("CREATE TABLE two_view_geometries (pair_id INTEGER, rows INTEGER, config INTEGER)")
        for i, name in enumerate(("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"), 1):
            db.execute("INSERT INTO images VALUES (?, ?)", (i, name))
        pairs = [(1, 2, 50), (2, 3, 20), (4, 5, 0)]  # a-b and b-c verified, d-e tried in vain
        rows = [(2147483647 * a + b, n, 2) for a, b, n in pairs]
        db.executemany("INSERT INTO two_view_geometries VALUES (?, ?, ?)", rows)
    db.close()
    return path


def test_each_lost_photo_gets_its_reason(database):
    facts = [{"work_name": f"{n}.jpg", "source": f"{n}.JPG"} for n in "abcde"]
    chosen, other = make_model(["a.jpg", "b.jpg"]), make_model(["e.jpg"])
    features = {"a.jpg": 900, "b.jpg": 900, "c.jpg": 900, "d.jpg": 900, "e.jpg": 900}
    lost = {p["source"]: p["reason"] for p in lost_photos(facts, chosen, {1: other}, database, features)}
    assert set(lost) == {"c.JPG", "d.JPG", "e.JPG"}
    assert "matches 1 photos of the scene" in lost["c.JPG"]
    assert "no matches" in lost["d.JPG"]
    assert "another model of 1 photos" in lost["e.JPG"]
    features["d.jpg"] = 12
    again = lost_photos(facts, chosen, {1: other}, database, features)
    assert next(p for p in again if p["source"] == "d.JPG")["reason"] == "only 12 features"


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


def test_enough_photos_pass_and_the_share_counts(tmp_path):
    check_registered(listing(3), 10, 0, tmp_path / "unused.db", {"pairs": 45})
    check_registered(listing(3), 3, 0, tmp_path / "unused.db", {"pairs": 3})
    import ambiguous_wild.builder.select_model as module

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "pair_facts", lambda *_: FACTS)
        with pytest.raises(AwError, match=r"placed 8 of 29 photos \(3 more in 1 other models\).*needs 9"):
            check_registered(listing(8, 3), 29, 0, tmp_path / "x.db", {"pairs": 45})
        with pytest.raises(AwError, match=r"placed 0 of 4 photos, 2 were left out.*needs 3"):
            check_registered([], 4, 2, tmp_path / "x.db", {"pairs": 6})


def test_photos_placed_without_points_are_no_scene(tmp_path):
    import ambiguous_wild.builder.select_model as module

    empty = [{"model": 0, "images": 4, "points": 0, "error_px": 0.0, "track_length": 0.0}]
    turned = dataclasses.replace(FACTS, verified=12, degenerate=1.0, angle_deg=0.3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "pair_facts", lambda *_: turned)
        with pytest.raises(
            AwError, match=r"placed 4 of 12 photos with 0 points.*needs 4 and 10 points.*only turned"
        ):
            check_registered(empty, 12, 0, tmp_path / "x.db", {"pairs": 66})
    empty[0]["points"] = 40
    check_registered(empty, 12, 0, tmp_path / "unused.db", {"pairs": 66})


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
