"""The example with pandas, on runs that exist and on none."""

import subprocess
import sys
from pathlib import Path

import pandas as pd

from tests.harness.fake_runs import fake_result, save

EXAMPLE = Path(__file__).parents[2] / "examples" / "05_results_with_pandas.py"


def run(*words) -> str:
    done = subprocess.run([sys.executable, EXAMPLE, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_means_and_differences_of_runs_that_exist(tmp_path):
    runs = save(
        tmp_path / "runs",
        fake_result("3dgs", psnr=(20.0, 22.0)),
        fake_result("refinesplat", psnr=(23.0, 23.5)),
    )
    said = run("--runs", runs, "-o", tmp_path)
    means = {line.split()[0]: line.split() for line in said.splitlines() if line.startswith(("3dgs", "refi"))}
    assert "21.0" in said and "23.25" in said and set(means) == {"3dgs", "refinesplat"}
    assert "refinesplat - 3dgs" in said and "2.25" in said  # mean of +3.0 and +1.5
    table = pd.read_csv(tmp_path / "results.csv")
    assert len(table[(table["metric"] == "psnr") & table["value"].notna()]) == 4


def test_without_runs_it_says_so(tmp_path):
    done = subprocess.run([sys.executable, EXAMPLE], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1, done.stderr
    assert "example_photos_to_table" in done.stderr
