"""The first example, as a newcomer runs it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
EXAMPLE = Path(__file__).parents[2] / "examples" / "01_photos_to_table.py"


def run(*words) -> str:
    done = subprocess.run([sys.executable, EXAMPLE, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_goes_from_photos_to_a_table(tmp_path):
    words = ["-o", tmp_path, "--method", "3dgs", "--iterations", "20", "--device", "cpu"]
    said = run(*words)
    result = json.loads((tmp_path / "runs/scene/3dgs/seed0/metrics.json").read_text())
    assert result["status"] == "ok" and len(result["per_image"]) == 3
    psnr = sum(row["psnr"] for row in result["per_image"]) / 3
    row = next(line for line in (tmp_path / "table.md").read_text().splitlines() if "3dgs" in line)
    assert f"{psnr:.2f}" in row and f"{psnr:.2f}" in said
    assert "finished before, kept" in run(*words)
