"""`aw plan` and `aw bench --effects` as they are typed."""

import json
import re

from ambiguous_wild.cli.plan import table
from ambiguous_wild.harness.effects_plan import Evidence, decide
from tests.command_line import aw


def files(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_plan_is_a_table_and_a_file_and_leaves_the_scene_alone(scene, tmp_path):
    before = files(scene)
    done = aw("plan", scene, "-o", tmp_path / "plan.json", "--costs")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].split()[:2] == ["effect", "decision"]
    assert max(map(len, lines[:-2])) <= 100
    text = " ".join(line.strip() for line in lines)
    assert "a method makes them while it trains" in text and "--keep-masks FOLDER" in text
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert plan["probed"] and plan["scene"] == "scene"
    found = {d["effect"]: d for d in plan["decisions"]}
    assert all(f"{name} {d['decision']}: {d['why']}" in text for name, d in found.items())
    # a red square stands elsewhere in every photo; there are no tracks to say anything else
    assert found["masks"]["decision"] == "on" and found["masks"]["value"] > 0.02
    assert found["exposure"]["decision"] == "unknown" and found["exposure"]["value"] is None
    assert isinstance(found["antialias"]["cost_ms"], float)
    assert found["masks"]["cost_ms"] is None
    assert isinstance(found["masks"]["gain_db"], float) and found["masks"]["error_db"] > 0
    assert list(tmp_path.iterdir()) == [tmp_path / "plan.json"]  # nothing of the probes is left
    assert files(scene) == before
    # made again without a probe it would lose what the probe found
    kept = (tmp_path / "plan.json").read_bytes()
    done = aw("plan", scene, "-o", tmp_path / "plan.json", "--no-probe")
    assert done.returncode == 2 and "the result of a probe" in done.stderr
    assert (tmp_path / "plan.json").read_bytes() == kept


def test_a_file_that_is_no_plan_is_not_replaced(scene, tmp_path):
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(b"\xff\xd8 mine")
    done = aw("plan", scene, "-o", photo, "--no-probe")
    assert done.returncode == 2 and "is not a plan of 'aw plan'; choose another -o" in done.stderr
    assert photo.read_bytes() == b"\xff\xd8 mine"
    for _ in range(2):  # an earlier plan is
        assert aw("plan", scene, "-o", tmp_path / "plan.json", "--no-probe").returncode == 0


def test_without_probe_no_column_is_empty_and_limits_have_units(monkeypatch):
    monkeypatch.setattr("ambiguous_wild.cli.plan.line_width", lambda: 80)
    lines = table(decide("scene", Evidence(0.024, 0.01, 1.2, 0.0, 900, photos=10)))
    assert lines[0].split() == ["effect", "decision", "measured", "limit"]
    cells = {line.split()[0]: re.split(r"  +", line)[2:] for line in lines[1:6]}
    assert cells == {
        "appearance": ["1 %", "from 4.3 %"],
        "exposure": ["2.4 %", "from 5 %"],
        "antialias": ["1.2 times", "from 1.5 times"],
        "skybox": ["—", "—"],  # another decision decides
        "dense": ["10 photos", "up to 24 photos"],
    }
    assert max(map(len, lines)) <= 80 and "gains at the same points, % of the colour range)" in " ".join(
        line.strip() for line in lines
    )
    assert "skybox off: a dense start fills the room for first Gaussians (a dense start)" in lines
