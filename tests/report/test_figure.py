"""Figures of runs: what they choose, what is in the files, and which runs they refuse."""

from __future__ import annotations

import re
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness import regions
from ambiguous_wild.harness.result_file import artefact_hashes
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.io.palette import MASKED
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.report.figure_drawing import COLUMN, TEXT_HEIGHT, TEXT_WIDTH, fitted, write_figure
from ambiguous_wild.report.figure_rows import Box, RunsFigure, in_words, most_different_box, runs_figure
from tests.command_line import aw
from tests.harness.fake_runs import failed, save
from tests.report.board_runs import change_result, own_scene, write_run
from tests.shared import made_once
from tests.tiny_scene import HEIGHT, WIDTH

SPOT: Box = (40, 10, WIDTH // 4, HEIGHT // 4)  # where 3dgs is wrong in test_1
METHODS = ("3dgs", "mine", "refinesplat")
MASKS = {"iou": 0.5, "precision": 0.5, "recall": 0.5, "images": 6}


def spoil(run: Path, photo: str, box: Box) -> None:
    """Turn a part of a render to its negative, and measure it again."""
    path = run / "renders" / "test" / photo
    left, top, wide, high = box
    render = read_png_rgb(path)
    render[top : top + high, left : left + wide] = 255 - render[top : top + high, left : left + wide]
    write_png(path, render)
    scene = Path(re.search(r"path: (.*)", (run / "config.yaml").read_text())[1])  # type: ignore[index]

    def change(result: dict) -> None:
        for row in result["per_image"]:
            if row["name"] == photo:
                row["psnr"] = psnr(render, read_png_rgb(scene / "images" / photo))
        result |= artefact_hashes(run, result["per_image"])

    change_result(run, change)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of runs for each method; 3dgs is wrong in porch's test_1, mine has no run on yard."""

    def make(root: Path) -> None:
        for scene in (own_scene(root / "porch"), own_scene(root / "yard")):
            wrong = write_run(root / "3dgs", scene, "3dgs", noise=5.0)
            write_run(root / "refinesplat", scene, "refinesplat", noise=5.0, masks=MASKS)
            if scene.name == "porch":
                spoil(wrong, "test_1.png", SPOT)
                write_run(root / "mine", scene, "mine", noise=5.0)

    return made_once(tmp_path_factory, "figure-runs", make)


def of(runs: Path, *folders: str, labels: Sequence[str] = (), **asked: Any) -> RunsFigure:
    return runs_figure(read_runs(*(runs / name for name in folders or METHODS), labels=labels), **asked)


def test_photo_and_zoom_are_where_methods_differ_most(runs: Path) -> None:
    figure = of(runs, scenes=["porch"])
    assert figure.methods == METHODS
    assert [row.photo for row in figure.rows] == ["test_1.png", "test_0.png"]
    first = figure.rows[0]
    assert first.box == SPOT
    photo, wrong = read_png_rgb(runs / "porch/images/test_1.png"), first.pictures[1]
    assert np.array_equal(first.pictures[0], photo)
    assert first.texts == ("", *(f"{psnr(picture, photo):.2f} dB" for picture in first.pictures[1:]))
    left, top, wide, high = SPOT
    inside = psnr(wrong[top : top + high, left : left + wide], photo[top : top + high, left : left + wide])
    assert in_words(figure)[0].startswith(
        f"--photo test_1.png --crop 40,10,{wide},{high}, inside: 3dgs {inside:.2f} dB, mine "
    )


def test_distractors_in_test_photos_count_neither_for_the_figure_nor_for_its_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where 3dgs is wrong, the test photo's mask says that a distractor is."""
    monkeypatch.delattr(regions, "train_visibility")  # what only other regions need
    scene, keep = own_scene(tmp_path / "porch"), np.full((HEIGHT, WIDTH), 255, np.uint8)
    left, top, wide, high = SPOT
    keep[top : top + high, left : left + wide] = 0
    write_png(scene / "masks" / "test" / "test_1.png", keep)

    def mixed(result: dict) -> None:
        result["facts"]["test_photos"] = "every 8th photo tests"
        for row in result["per_image"]:
            row["psnr_valid"] = 31.5

    for method in METHODS:
        run = write_run(tmp_path / method, scene, method, noise=5.0)
        if method == "3dgs":
            spoil(run, "test_1.png", SPOT)
        change_result(run, mixed)
    figure = of(tmp_path, photos=["test_1.png"])
    (row,) = figure.rows
    assert row.texts == ("", *["31.50 dB"] * 3) and row.box != SPOT
    assert figure.notes == ("scene porch: dB over the pixels that the masks of test photos keep",)
    (row,) = of(tmp_path, photos=["test_1.png"], crops=[SPOT]).rows
    assert "inside" not in in_words(replace(figure, rows=(row,)))[0]  # no pixel there is measured


def test_the_box_is_that_of_an_exhaustive_search() -> None:
    rng = np.random.default_rng(3)
    errors = [rng.random((34, 41)).astype(np.float32) for _ in range(3)]
    left, top, wide, high = most_different_box(errors)
    assert (wide, high) == (10, 8)
    spread = {
        (x, y): np.ptp([error[y : y + high, x : x + wide].mean() for error in errors])
        for x in range(41 - wide + 1)
        for y in range(34 - high + 1)
    }
    assert spread[left, top] == pytest.approx(max(spread.values()))
    alone = most_different_box(errors[:1])  # where a single method is wrong
    assert most_different_box([errors[0], errors[0]]) == alone
    means = {at: errors[0][at[1] : at[1] + high, at[0] : at[0] + wide].mean() for at in spread}
    assert means[alone[:2]] == pytest.approx(max(means.values()))
    assert most_different_box(errors, 31)[0] == 31 and most_different_box(errors, 33)[2] == 8


def test_photos_and_crops_that_are_given(runs: Path) -> None:
    asked = {"scenes": ["porch"], "photos": ["test_0", "train_2.png"], "labels": ["3dgs=3DGS", "mine=Ours"]}
    figure = of(runs, **asked, crops=[(0.5, 0.25, 0.25, 0.5), None], errors=True)
    assert figure.methods == ("refinesplat", "3DGS", "Ours")
    test, train = figure.rows
    assert (test.photo, test.box) == ("test_0.png", (WIDTH // 2, HEIGHT // 4, WIDTH // 4, HEIGHT // 2))
    difference = np.abs(test.pictures[1].astype(float) - test.pictures[0]).mean(axis=2) / 255
    assert np.allclose(test.errors[0], difference, atol=1e-6) and len(test.errors) == 3
    assert (train.photo, train.box, train.errors) == ("train_2.png", None, ())
    assert train.texts == ("train photo", "25 % masked", "no mask", "no mask")
    photo, masked, untouched, _ = train.pictures
    quarter = HEIGHT // 4
    assert np.array_equal(untouched, photo) and np.array_equal(masked[quarter:], photo[quarter:])
    assert (
        np.abs(masked[:quarter] - np.array(MASKED, float))
        <= np.abs(photo[:quarter] - np.array(MASKED, float)) + 1
    ).all()
    one = of(runs, **asked, crops=[(3, 4, 20, 10)])
    assert [row.box for row in one.rows] == [(3, 4, 20, 10)] * 2


def test_scenes_are_groups_of_rows_and_need_every_method(runs: Path) -> None:
    figure = of(runs)
    assert {row.scene for row in figure.rows} == {"porch"}
    assert figure.notes == ("scene yard is left out: no run of mine",)
    pair = of(runs, "3dgs", "refinesplat", masks=True)
    wanted = [(scene, masks) for scene in ("porch", "yard") for masks in (False, False, True, True)]
    assert [(row.scene, row.masks) for row in pair.rows] == wanted and pair.notes == ()
    lines = in_words(pair)
    assert all(line.startswith(f"{row.scene}: --photo {row.photo}") for line, row in zip(lines, pair.rows))
    with pytest.raises(AwError, match=r"of every method \(porch: mine; yard: 3dgs\): give runs of one scene"):
        of(runs, "mine/porch", "3dgs/yard")
    assert of(runs, "3dgs", scenes=["yard"], masks=True).notes == ("scene yard: no method has masks",)


def test_a_method_whose_runs_failed_is_named(runs: Path, tmp_path: Path) -> None:
    save(tmp_path, failed("robustsplat", "porch"))
    labels = ["robustsplat=Robust", "3dgs=3DGS"]
    figure = runs_figure(read_runs(runs / "3dgs", tmp_path, labels=labels))
    assert figure.methods == ("3DGS",) and figure.notes == ("Robust is left out: it has no finished run",)
    with pytest.raises(AwError, match="no finished run to show"):
        runs_figure(read_runs(tmp_path))


def test_all_methods_show_the_same_seed(runs: Path, tmp_path: Path) -> None:
    mine = write_run(tmp_path, runs / "porch", "mine", seed=1, noise=20.0)
    with_both = read_runs(runs / "3dgs/porch", tmp_path)
    (seed,) = {note for note in runs_figure(with_both).notes if "seed" in note}
    assert seed.endswith("no seed of which every method has a finished run; shown: 3dgs 0, mine 1")
    other = write_run(tmp_path, runs / "porch", "3dgs", seed=1, noise=20.0)
    figure = runs_figure(read_runs(runs / "3dgs/porch", tmp_path))
    shown = read_png_rgb(other / "renders/test" / figure.rows[0].photo)
    assert np.array_equal(figure.rows[0].pictures[1], shown) and figure.notes == ()
    (mine / "metrics.json").write_text("{")
    notes = runs_figure(read_runs(tmp_path)).notes
    assert notes == ("mine is left out: it has no finished run",)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"photos": ["test_7"]}, "unknown photo 'test_7': did you mean"),
        ({"crops": [(60, 0, 5, 5)]}, r"--crop 60,0,5,5 does not lie inside photo test_1.png \(64 x 48 px\)"),
        ({"crops": [(-1, 0, 5, 5)]}, "does not lie inside"),
        ({"crops": [(0.9, 0, 0.2, 0.2)]}, "--crop 0.9,0,0.2,0.2 does not lie inside"),
        ({"crops": [(0, 0, 0, 0)]}, "does not lie inside"),
        ({"crops": [None] * 3, "photos": ["test_0"] * 2}, "--crop is given 3 times and --photo 2 times"),
    ],
)
def test_what_a_photo_does_not_have_is_refused(runs: Path, asked: dict, message: str) -> None:
    with pytest.raises(AwError, match=message):
        of(runs, scenes=["porch"], **asked)


def test_runs_whose_files_are_lost_or_changed_are_refused(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs / "refinesplat" / "porch", tmp_path / "copy")
    (run,) = (tmp_path / "copy").glob("*/seed0")

    def refused(words: str) -> None:
        done = aw(
            "figure", runs / "3dgs/porch", tmp_path / "copy", "-o", tmp_path / "figure.pdf", "--with-masks"
        )
        assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr, done.stderr
        assert [path.name for path in tmp_path.iterdir() if path.is_file()] == []

    write_png(run / "masks/train_0.png", np.zeros((5, 5), np.uint8))
    refused("train_0.png has another size than its photo: restore it")
    write_png(run / "renders/test/test_0.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    refused("test_0.png is not the render that was measured")
    shutil.rmtree(run / "renders")
    refused("lacks its render renders/test/test_1.png: restore it")
    (run / "config.yaml").unlink()
    change_result(run, lambda result: result.update(scene_hash="a"))
    refused("scene 'porch' differs between these runs")


def test_a_png_holds_every_pixel_of_photo_and_renders(runs: Path, tmp_path: Path) -> None:
    figure = of(runs, scenes=["porch"], photos=["test_1"], crops=[None])
    wide, _ = write_figure(figure, tmp_path / "figure.png")
    assert wide == pytest.approx(TEXT_WIDTH, abs=0.02)
    drawn = read_png_rgb(tmp_path / "figure.png")
    cell = 9  # px of a pixel: the first whole number with which 64 of them are 300 dpi in 1.73 inches
    for picture in figure.rows[0].pictures:
        big = picture.repeat(cell, axis=0).repeat(cell, axis=1)
        row = big[0].tobytes()
        found = [(y, line.tobytes().find(row)) for y, line in enumerate(drawn) if row in line.tobytes()]
        y, x = found[0][0], found[0][1] // 3
        assert np.array_equal(drawn[y : y + big.shape[0], x : x + big.shape[1]], big)


def test_a_pdf_embeds_pictures_as_they_are_and_its_font(runs: Path, tmp_path: Path) -> None:
    figure = of(runs, scenes=["porch"], photos=["test_1"], labels=["mine=Ours $x_1"])
    write_figure(figure, tmp_path / "figure.pdf", width=3.3)
    data = (tmp_path / "figure.pdf").read_bytes()
    streams = [
        zlib.decompress(part) for part in re.findall(rb"stream\r?\n(x.*?)\r?\nendstream", data, re.DOTALL)
    ]
    sizes = re.findall(rb"/Width (\d+)", data), re.findall(rb"/Height (\d+)", data)
    shapes = sorted(zip(map(int, sizes[0]), map(int, sizes[1])))
    assert shapes == [(WIDTH // 4, HEIGHT // 4)] * 4 + [(WIDTH, HEIGHT)] * 4
    assert b"/Interpolate true" not in data
    assert b"/FontFile2" in data and b"/ToUnicode" in data and b"/Type3" not in data and b"Date" not in data
    assert sum(stream.count(b"BT\n") for stream in streams) == 4 + 3  # texts: heads, PSNR


@pytest.mark.parametrize("suffix", [".pdf", ".png", ".svg"])
def test_the_same_figure_is_the_same_file(runs: Path, tmp_path: Path, suffix: str) -> None:
    figure = of(runs, scenes=["porch"], errors=True, masks=True)
    for name in "ab":
        write_figure(figure, tmp_path / (name + suffix))
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"a{suffix}", f"b{suffix}"]
    if suffix == ".svg":
        text = (tmp_path / "a.svg").read_text()
        assert text.count("image-rendering:pixelated") == text.count("<image") > 0 and "<!-- mine -->" in text


def test_a_figure_fits_its_page(runs: Path, tmp_path: Path) -> None:
    pair = of(runs, "3dgs", "mine", scenes=["porch"], photos=["test_0"])

    def size(figure: RunsFigure, width: float | None = None) -> tuple[float, float]:
        return write_figure(figure, tmp_path / "figure.pdf", width=width)

    assert size(pair)[0] == pytest.approx(COLUMN, abs=0.02)
    assert size(pair, 5.5)[0] == pytest.approx(5.5, abs=0.02)
    many = replace(pair, rows=pair.rows * 5)
    assert len(fitted(many).rows) == 4 and len(fitted(many, 7.0).rows) == 2
    wide, high = size(many, 7.0)
    assert wide < 5.0 and high <= TEXT_HEIGHT + 0.01
    assert (
        len(fitted(replace(many, rows=tuple(replace(r, scene=str(k)) for k, r in enumerate(many.rows)))).rows)
        == 5
    )
    assert size(replace(pair, methods=("m" * 60, "a method-of long words")))[1] > size(pair)[1]


def test_the_command_says_what_it_shows(runs: Path, tmp_path: Path) -> None:
    words = ("figure", runs / "3dgs", runs / "refinesplat", "-o", tmp_path / "figure.svg", "--only", "porch")
    done = aw(*words, "--label", "refinesplat=Ours", "--with-errors", "--with-masks")
    assert done.returncode == 0 and done.stdout == "", done.stderr
    first, *_, last = done.stderr.splitlines()
    assert first.startswith("--photo test_1.png --crop 40,10,16,12, inside: 3dgs ") and ", Ours " in first
    assert f"wrote {tmp_path / 'figure.svg'}: " in last and "2 methods" in last
    assert "<!-- Ours -->" in (tmp_path / "figure.svg").read_text()
    again = aw(*words, *first.split(", inside")[0].split())
    assert again.returncode == 0 and again.stderr.splitlines()[0].startswith(first.split(", inside")[0])
