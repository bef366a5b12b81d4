"""Simulated captures of suites: what identifies one, and what is said of one that is not whole or another."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from ambiguous_wild.cli.datasets import verify_command
from ambiguous_wild.core import AwError
from ambiguous_wild.datasets import capture_hashes
from ambiguous_wild.datasets.capture_hashes import (
    CAPTURES,
    capture_hash,
    check_capture,
    list_lines,
    listed_hashes,
    suite_of_captures,
    verify_captures,
)
from ambiguous_wild.datasets.suites import Simulated, Suite, get_suite, simulated_dataset, simulated_suites
from ambiguous_wild.simulate.capture_writer import simulate
from ambiguous_wild.simulate.presets import PRESETS, preset, resized

WIDTH = 64
TOY = Suite("toy", "toy", {"all": ["tiny"]}, {}, 1, 5, "full", "CC0-1.0", simulated=Simulated(WIDTH, 5))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture, to be copied."""
    out = tmp_path_factory.mktemp("toy") / "tiny"
    simulate(replace(resized(preset("tiny"), 3, WIDTH), detail_px_per_m=5.0), out, seed=5)
    return out


@pytest.fixture
def capture(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / CAPTURES / "tiny")


def change_json(path: Path, change) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_the_hash_is_of_pixels_and_not_of_files(made: Path, capture: Path) -> None:
    for path in capture.rglob("*.png"):
        before = path.read_bytes()
        Image.open(path).save(path, compress_level=9)
        assert path.read_bytes() != before
    (capture / "truth" / "sheet.jpg").write_bytes(b"a preview")
    change_json(
        capture / "truth" / "cameras.json",
        lambda c: c["IMG_0001.jpg"].update(fx=c["IMG_0001.jpg"]["fx"] + 1e-12),
    )
    assert capture_hash(capture) == capture_hash(made)


@pytest.mark.parametrize("what", ["pixel", "name", "absent", "camera", "pose"])
def test_every_change_of_a_capture_changes_its_hash(what: str, made: Path, capture: Path) -> None:
    mask = capture / "truth" / "distractor" / "IMG_0002.png"
    cameras = capture / "truth" / "cameras.json"
    if what == "pixel":
        pixels = np.array(Image.open(mask))
        pixels[3, 7] ^= 255
        Image.fromarray(pixels).save(mask)
    elif what == "name":
        mask.rename(mask.with_stem("IMG_0009"))
    elif what == "absent":
        mask.unlink()
    elif what == "camera":
        change_json(cameras, lambda c: c["IMG_0001.jpg"].update(fx=c["IMG_0001.jpg"]["fx"] + 1e-6))
    else:
        change_json(cameras, lambda c: c["IMG_0101.jpg"]["cam_from_world"][0].__setitem__(3, 0.5))
    assert capture_hash(capture) != capture_hash(made)


def test_the_size_of_an_image_counts(capture: Path) -> None:
    """Of a mask of one value, the pixels alone would not tell."""
    mask = capture / "truth" / "distractor" / "IMG_0002.png"
    found = set()
    for size in ((4, 6), (6, 4), (24, 1)):
        Image.new("L", size).save(mask)
        found.add(capture_hash(capture))
    assert len(found) == 3


def test_a_capture_is_compared_with_the_list(
    made: Path, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unlisted = check_capture(capture, "tiny", TOY)
    assert unlisted.listed == "" and not unlisted.differs and unlisted.sha256 == capture_hash(made)
    assert list_lines([unlisted, replace(unlisted, name="other")]) == [
        "no hash is listed for tiny, other: whether all have the same is unknown"
    ]
    listed = {str(WIDTH): {"tiny": unlisted.sha256}}
    monkeypatch.setattr(capture_hashes, "listed_hashes", lambda: listed)
    assert list_lines([check_capture(capture, "tiny", TOY)]) == []
    listed[str(WIDTH)]["tiny"] = "0" * 64
    other = check_capture(capture, "tiny", TOY)
    assert other.differs
    (line,) = list_lines([other])
    assert (
        line.startswith("warning: tiny: pixels or cameras differ") and "not comparable with the board" in line
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda c: (c / "train" / "IMG_0001.jpg").write_bytes(b"short"),
            r"is damaged \(1 file absent or changed",
        ),
        (
            lambda c: (c / "test" / "IMG_0101.jpg").unlink(),
            "test/IMG_0101.jpg.*'aw fetch toy' makes it again",
        ),
        (lambda c: (c / "truth" / "capture.json").unlink(), "no whole capture of 'aw simulate'"),
        (lambda c: (c / "truth" / "capture.json").write_text("{"), "no whole capture"),
        (lambda c: change_json(c / "truth" / "capture.json", lambda f: f.update(seed=0)), "seed 0, not 5"),
        (
            lambda c: change_json(c / "truth" / "capture.json", lambda f: f["spec"].update(width=99)),
            "width 99, not 64",
        ),
    ],
)
def test_a_capture_that_is_not_whole_is_refused_in_one_line(spoil, message: str, capture: Path) -> None:
    spoil(capture)
    with pytest.raises(AwError, match=message) as error:
        check_capture(capture, "tiny", TOY)
    assert "\n" not in str(error.value)


def test_a_folder_of_captures_is_verified_whole(capture: Path, tmp_path: Path) -> None:
    suite = replace(TOY, tables={"all": ["tiny", "absent", "damaged"]})
    (capture.parent / "damaged").mkdir()
    found = verify_captures(tmp_path, suite)
    assert [c.name for c in found.checked] == ["tiny"] and found.absent == ("absent",)
    assert len(found.damaged) == 1 and "damaged" in found.damaged[0]
    assert suite_of_captures(tmp_path) is None  # no suite has such small photos
    change_json(capture / "truth" / "capture.json", lambda f: f["spec"].update(width=480))
    assert suite_of_captures(tmp_path) == get_suite("aw-sim")


@pytest.mark.parametrize("whole", [False, True])
def test_a_width_that_is_no_number_is_one_line(whole: bool, capture: Path, tmp_path: Path) -> None:
    """With a whole capture beside it the folder is that of a suite, alone of none."""
    if whole:
        other = shutil.copytree(capture, capture.with_name("greys"))
        change_json(other / "truth" / "capture.json", lambda f: f["spec"].update(width=480))
    spoilt = capture.rename(capture.with_name("coats"))
    change_json(spoilt / "truth" / "capture.json", lambda f: f["spec"].update(width=[480]))
    done = CliRunner().invoke(verify_command, [str(tmp_path)])
    assert isinstance(done.exception, AwError) and done.exception.exit_code == 2, done.output
    assert "\n" not in str(done.exception) and str(tmp_path) in str(done.exception)
    if whole:
        damaged = verify_captures(tmp_path, get_suite("aw-sim")).damaged
        assert "width [480], not 480" in damaged[0] and "\n" not in damaged[0]


def test_the_list_has_hashes_of_captures_of_suites_alone() -> None:
    for width, hashes in listed_hashes().items():
        made = [s for s in simulated_suites().values() if s.simulated and str(s.simulated.width) == width]
        assert hashes.keys() <= {scene for suite in made for scene in suite.scenes}
        assert all(len(digest) == 64 and int(digest, 16) for digest in hashes.values())
        assert len(set(hashes.values())) == len(hashes)
    assert listed_hashes()["480"].keys() == set(get_suite("aw-sim").scenes)  # what everybody is compared with


def test_suites_of_one_dataset_compare() -> None:
    full, mini, large = (get_suite(name) for name in ("aw-sim", "aw-sim-mini", "aw-sim-large"))
    same = ("dataset", "simulated", "factor", "iterations", "protocol", "license")
    assert [getattr(mini, key) for key in same] == [getattr(full, key) for key in same]
    assert all(set(scenes) <= set(full.tables[kind]) for kind, scenes in mini.tables.items())
    assert large.tables == full.tables and large.dataset != full.dataset
    assert len(full.scenes) == sum(map(len, full.tables.values())) == 19
    assert set(full.scenes) <= PRESETS.keys()
    assert {suite.license for suite in simulated_suites().values()} == {"CC0-1.0"}


def test_the_dataset_of_a_scene_is_told_by_its_capture() -> None:
    capture = {"preset": "coats", "seed": 5, "spec": {"width": 480}}
    assert simulated_dataset(capture, 2) == "aw-sim"
    assert simulated_dataset({**capture, "spec": {"width": 960}}, 2) == "aw-sim-large"
    for other in ({**capture, "seed": 0}, {**capture, "preset": "tiny"}, {}):
        assert simulated_dataset(other, 2) is None
    assert simulated_dataset(capture, 1) is None
