"""`aw screen`: the table, its JSON, and what --strict refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.builder.capture_maker import write_capture
from tests.command_line import aw


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good capture with one file that is no photo, under a name that would colour a terminal."""
    folder = tmp_path_factory.mktemp("capture") / "raw"
    write_capture(folder, 5)
    (folder / "\x1b[31mz.jpg").write_bytes(b"none")
    return folder


def test_the_table_says_what_and_why_and_writes_nothing(raw: Path) -> None:
    before = sorted(raw.iterdir())
    done = aw("screen", raw)
    assert done.returncode == 0 and sorted(raw.iterdir()) == before
    assert "1 of 6 photos are left out" in done.stdout and "-> repair or remove them" in done.stdout
    states = [
        line[17:24].strip() for line in done.stdout.splitlines() if line[17:24].strip() in ("ok", "unknown")
    ]
    passed, unknown = states.count("ok"), states.count("unknown")
    verdict = f"5 photos: {passed} of 11 checks passed, 1 warning, {unknown} unknown\n"
    assert unknown and passed + unknown == 10 and verdict in done.stdout and "\x1b[31mz" not in done.stdout


def test_json_holds_the_same_and_strict_refuses(raw: Path) -> None:
    done = aw("screen", raw, "--json", "--strict")
    assert done.returncode == 2 and done.stderr.count("files:") == 1
    facts = json.loads(done.stdout)
    assert {c["name"]: c["state"] for c in facts["checks"]}["overlap"] == "ok"
    assert facts["photos"] == 5 and len(facts["skipped"]) == 1


def test_three_photos_that_are_left_out_are_named(raw: Path, tmp_path: Path) -> None:
    shutil.copytree(raw, tmp_path / "raw")
    for name in "abc":
        (tmp_path / "raw" / f"{name}.jpg").write_bytes(name.encode())
    said = aw("screen", tmp_path / "raw", "--json").stdout
    (finding,) = [c["finding"] for c in json.loads(said)["checks"] if c["name"] == "files"]
    assert finding.startswith("4 of 9 photos are left out: ") and finding.endswith(" and 1 more")
    assert finding.count("(no image") == 3 and ", a.jpg (" in finding


def test_several_folders_are_checked_as_one_capture(raw: Path, tmp_path: Path) -> None:
    write_capture(tmp_path / "other", 4, prefix="q")
    facts = json.loads(aw("screen", raw, tmp_path / "other", "--json").stdout)
    # the ends of both arcs are the same photo
    assert facts["photos"] + len(facts["skipped"]) == 10 and facts["photos"] == 7
    assert {s["source"].split("/")[-2] for s in facts["skipped"]} == {"raw", "other"}


def test_a_map_replaces_a_map(raw: Path, tmp_path: Path) -> None:
    target = tmp_path / "map.png"
    aw("screen", raw, "-o", target)
    first = target.read_bytes()
    assert (
        aw("screen", raw, "-o", target).returncode == 0
        and target.read_bytes() == first
        and b"Software" in first
    )
