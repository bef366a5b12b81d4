"""The commands of README and docs: all exist, and those in blocks run on tiny inputs (slow).

A block is run in a folder of its own, line by line, with the photos, scenes and runs that pages name.
Iterations, times, views and sizes are cut down; the rest of a line is run as it is printed.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import cv2
import numpy as np
import pytest
import yaml

from ambiguous_wild.cli.main import cli
from ambiguous_wild.study.answers import read_key
from tests.builder.capture_maker import HEIGHT, WIDTH, write_capture
from tests.command_line import ROOT, aw
from tests.datasets import layouts
from tests.report.clean_tables import clean_tables, write
from tests.study.studies import panel, write_panel
from tests.tiny_scene import write_tiny_scene

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# What cannot succeed here: it must end with one line, or succeed where the machine has what is missing.
CANNOT = {
    r"^capture camera ": "a camera",
    r"^fetch on-the-go-mountain ": "a network",
    r"^weights get ": "a network",
    r"features(=| )dinov2-small": "weights",
    r"--device cuda": "a GPU",
    r"--address auto": "a Ray cluster",
    r"external:3dgs-inria.yaml": "the program in a conda environment",
    r"nerfbaselines:": "NerfBaselines",
    r"^stress --replay RUN": "a run that met a NaN",
    r"^view --live ": "a server that does not end; refused without viser",
}

# pages whose lines ask for the tracks of this scene, or what moves in it
NEED_TRACKS = {"fidelity": "scene", "refinesplat": "scene", "simulation": "SCENE"}
BUILT = "built-scene"


def blocks_of(text: str) -> list[list[str]]:
    """The `aw ...` of each block of shell code, without `aw`, comments and line breaks."""
    blocks = [
        block.replace("\\\n", " ").splitlines() for block in re.findall(r"```bash\n(.*?)```", text, re.S)
    ]
    parts = [[part for line in block for part in line.split(" #")[0].split("&&")] for block in blocks]
    return [[part.strip()[3:] for part in block if part.strip().startswith("aw ")] for block in parts]


def commands_of(text: str) -> Iterator[str]:
    """Every `aw ...` of a page, from its blocks of code and from code between words."""
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.S) + re.findall(r"(?:^    .*\n)+", text, re.M)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    for line in lines + re.findall(r"`(aw [^`]+)`", text.replace("\n", " ")):
        for part in re.split(r"&&|\||;", line.split(" #")[0]):
            if found := re.match(r"\s*(?:\$ |\S*/)?aw (.*)", part):
                yield found[1].replace("...", "")


def test_the_commands_and_options_of_every_page_exist() -> None:
    tried = 0
    for page in PAGES:
        for text in commands_of(page.read_text(encoding="utf-8")):
            command: click.Command | None = cli
            words = shlex.split(text)
            while isinstance(command, click.Group) and words and not words[0].startswith("-"):
                command = command.get_command(click.Context(command), words.pop(0))
            assert command is not None, f"{page.name}: aw {text}"
            options = [
                p for p in command.get_params(click.Context(command)) if not getattr(p, "hidden", False)
            ]
            known = {name for option in options for name in (*option.opts, *option.secondary_opts)}
            asked = {word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)}
            assert asked <= known, f"{page.name}: aw {text}"
            tried += 1
    assert tried > 150


def test_every_exception_is_a_line_of_a_page() -> None:
    lines = [line for page in PAGES for block in blocks_of(page.read_text("utf-8")) for line in block]
    assert [entry for entry in CANNOT if not any(re.search(entry, line) for line in lines)] == []


def cannot(line: str) -> bool:
    return any(re.search(entry, line) for entry in CANNOT)


def short(line: str) -> str:
    """The line with little work."""
    line = line.replace(" ... ", " --method 3dgs --scene scene ").replace("NAME", "3dgs")
    line = line.replace("/shared/", "shared/").replace("camera -o raw", "camera -o filmed")
    line = line.replace("leaderboard add ", "leaderboard add --dataset tiny ")  # a scene without scene.json
    line = re.sub(r"--budget (\d+)m", lambda found: f"--budget {int(found[1]) / 10}s", line)
    line = re.sub(r"--frames \d+", "--frames 6", line)
    if re.match(r"(bench|ablate) (?!.*--(budget|iterations) )", line):
        line = line.replace(" ", " --iterations 20 ", 1)
    if line.startswith("bench "):
        line = line.replace(" ", " --set train.probes=1 --threads 1 ", 1)
    if re.match(r"simulate .* -o ", line):
        line = line.replace(" ", " --views 12 --width 320 ", 1)
    return line


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory, built: Path) -> Path:
    """A folder with what the pages name."""
    root = tmp_path_factory.mktemp("inputs")
    for name, count in {"photos": 8, "front": 4, "back": 4, "PHOTOS": 8}.items():
        write_capture(root / name, count, prefix=name[0])
    film = cv2.VideoWriter(str(root / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (WIDTH, HEIGHT))
    for path in write_capture(root / "film", 24):
        film.write(cv2.imread(str(path)))
    film.release()
    clean = write_tiny_scene(tmp_path_factory.mktemp("clean") / "scene", distractors=False)
    for name in ("scene", "a", "b", "my-scene", "SCENE", "yard", "porch"):
        write_tiny_scene(root / name)
        shutil.copytree(clean / "images", root / name / "truth/clean")
    for name in ("scene1", "scene2", BUILT):
        shutil.copytree(built / "scene", root / name)
        facts = root / name / "scene.json"
        facts.write_text(json.dumps(json.loads(facts.read_text("utf-8")) | {"name": name}), "utf-8")
    shutil.rmtree(root / BUILT / "truth")  # as of a capture without distractors
    (root / BUILT / "scene.json").unlink()  # which names the files of truth/
    shutil.copytree(built / "raw", root / "raw")
    (root / "DIR").mkdir()
    cutout = np.zeros((40, 30, 4), np.uint8)
    cutout[4:30, 5:25] = 250, 20, 250, 255
    cv2.imwrite(str(root / "DIR" / "one.png"), cutout)
    large = {"WIDTH": 160, "HEIGHT": 128, "FX": 170.0, "FY": 171.0, "CX": 79.5, "CY": 64.5}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in large.items():
            patch.setattr(layouts, name, value)  # large enough to be measured at factor 8
        layouts.on_the_go(root / "datasets/on-the-go-mountain/mountain")
        layouts.on_the_go(root / "datasets/on-the-go/mountain")
    write(clean_tables(0), root / "table.csv")
    shutil.copytree(ROOT / "examples", root / "examples")
    for line in (
        "bench --method 3dgs,refinesplat --iterations 300 --scene scene -o runs",  # long enough for masks
        "bench --method robustsplat --scene scene -o more-runs",
        "ablate --method examples/02_mask_policy.py:trimmed --sweep share=0.5 --scene scene -o ablation",
    ):
        done = aw(*shlex.split(short(line)), cwd=root)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
    return root


def supply(line: str, folder: Path) -> None:
    """What a person does between two lines of a block."""
    if "--info release.yaml -o" in line:
        form = (folder / "release.yaml").read_text("utf-8")
        form = re.sub(
            r'^(title|description|license|consent|contact): ""', r"\1: as in the test", form, flags=re.M
        )
        (folder / "release.yaml").write_text(form.replace("creators: []", "creators: [Ada]"), "utf-8")
    if line.startswith("study score"):
        key = read_key(folder / "study.key.json")
        strengths = {"3dgs": 0.0, "refinesplat": 1.0}
        write_panel(panel(key, strengths, 6, np.random.default_rng(0)), folder / "answers")
    if line.startswith("capture ") and not cannot(line):
        shutil.rmtree(folder / "raw", ignore_errors=True)  # each is an alternative to the one before


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(blocks_of(p.read_text("utf-8")))], ids=lambda p: p.stem
)
def test_the_commands_in_blocks_run(page: Path, inputs: Path, tmp_path: Path, monkeypatch) -> None:
    for name in ("http_proxy", "https_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")  # no network
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # for Ray's workers
    monkeypatch.setitem(sys.modules, "viser", None)
    text = page.read_text(encoding="utf-8")
    wrong = []
    for number, block in enumerate(blocks_of(text)):
        folder = tmp_path / str(number)
        made = {name for line in block if not cannot(line) for name in re.findall(r" -o ([^\s/]+)", line)}
        folder.mkdir()
        for source in inputs.iterdir():
            if source.name in made:
                continue
            if source.is_dir():
                shutil.copytree(source, folder / source.name)
            else:
                shutil.copy(source, folder)
        if page.stem in NEED_TRACKS:
            shutil.rmtree(folder / NEED_TRACKS[page.stem])
            shutil.move(folder / BUILT, folder / NEED_TRACKS[page.stem])
        for described in re.findall(r"```yaml\n(name: .*?)```", text, re.S):
            (folder / f"{yaml.safe_load(described)['name']}.yaml").write_text(described)
        for line in block:
            supply(line, folder)
            words, _, printed = short(line).partition(" > ")
            done = aw(*shlex.split(words), cwd=folder)
            if printed:
                (folder / printed.strip()).write_text(done.stdout)
            refused = done.returncode == 2 and done.stderr.count("error: ") == 1
            if "Traceback" in done.stdout + done.stderr or not (
                done.returncode == 0 or (cannot(line) and refused)
            ):
                wrong.append(
                    f"aw {words}\n  exit code {done.returncode}\n{done.stdout[-800:]}{done.stderr[-800:]}"
                )
    assert not wrong, "\n\n".join(wrong)
