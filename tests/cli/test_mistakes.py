"""Mistakes of a user: one line that names the mistake, exit code 2, and no file is changed or left behind."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.io.images import write_png
from tests.builder.capture_maker import HEIGHT, WIDTH, write_capture
from tests.command_line import aw
from tests.harness.fake_runs import fake_result, save

OWN = """from ambiguous_wild.splat.method_hooks import MethodHooks
def helper(x): ...
def chroma() -> MethodHooks: return MethodHooks()
"""
BENCH = "bench --scene scene -o out --method "
BUILD = "build-scene raw -o out "
AMBIGUITY = "ambiguity-report scene -o out "
# Command line, what its error says; "..." stands between two parts of it.
MISTAKES = [
    ("tabel", "did you mean 'table'?"),
    ("methods --plugin mine.py", "no plugin file mine.py"),
    ("build-scene '' -o x", "the name is empty"),
    ("plan ''", "the name is empty"),
    ("bench -o ''", "the name is empty"),
    ("ablate -o out", "no scene"),
    ("ablate --group maskz", "did you mean 'masks'"),
    ("ablate --sweep lambda_cr", "--sweep 'lambda_cr': write KEY=V1,V2"),
    ("ablate --method 3dgs", "declares no ablations"),
    ("ablate -o out --scene scene --set mask.boxx=3", "did you mean 'box'"),
    ("ablate -o out --scene scene --iterations 5 --budget 1m", "exclude each other"),
    (f"{BENCH} refinsplat", "did you mean 'refinesplat'"),
    (f"{BENCH} 3dgs --iterations 5 --budget 1m", "exclude each other"),
    (f"{BENCH} 3dgs --iterations 0", "--iterations"),
    (f"{BENCH} 3dgs --iterations 10kk", "'10kk' is not a whole number"),
    (f"{BENCH} 3dgs, refinesplat", "write 3dgs,refinesplat without a space"),
    (f"{BENCH} 3DGS --seed 2 refinesplat", "did you mean --method refinesplat?"),
    (f"{BENCH} 3dgs ./other", "did you mean --scene ./other?"),
    (f"{BENCH} mine:trimmed", "write FILE.py:RECIPE, as mine.py:trimmed"),
    (f"{BENCH} 3dgs,refinsplat", "unknown method 'refinsplat': did you mean 'refinesplat'"),
    (f"{BENCH} own.py", "error: own.py is a file: add the name of a recipe in it: own.py:chroma\n"),
    (f"{BENCH} 3dgs --overwrite perhaps", "'never', 'missing', 'longer', 'changed', 'always'"),
    (f"{BENCH} 3dgs --itterations 5", "--iterations"),
    (f"{BENCH} refinesplat --set refinesplat.lamda_cr=1", "did you mean 'lambda_cr'"),
    (f"{BENCH} refinesplat --set refinesplat.lambda_dssim=nan", "finite"),
    (f"{BENCH} refinesplat --set refinesplat.mask_every=0", "at least 1"),
    (f"{BENCH} refinesplat --set refinesplat.mask_evry=1", "? ('aw methods refinesplat' lists them; for"),
    (f"{BENCH} 3dgs --set 3dgs.foo=1", "there is none (for every method: train.KEY and engine.KEY of"),
    (f"{BENCH} 3dgs --set train.probs=1", "did you mean 'train.probes'?"),
    (f"{BENCH} 3dgs --set train.probes=101", "--set train.probes is from 0 to 100, got 101"),
    (f"{BENCH} 3dgs --set train.checkpoint_every_s=nan", "setting checkpoint_every_s"),
    (f"{BENCH} 3dgs --set train.checkpoint_every_s=0", "--set train.checkpoint_every_s is at least 0.01"),
    (f"{BENCH} 3dgs --set train.on_nonfinite=perhaps", "on_nonfinite 'perhaps': there is: rollback, stop"),
    (f"{BENCH} 3dgs --plugin absent.py", "no plugin file"),
    (f"{BENCH} 3dgs --seed -1", "--seed"),
    (f"{BENCH} 3dgs --budget 0s", "above zero"),
    (f"{BENCH} 3dgs --effects poss", "did you mean 'poses'"),
    (f"{BENCH} 3dgs --effects all,poses", "cannot be combined"),
    (f"{BENCH} 3dgs --effects gone.json", "there is no plan gone.json"),
    (f"{BENCH} 3dgs --effects gone.json --effects auto", "gone.json is a plan, and auto"),
    ("bench --method 3dgs --scene nothing -o out", "there is no scene folder"),
    ("bench --method 3dgs --scene x&y -o out", "'aw build-scene PHOTOS -o 'x&y'' makes one"),
    ("bench --method 3dgs --scene scenee -o out", "no scene folder scenee; did you mean scene?"),
    ("bench --method 3dgs --scene above -o out", "above is no scene; did you mean above/scene?"),
    ("try rwa -o out", "'rwa' does not exist; did you mean raw?"),
    ("table run", "no folder of runs run ... did you mean runs?"),
    ("view run", "no folder of runs run ... did you mean runs?"),
    ("view above/scene", "above/scene is a scene, not runs: 'aw bench"),
    ("capture rwa -o out", "did you mean raw?"),
    ("import rwa -o out", "did you mean ... /raw?"),
    ("build-scene rwa -o out", "capture rwa does not exist; did you mean raw?"),
    ("export runs --format splat", "'splat' is not supported ... --format spz"),
    ("bench --method 3dgs --scene scene --iterations 5 -o file", "file"),
    ("bench --method 3dgs --scene scene --iterations 5 -o file/deeper", "file"),
    ("plan scene -o scene/plan.json", "would change the scene"),
    ("plan scene/nothing", "there is no scene folder"),
    ("plan scene -o own.py --no-probe", "is not a plan of 'aw plan'; choose another -o"),
    ("simulate courtyrad -o x", "did you mean 'courtyard'"),
    ("simulate tiny", "-o raw"),
    ("simulate -o x", "name a capture"),
    ("simulate tiny --like scene -o x", "exclude each other"),
    ("simulate tiny -o x --views 1", "3 to 2000"),
    ("composite scene -o out", "--cutouts FOLDER"),
    ("composite scene -o out --cutouts nowhere", "no folder"),
    ("composite scene -o out --patches --coverage 2", "2"),
    ("try empty -o out", "holds no photos"),
    ("try empty -o out --budget 5", "no duration"),
    ("cost", "Missing argument 'RUNS...'"),
    ("cost empty --target nan", "--target"),
    ("cost nowhere -o out", "no folder of runs"),
    ("cost runs --recommend scene", "requires 2 arguments"),
    ("table", "Missing argument 'RUNS...'"),
    ("table nowhere", "no folder of runs nowhere"),
    ("table empty", "aw bench"),
    ("table raw", "holds photos, not runs"),
    ("table described", "is a scene, not runs"),
    ("table runs --format pdf", "pdf"),
    ("table runs -o t.pdf", "end the name in .txt, .md"),
    ("table runs --format csv -o runs/yard/3dgs/seed0/metrics.json", "no table"),
    ("table runs -o pipe", "nobody reads"),
    ("audit -o t.pdf", "end the name in .txt, .md, .csv, .json"),
    ("stress -o t.pdf", "end the name in .txt, .md, .json"),
    ("table runs --metric nope", "unknown metric 'nope': the nearest of ... 'aw table RUNS' shows"),
    ("table runs --metric all --metric psnr", "leave the other --metric out"),
    ("table runs --reported", "--layout paper"),
    ("table runs --layout paper --reported nowhere", "no reported numbers in nowhere"),
    ("table runs --layout paper --dataset D", "NAME=SCENE"),
    ("table runs --layout ablation --only yard", "--only does not go"),
    ("table runs --layout ablation", "aw ablate"),
    ("figure runs", "Missing option '-o'"),
    ("figure runs -o figure.txt", "no format is known for .txt: end the name in .pdf, .png, .svg"),
    ("figure runs -o figure", "error: -o figure: end the name in .pdf, .png, .svg"),
    ("figure empty -o figure.pdf", "no run in empty"),
    ("figure runs -o figure.pdf --only yrd", "unknown scene 'yrd': did you mean 'yard'?"),
    ("figure runs -o figure.pdf --label mine=Ours", "unknown method 'mine'"),
    ("figure runs -o figure.pdf --inches 0", "--inches"),
    *((f"figure runs -o figure.pdf --crop {crop}", "write X,Y,W,H with the upper left corner first")
      for crop in ("1,2,3", "a,b,c,d", "1,2,nan,4", "nothing")),
    ("figure runs -o figure.pdf --crop none --crop none", "--crop is given 2 times and --photo 0 times"),
    ("figure runs -o figure.pdf", "no config.yaml that names its scene"),
    ("video empty --fps nan", "--fps"),
    ("video empty --seconds nan", "--seconds"),
    ("video empty --seconds inf", "--seconds"),
    ("view --live scene --port 80:a", "no port from 0 to 65535, nor HOST:PORT"),
    ("view --live scene --port 65536", "no port from 0 to 65535, nor HOST:PORT"),
    ("stress --only nedle", "'nedle': no such case"),
    ("stress --method nowhere.py:lost", "nowhere.py"),
    ("stress --method 3dgs --only 4", "leave out --only"),
    ("stress --method nerfbaselines:wild-gaussians", "error: "),
    ("stress --method 3dgs+truth", "truth"),
    (f"{AMBIGUITY} --distractor-masks truth --keep-masks masks", "exclude each other"),
    (f"{AMBIGUITY} --distractor-masks run", "needs --run"),
    (f"{AMBIGUITY} --background run", "needs --run"),
    ("ambiguity-report scene --background none -o scene", "would change the scene"),
    ("ambiguity-report scene --background none -o scene/report", "would change the scene"),
    ("ambiguity-report scene --background none -o link/x", "would change the scene"),
    ("ambiguity-report scene --background none -o described", "scene.json"),
    ("ambiguity-report scene --background none -o own.py", "a file lies there"),
    ("screen nowhere", "does not exist"),
    ("screen raw -o map.jpg", "no .png"),
    ("screen raw -o mine.png", "no map that aw drew"),
    ("screen raw -o raw/map.png", "lies in the capture"),
    ("screen raw -o to-raw/map.png", "lies in the capture"),
    ("screen raw -o pipe.png", "no regular file"),
    ("build-scene nowhere -o out", "does not exist"),
    ("build-scene empty -o out", "holds no photos"),
    ("build-scene one -o out", "one photo"),
    ("build-scene texts -o out", "only 0 of 3 photos ... a.jpg (no image"),
    ("build-scene cut -o out --strict", "1 of 4 photos cannot be read: p02.jpg (cut JPEG"),
    ("build-scene built -o out", "is a scene already ... scene.json ... aw bench"),
    ("build-scene mapped -o out", "is a scene already ... sparse ... aw bench"),
    ("build-scene raw", "--help"),
    ("build-scene raw -o .scene", "--name sets another"),
    ("build-scene raw -o raw", "holds the photos themselves"),
    *((f"build-scene raw -o {out}", "lies inside raw")
      for out in ("raw/sub/scene", "raw/train/scene", "raw/images", "raw/../raw/x", "to-raw/x")),
    *((f"build-scene raw -o {out}", "cannot write") for out in ("file/scene", "/dev/null/x", "/proc/x")),
    ("build-scene raw -o file", "file"),
    *((BUILD + shlex.join(["--name", name]), "scene name")
      for name in ("", " ", "a/b", "..", ".x", "-rf", "a<b>", "a\nb", "\x1b[31m", "x" * 101)),
    (f"{BUILD} --factor 64", "px a side, too small to train on ... p02.jpg (4)"),
    (f"{BUILD} --factor 0", "--factor must be"),
    (f"{BUILD} --max-features 3", "--max-features"),
    (f"{BUILD} --matcher all", "'exhaustive'"),
    (f"{BUILD} --test-list one-of.txt", "did you mean"),
    (f"{BUILD} --test-list all-of.txt", "no training photo would be left"),
    (f"{BUILD} --keep-masks mine.png", "mine.png is a file; give the folder"),
    (f"{BUILD} --keep-masks masks", "2 of 3 photos have no mask: p01.jpg, p02.jpg"),
    (f"{BUILD} --keep-masks narrow-masks", "2 of 3 masks"),
    (f"{BUILD} --keep-masks black-masks --max-features 200",
     "masks keep only 0 % of a photo ... white = keep"),
]  # fmt: skip


@pytest.fixture(scope="module")
def here(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the command lines name."""
    root = tmp_path_factory.mktemp("here")
    write_capture(root / "raw", 3)
    write_capture(root / "one", 1)
    write_capture(root / "built" / "images", 3)
    write_capture(root / "mapped" / "images", 3)
    cut = write_capture(root / "cut", 4)[2]
    cut.write_bytes(cut.read_bytes()[:5000])
    for name in ("empty", "texts", "described", "built/scene.json", "mapped/sparse"):
        (root / name).mkdir()
    for name in "abc":
        (root / "texts" / f"{name}.jpg").write_text("dear diary")
    for folder, widths in {"masks": [0], "narrow-masks": [0, 1, 2], "black-masks": [0, 0, 0]}.items():
        (root / folder).mkdir()
        for number, less in enumerate(widths):
            mask = np.zeros((HEIGHT, WIDTH - less), np.uint8)
            cv2.imwrite(str(root / folder / f"p0{number}.png"), mask)
    write_png(root / "mine.png", np.zeros((9, 9, 3), np.uint8))
    (root / "described" / "scene.json").write_text("{}")
    (root / "one-of.txt").write_text("p07.jpg\n")
    (root / "all-of.txt").write_text("p00.jpg\np01.jpg\np02.jpg\n")
    (root / "file").write_text("mine")
    (root / "own.py").write_text(OWN)
    save(root / "runs", fake_result("3dgs"))
    (root / "scene").symlink_to(scene)
    (root / "above").mkdir()
    (root / "above" / "scene").symlink_to(scene)
    (root / "link").symlink_to(scene)
    (root / "to-raw").symlink_to("raw")
    for name in ("pipe", "pipe.png"):
        os.mkfifo(root / name)
    return root


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() if p.is_file() else b"" for p in folder.rglob("*")}


@pytest.mark.parametrize(("line", "message"), MISTAKES, ids=[line for line, _ in MISTAKES])
def test_a_mistake_is_one_line_and_changes_nothing(line: str, message: str, here: Path) -> None:
    before = contents(here)
    done = aw(*shlex.split(line), cwd=here)
    assert done.returncode == 2, done.stderr
    assert all(part in done.stderr for part in message.split(" ... ")), done.stderr
    if line.startswith("build-scene"):  # names its stages above
        assert done.stderr.count("error: ") == 1 and "Traceback" not in done.stderr
    else:
        assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert done.stdout == "" and contents(here) == before


@pytest.mark.parametrize("out", ["/dev/null/x", "file/x", "/proc/x"])
@pytest.mark.parametrize(
    ("line", "work"),
    [
        ("simulate tiny", "ambiguous_wild.simulate.capture_writer.simulate"),
        ("ambiguity-report scene --background none", "ambiguous_wild.report.ambiguity_measure.measure"),
    ],
)
def test_an_output_that_cannot_be_is_found_before_the_work(
    line: str, work: str, out: str, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work, lambda *_, **__: pytest.fail("worked first"))
    done = aw(*line.split(), "-o", out, cwd=here)
    assert done.returncode == 2 and "cannot write" in done.stderr
