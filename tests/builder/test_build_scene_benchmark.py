"""benchmarks/build_scene.py: the other checkout and its commit, missing values in the table."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.benchmark_scripts import benchmark

# of another checkout: `aw` that builds nothing and tells what it was called with
OTHER = """
import json, os, pathlib, sys
scene = pathlib.Path(sys.argv[sys.argv.index("-o") + 1])
scene.mkdir(parents=True)
(scene / "scene.json").write_text(json.dumps(json.loads({facts!r}) | {{"path": os.environ["PYTHONPATH"]}}))
"""


def facts(way: str, chosen: str) -> dict:
    return {
        "chosen": {"sfm": chosen}, "seconds": {"features": 2.0, "matches": 1.0, "mapping": 1.0},
        "counts": {"photos": 9, "registered": 9, "pairs": 36, "points": 500}, "reprojection_error_px": 0.4,
        "way": way,
    }  # fmt: skip


@pytest.fixture
def build_scene():
    with benchmark("build_scene") as module:
        yield module


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Another checkout with a commit."""
    package = tmp_path / "other" / "ambiguous_wild"
    (package / "cli").mkdir(parents=True)
    (package / "__init__.py").write_text('__version__ = "0.0.9"\n')
    (package / "cli" / "__init__.py").write_text("")
    (package / "cli" / "main.py").write_text(OTHER.format(facts=json.dumps(facts("thorough", "thorough"))))
    if shutil.which("git") is None:
        pytest.skip("needs git")
    who = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    for words in (["init", "-q"], ["add", "-A"], [*who, "commit", "-q", "-m", "first", "--no-verify"]):
        subprocess.run(["git", "-C", str(package.parent), *words], check=True)
    return package.parent


@pytest.fixture
def ours(build_scene, monkeypatch) -> None:
    """Our own commands build nothing; those of another checkout run."""
    real = build_scene.aw

    def aw(*words, checkout=None) -> None:
        scene = Path(words[words.index("-o") + 1])
        if checkout is not None:
            real(*words, checkout=checkout)
        elif not scene.exists():  # a finished build is kept
            scene.mkdir(parents=True)
            (scene / "scene.json").write_text(json.dumps(facts("auto", "fast")))

    monkeypatch.setattr(build_scene, "aw", aw)


def test_the_other_checkout_is_found_from_inside_it_and_named(
    build_scene, checkout, ours, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(build_scene, "RESULTS", tmp_path / "found")
    (tmp_path / "photos").mkdir()
    build_scene.main(["photos", "-o", "out", "--before", "other", "--results", "found"])
    data = json.loads((tmp_path / "found.json").read_text())
    head = subprocess.run(["git", "-C", checkout, "rev-parse", "HEAD"], capture_output=True, text=True)
    assert data["before"]["commit"] == head.stdout.strip()
    assert data["before"]["environment"]["ambiguous_wild"] == "0.0.9"
    assert data["before"]["environment"]["python"] == data["environment"]["python"]
    (row,) = data["captures"]
    assert row["thorough"]["commit"] == head.stdout.strip() != row["auto"]["commit"]
    built = json.loads((tmp_path / "out" / "photos" / "thorough" / "scene.json").read_text())
    assert built["path"] == str(checkout)  # not "other", which its own folder does not hold
    assert "| photos | 9 | 9 → 9 |" in (tmp_path / "found.md").read_text()


def test_a_kept_build_keeps_the_commit_that_made_it(build_scene, ours, tmp_path, monkeypatch):
    (tmp_path / "photos").mkdir()
    for commit in ("first", "second"):
        monkeypatch.setattr(build_scene, "commit_of", lambda checkout, commit=commit: commit)
        row = build_scene.measure(tmp_path / "photos", tmp_path / "out", 0, 0, None)
        assert row["auto"]["commit"] == "first"
    (tmp_path / "out" / "photos" / "auto-commit.txt").unlink()  # built by an earlier script
    assert build_scene.measure(tmp_path / "photos", tmp_path / "out", 0, 0, None)["auto"]["commit"] is None


def test_changed_files_and_folders_without_a_repository(build_scene, checkout, tmp_path):
    (checkout / "ambiguous_wild" / "__init__.py").write_text("")
    assert build_scene.commit_of(checkout).endswith("-dirty")
    assert build_scene.commit_of(checkout / "ambiguous_wild") is None
    assert build_scene.commit_of(tmp_path) is None


def test_what_is_no_checkout_is_refused(build_scene, tmp_path, capsys):
    with pytest.raises(SystemExit):
        build_scene.main([str(tmp_path), "-o", str(tmp_path / "out"), "--before", str(tmp_path)])
    assert "no checkout of this project" in capsys.readouterr().err


def test_a_missing_value_is_missing_in_the_table(build_scene, monkeypatch):
    one = {"photos": 9, "registered": 9, "error_px": 0.4, "total_s": 4.0, "psnr": 20.0}
    one["seconds"] = {"features": 2.0, "matches": 1.0, "mapping": 1.0}
    row = {"capture": "a", "thorough": one | {"psnr_supported": None}, "auto": one | {"psnr_supported": 21.0}}
    assert "| 20.00 → 20.00 | - → 21.00 |" in build_scene.markdown([row])

    def psnr_of(rows):
        monkeypatch.setattr(build_scene, "aw", lambda *words: None)
        monkeypatch.setattr(build_scene, "run_folders", lambda runs: iter([runs]))
        monkeypatch.setattr(build_scene, "read_result", lambda path: {"per_image": rows})
        return build_scene.psnr_of(Path("scene"), Path("runs"), 7)

    seen, unseen = {"psnr": 20.0, "psnr_supported": 22.0}, {"psnr": 21.0}
    assert psnr_of([seen, unseen]) == {"psnr": 20.5, "psnr_supported": 22.0}
    assert psnr_of([seen, unseen | {"psnr_supported": None}]) == {"psnr": 20.5, "psnr_supported": None}
    assert psnr_of([unseen]) == {"psnr": 21.0, "psnr_supported": None}
