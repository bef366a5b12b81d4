"""What may stand on the board, what is refused, and files that are the same whatever the order."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.result_file import config_identity
from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.report.board import board_csv, guard, read_board, read_csv, unguard, unique_slug
from ambiguous_wild.report.board_edit import check
from tests.report.board_runs import add, aw, change_image, change_result, content, one_run, write_run
from tests.tiny_scene import write_tiny_scene as write_scene

HOSTILE = '=HYPERLINK("x")</script><img src=x onerror=alert(1)>/../../etc'


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("board")
    scene = write_scene(root / "wall")
    for method, seed in (("3dgs", 0), ("3dgs", 1), ("3dgs", 2), ("refinesplat", 0), (HOSTILE, 0)):
        write_run(root / "runs", scene, method, seed, noise=8.0 if method == "3dgs" else 5.0)
    return root / "runs"


@pytest.fixture
def one(tmp_path: Path) -> Path:
    return one_run(tmp_path)


def test_the_same_runs_in_any_order_give_the_same_bytes(runs: Path, tmp_path: Path) -> None:
    paths = sorted(p.parent for p in runs.rglob("metrics.json"))
    assert add(tmp_path / "a", runs).exit_code == 0
    for path in reversed(paths):
        assert add(tmp_path / "b", path).exit_code == 0
    first = content(tmp_path / "a")
    assert first == content(tmp_path / "b")
    assert sum(name.endswith(".jpg") for name in first) == 8  # two views: photo, three methods; lowest seed
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "a").rglob("*.csv")}
    again = add(tmp_path / "a", runs)
    assert "5 there already" in again.stderr and again.exit_code == 0
    assert content(tmp_path / "a") == first
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "a").rglob("*.csv")}


def test_values_are_those_of_the_run_and_tidy_says_the_same(runs: Path, tmp_path: Path) -> None:
    add(tmp_path, runs)
    entry = next(e for e in read_board(tmp_path) if e.method == "3dgs" and e.seed == 1)
    result = json.loads(next(runs.glob("*/*/seed1/metrics.json")).read_text())
    mean = sum(row["psnr"] for row in result["per_image"]) / 2
    assert entry.quality["psnr"] == pytest.approx(mean, abs=1e-12) and entry.checked == "photos"
    assert entry.missing == ("lpips_alex",) and entry.cost["train_s"] == result["cost"]["train_s"]
    assert entry.setting == "100 iterations" and "--seed 1" in entry.reproduce
    _, rows = read_csv(tmp_path / "measured" / "all.csv", ("method", "metric", "value"))
    tidy = {r["metric"]: r["value"] for r in rows if r["method"] == "3dgs" and r["seed"] == "1"}
    assert float(tidy["psnr"]) == entry.quality["psnr"] and tidy["lpips_alex"] == ""


def test_a_hostile_name_stays_text(runs: Path, tmp_path: Path) -> None:
    add(tmp_path / "board", runs)
    assert HOSTILE in {e.method for e in read_board(tmp_path / "board")}
    for path in (tmp_path / "board").rglob("*.csv"):
        for cell in (c for row in read_csv(path, ())[1] for c in row.values()):
            assert not cell.lstrip().startswith(("=", "+", "@", "-"))
    assert {p.name for p in tmp_path.iterdir()} == {"board"}
    assert all(set(p.name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-.") for p in tmp_path.rglob("*.jpg"))


def change_config(run: Path, change: Callable[[dict], None], *, hashed: bool) -> None:
    path = run / "config.yaml"
    data = yaml.safe_load(path.read_text())
    change(data)
    if hashed:  # a cheat who knows how
        data["config_hash"] = config_identity(data)
        change_result(run, lambda r: r.update(config_hash=data["config_hash"]))
    path.write_text(yaml.safe_dump(data))


def change_train(run: Path, *, hashed: bool, **values: int) -> None:
    change_config(run, lambda config: config["train"].update(values), hashed=hashed)


def add_effect(run: Path) -> None:
    change_config(run, lambda c: c.update(effects=["dense"]), hashed=True)
    change_result(run, lambda r: r["facts"].update(effects=["dense"]))


def repaint(run: Path) -> None:
    path = run / "renders" / "test" / "test_0.png"
    image = read_png_rgb(path)
    image[:4] = 0
    write_png(path, image)


def drop_image(run: Path) -> None:
    change_result(run, lambda r: r["per_image"].pop())
    (run / "renders" / "test" / "test_1.png").unlink()


def retouch_photo(run: Path) -> None:
    scene = Path(yaml.safe_load((run / "config.yaml").read_text())["scene"]["path"])
    shutil.copyfile(run / "renders" / "test" / "test_0.png", scene / "images" / "test_0.png")


def anonymous(run: Path) -> None:
    change_config(run, lambda c: c.update(method="mine"), hashed=True)
    change_result(run, lambda r: r.update(method="mine"))


def change_cost(run: Path, **cost: float | None) -> None:
    change_result(run, lambda r: r["cost"].update(cost))


FAILED = {"status": "failed", "error": "loss is not finite"}
SPOILT: dict[str, tuple[Callable[[Path], object], str]] = {
    "number": (lambda r: change_image(r, 1, psnr=lambda v: v + 0.01), "was changed: psnr of test_1.png"),
    "ssim": (lambda r: change_image(r, ssim=lambda v: v + 0.001), "was changed: ssim of test_0.png"),
    "value gone": (lambda r: change_image(r, 1, psnr=None), "no psnr of test_1.png"),
    "render": (repaint, "was changed: psnr of test_0.png"),
    "render gone": (lambda r: (r / "renders/test/test_0.png").unlink(), "is partial: it lacks renders"),
    "image unlisted": (lambda r: change_result(r, lambda d: d["per_image"].pop()), "test_1.png was rendered"),
    "image dropped": (drop_image, "is partial: 1 images were measured"),
    "render damaged": (lambda r: (r / "renders/test/test_0.png").write_bytes(b"x"), "test_0.png"),
    "model": (lambda r: (r / "point_cloud.ply").write_bytes(b"p"), "is not the model that was measured"),
    "no environment": (lambda r: (r / "env.json").unlink(), "it lacks env.json"),
    "config": (lambda r: change_train(r, hashed=False, iterations=9), "hashes to"),
    "seed": (lambda r: change_train(r, hashed=True, seed=4), "seed is '4'"),
    "no config": (lambda r: (r / "config.yaml").unlink(), "config.yaml is absent"),
    "code": (anonymous, "has no hash of it"),
    "photo": (retouch_photo, "name the right one with --scene"),
    "path": (lambda r: change_image(r, name="../../../../etc/passwd"), "outside of its folder"),
    "failed": (lambda r: change_result(r, lambda d: d.update(FAILED)), "a failed run has no numbers"),
    "unfinished": (lambda r: (r / "metrics.json").unlink(), "has no metrics.json"),
    "pace gone": (lambda r: change_cost(r, ms_per_iteration=None), "train_s but no ms_per_iteration"),
    "fps": (lambda r: change_cost(r, fps=9e9, fps_low=20, fps_high=2089), "of order: 20, 9000000000.0, 2089"),
    "no effects.json": (add_effect,
                        "partial: it lacks effects.json"),
    "not JSON": (lambda r: (r / "metrics.json").write_text("{"), "is damaged"),
}  # fmt: skip


@pytest.mark.parametrize("spoil,why", SPOILT.values(), ids=SPOILT)
def test_what_is_changed_partial_failed_or_foreign_is_refused(
    spoil: Callable[[Path], object], why: str, one: Path, tmp_path: Path
) -> None:
    spoil(one)
    done = add(tmp_path / "board", one)
    lines = done.stdout.splitlines()
    assert done.exit_code == 2 and len(lines) == 1 and lines[0].startswith("refused: ") and why in lines[0]
    assert not (tmp_path / "board").exists()


def test_a_scene_is_on_the_board_under_one_name(one: Path, tmp_path: Path) -> None:
    moved = shutil.copytree(tmp_path / "wall", tmp_path / "moved")
    done = add(tmp_path / "board", one, write_run(tmp_path / "other", moved))  # in the order of their paths
    assert done.exit_code == 2 and "scene 'wall' of dataset 'Tiny set' is 'moved' there" in done.stdout
    assert [e.scene for e in read_board(tmp_path / "board")] == ["moved"]
    assert "scene 'wall'" in add(tmp_path / "board", one).stdout
    assert add(tmp_path / "board", one, dataset="Other").exit_code == 0


def test_a_run_still_running_is_left_and_the_others_are_taken(one: Path, tmp_path: Path) -> None:
    other = one.parent / "seed1"
    other.mkdir()
    (other / "config.yaml").write_text("method: 3dgs\nscene: {name: wall}\n")
    done = add(tmp_path / "board", one.parent)
    assert done.exit_code == 0 and "1 added, 1 unfinished" in done.stderr
    assert len(read_board(tmp_path / "board")) == 1


def test_other_numbers_for_a_cell_need_replace(one: Path, tmp_path: Path) -> None:
    board = tmp_path / "board"
    worse = write_run(tmp_path / "more", tmp_path / "wall", noise=30.0)
    both = add(board, one, worse)  # neither wins by standing first
    assert both.exit_code == 2 and both.stdout.count("the same cell with different numbers") == 2
    assert not board.exists()
    add(board, one)
    before = content(board)
    refused = add(board, worse)
    assert refused.exit_code == 2 and "pass --overwrite" in refused.stdout and content(board) == before
    assert "1 replaced" in add(board, worse, "--overwrite", "--dry-run").stderr and content(board) == before
    assert "1 replaced" in add(board, worse, "--overwrite").stderr
    after = content(board)
    changed = {name for name in before if before[name] != after[name]}
    assert len(after) == len(before) and len(changed) == 5  # two tables, the index, two renders
    assert aw("check", "--board", board).exit_code == 0


def test_another_scene_of_the_same_name_is_refused(one: Path, tmp_path: Path) -> None:
    add(tmp_path / "board", one)
    scene = write_scene(tmp_path / "other" / "wall")
    names = (scene / "test_list.txt").read_text().split()
    (scene / "test_list.txt").write_text(names[0] + "\n")
    other = write_run(tmp_path / "more", scene, "refinesplat")
    done = add(tmp_path / "board", other)
    assert done.exit_code == 2 and "their numbers cannot be compared" in done.stdout


def test_an_edited_method_is_refused(tmp_path: Path) -> None:
    scene, board = write_scene(tmp_path / "wall"), tmp_path / "board"
    old = write_run(tmp_path / "runs", scene, "mine", 0)
    new = [write_run(tmp_path / "new", scene, "mine", seed, source="ab" * 32, noise=5.0) for seed in (0, 1)]
    both = add(board, old, new[1])  # neither wins by standing first
    assert both.stdout.count("the file of 'mine' differs") == 2 and not board.exists()
    add(board, old)
    for words in ((new[1],), (new[1], "--overwrite")):
        done = add(board, *words)
        assert done.exit_code == 2 and "differs from that of mine on wall with seed 0" in done.stdout
    assert add(board, *new, "--overwrite").exit_code == 0  # no run of the old file is left
    assert {e.source for e in read_board(board)} == {"ab" * 32} and check(board).problems == ()


def test_a_metric_of_another_function_is_refused(tmp_path: Path) -> None:
    scene, board = write_scene(tmp_path / "wall"), tmp_path / "board"

    def run(method: str, source: str) -> Path:
        record = {"label": "tint", "better": "lower", "digits": 2, "partial": False, "source": source * 64}

        def add_metric(result: dict) -> None:
            result["metrics"] = {"tint": record}
            for row in result["per_image"]:
                row["tint"] = 0.5

        folder = write_run(tmp_path / source / method, scene, method)
        change_result(folder, add_metric)
        return folder

    old, same, other = run("3dgs", "1"), run("refinesplat", "1"), run("refinesplat", "2")
    plain = write_run(tmp_path / "plain", scene, "robustsplat")
    assert add(board, plain).exit_code == 0
    both = add(board, old, other)  # neither wins, though the board has no such metric
    assert both.stdout.count("comes from another function") == 2
    assert add(board, old).exit_code == 0
    done = add(board, other)
    assert done.exit_code == 2 and "tint comes from another function than in 3dgs on wall" in done.stdout
    assert add(board, same).exit_code == 0 and check(board).problems == ()
    assert {e.metric_functions for e in read_board(board)} == {f"tint {'1' * 64} lower", ""}


def test_without_its_scene_a_run_is_marked_and_needs_a_dataset(one: Path, tmp_path: Path) -> None:
    board, moved = tmp_path / "board", tmp_path / "scenes" / "wall"
    moved.parent.mkdir()
    (tmp_path / "wall").rename(moved)
    blind = aw("add", one, "--board", board)
    assert blind.exit_code == 2 and "--dataset NAME" in blind.stdout
    add(board, one)
    assert [e.checked for e in read_board(board)] == ["files"]
    # The board knows the dataset now; with the scene the stronger check counts, and stays.
    assert aw("add", one, "--board", board, "--scene", moved.parent).exit_code == 0
    assert [e.checked for e in read_board(board)] == ["photos"]
    add(board, one)
    assert [e.checked for e in read_board(board)] == ["photos"]


def test_settings_and_options_are_cells_of_their_own(one: Path, tmp_path: Path) -> None:
    scene = tmp_path / "wall"
    named = write_run(tmp_path / "a", scene, effects=["exposure", "poses"])
    (named / "effects.json").write_text('{"asked": "exposure,poses"}')
    write_run(tmp_path / "b", scene, "mine", options={"x": 1})
    write_run(tmp_path / "c", scene, "mine", options={"x": 2})
    planned = write_run(tmp_path / "d", scene, effects=["dense"])
    (planned / "effects.json").write_text('{"asked": "auto"}')
    add(tmp_path / "board", one, tmp_path / "a", tmp_path / "b", tmp_path / "c", planned)
    entries = read_board(tmp_path / "board")
    assert "100 iterations, effects auto" in {e.setting for e in entries}
    assert len(entries) == 5 and len({e.options for e in entries if e.method == "mine"}) == 2
    assert "100 iterations, effects exposure+poses" in {e.setting for e in entries}


def test_a_metric_of_a_part_has_a_mean_where_some_pictures_lack_it(one: Path, tmp_path: Path) -> None:
    def newer(result: dict) -> None:
        result["code_hash"] = "ab" * 32
        result["per_image"][0]["psnr_covered"] = 12.5  # nothing is covered in the other picture

    change_result(one, newer)
    (tmp_path / "wall").rename(tmp_path / "elsewhere")  # at hand it would be computed again
    add(tmp_path / "board", one)
    (entry,) = read_board(tmp_path / "board")
    assert entry.code_hash == "ab" * 32 and entry.quality["psnr_covered"] == 12.5


def test_what_is_removed_was_never_there(runs: Path, tmp_path: Path) -> None:
    mine = [p.parent for p in runs.rglob("metrics.json") if json.loads(p.read_text())["method"] == "3dgs"]
    add(tmp_path / "few", *mine)
    add(tmp_path / "all", runs)
    before = content(tmp_path / "all")
    for method in ("refinesplat", HOSTILE):
        words = ("remove", "--board", tmp_path / "all", "--method", method)
        there = content(tmp_path / "all")
        assert "would remove" in aw(*words, "--dry-run").stdout and content(tmp_path / "all") == there
        assert "1 run;" in aw(*words).stderr
    assert content(tmp_path / "all") == content(tmp_path / "few") != before
    aw("remove", "--board", tmp_path / "all", "--method", "3dgs")
    assert read_board(tmp_path / "all") == [] and not list(tmp_path.glob("all/**/*.jpg"))
    assert aw("check", "--board", tmp_path / "all").exit_code == 0
    with pytest.raises(AwError, match="unknown method"):
        aw("remove", "--board", tmp_path / "few", "--method", "4dgs")


def test_check_finds_what_was_changed_by_hand(runs: Path, tmp_path: Path) -> None:
    add(tmp_path, runs)
    assert aw("check", "--board", tmp_path).exit_code == 0
    path = tmp_path / "measured" / "tiny-set.csv"
    good = path.read_text()
    path.write_text(good.replace("photos", "trust me", 1))
    assert "none of files, psnr, photos" in aw("check", "--board", tmp_path).stdout
    lines = good.splitlines(keepends=True)
    path.write_text("".join([*lines, lines[1]]))
    assert "is twice in" in aw("check", "--board", tmp_path).stdout
    cells = lines[1].split(",")
    copy = ",".join([*cells[:5], "7", *cells[6:]])  # seed 0 once more, as seed 7
    path.write_text("".join([*lines, copy]))
    found = aw("check", "--board", tmp_path)
    assert found.exit_code == 2
    for part in (
        "agree in all digits",
        "same configuration hash",
        "tiny-set.csv row 7 (3dgs on wall with seed 7 (100 iterations)) was changed by hand",
    ):
        assert part in found.stdout
    path.write_text(good)
    next(tmp_path.rglob("*.jpg")).write_bytes(b"x")
    assert "missing or changed" in aw("check", "--board", tmp_path).stdout


@settings(max_examples=60, deadline=None)
@given(st.lists(st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=12), min_size=1, max_size=4))
def test_guarded_cells_read_back_and_never_calculate(texts: list[str]) -> None:
    for text in [*texts, "=1+1", " =1", "'=1", "@x", "-5", "'"]:
        assert unguard(guard(text)) == text
        assert guard(text).lstrip()[:1] not in ("=", "+", "-", "@")
        assert "/" not in unique_slug(text) and ".." not in unique_slug(text)


def test_numbers_in_csv_stay_numbers(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(board_csv(["a", "b", "c", "d"], [[-0.5, 3.0, None, float("inf")]]))
    assert read_csv(tmp_path / "t.csv", ("a",))[1] == [{"a": "-0.5", "b": "3", "c": "", "d": "inf"}]


def test_the_board_of_this_checkout_passes_its_own_check() -> None:
    board = Path(__file__).resolve().parents[2] / "leaderboard"
    assert check(board).problems == ()
