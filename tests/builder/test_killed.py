"""kill -9 at a stage boundary or inside a stage; the same call then ends with the same files."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.settings import BuildSettings
from tests.builder.capture_maker import write_capture
from tests.builder.test_pipeline import hashes

pytestmark = pytest.mark.slow
SETTINGS = BuildSettings(factor=2, max_features=500, name="walls")

# Each line makes the builder end its own process at one moment; nothing of the builder knows.
_DIE = "os.kill(os.getpid(), signal.SIGKILL)"
KILLS = {
    "inside screening": f"S._lay_out = lambda *a: {_DIE}",
    "between features and matches": f"F.StructureFromMotion.match = lambda *a: {_DIE}",
    "while COLMAP matches": (
        "real = F.run_job\n"
        "def run(job, folder, watch):\n"
        f"    real(job, folder, (lambda: {_DIE}) if job['task'] == 'matches' else watch)\n"
        "F._POLL_S = 0.05\n"
        "F.run_job = run"
    ),
    "inside undistortion": (
        "import ambiguous_wild.builder.resample as U\n"
        "from pathlib import Path\n"
        "real = U.write_png\n"
        f"U.write_png = lambda path, image: {_DIE} if Path(path).stem == 'p02' else real(path, image)"
    ),
    "before the rename": f"P._publish = lambda *a: {_DIE}",
    "after the rename": (
        "real = P._publish\n"
        f"P._publish = lambda *a: (real(*a), {_DIE})"
    ),
}  # fmt: skip
_SCRIPT = """
import os, signal, sys
from ambiguous_wild.builder import pipeline as P, screen as S, sfm as F
from ambiguous_wild.builder.settings import BuildSettings
{kill}
P.build_scene(sys.argv[1], sys.argv[2], BuildSettings(factor=2, max_features=500, name="walls"), jobs=1)
"""
# What the second call need not do again.
REUSED = {
    "inside screening": set(),
    "between features and matches": {"screen", "features"},
    "while COLMAP matches": {"screen", "features"},
    "inside undistortion": {"screen", "features", "matches", "mapping"},
    "before the rename": {
        "screen",
        "features",
        "matches",
        "mapping",
        "undistort",
        "motion",
        "map",
        "package",
    },
}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    root = tmp_path_factory.mktemp("undisturbed")
    write_capture(root / "raw", 5)
    scene = build_scene(root / "raw", root / "scene", SETTINGS, jobs=2).scene
    return root / "raw", hashes(scene)


def workers(scene: Path) -> set[int]:
    """Processes that compute for this scene."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes()
            if b"sfm_worker" in words and str(scene.parent).encode() in words:
                found.add(int(path.parent.name))
        except OSError:
            continue
    return found


@pytest.mark.parametrize("moment", KILLS)
def test_killed_then_run_again_ends_with_the_same_files(undisturbed, tmp_path, moment):
    raw, expected = undisturbed
    script = _SCRIPT.format(kill=KILLS[moment])
    scene = tmp_path / "scene"
    done = subprocess.run(
        [sys.executable, "-c", script, str(raw), str(scene)], capture_output=True, text=True, check=False
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert scene.exists() == (moment == "after the rename")  # whole or absent
    deadline = time.monotonic() + 10
    while workers(scene) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert workers(scene) == set()  # a killed build leaves no process computing
    result = build_scene(raw, scene, SETTINGS, jobs=2)
    assert hashes(scene) == expected
    assert sorted(os.listdir(tmp_path)) == ["scene"]
    if moment == "after the rename":
        assert result.up_to_date
    else:
        assert set(result.reused) == REUSED[moment]
