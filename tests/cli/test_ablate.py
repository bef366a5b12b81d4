"""`aw ablate` as it is typed."""

import csv
import json
import subprocess
import sys

import pytest

from tests.command_line import aw

PLUGIN = """
from ambiguous_wild.methods.ablation_groups import Group, Variant
from ambiguous_wild.methods.registry import MethodEntry, register
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.method_hooks import MethodHooks

register(MethodEntry(
    "mine", "3dgs", lambda options: MethodHooks(density_config=options), config=DensityConfig,
    ablations=(Group("size", "how large", (
        Variant("few", ("max_gaussians=450",)), Variant("peer", method="not-here"),
    )), Group("length", "how long it grows", (Variant("brief", ("stop=600.0",)),)),),
))
"""


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    path = tmp_path_factory.mktemp("plugin") / "mine.py"
    path.write_text(PLUGIN)
    return path


def test_listing_shows_every_group_and_variant_and_imports_no_torch():
    code = (
        "import sys\nfrom ambiguous_wild.cli.main import cli\n"
        "try:\n    cli.main(['ablate', '--json'], standalone_mode=False)\n"
        "except SystemExit:\n    pass\n"
        "sys.stderr.write(str([m for m in ('torch', 'numba', 'matplotlib', 'cv2') if m in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "[]"
    groups = {g["group"]: g for g in json.loads(done.stdout)}
    variants = [v["name"] for v in groups["masks"]["variants"]]
    assert variants == ["neither", "local", "global", "union", "fused"]
    plain = aw("ablate", "--group", "alpha1").stdout
    assert "lambda_cr=0.3" in plain and "mask." not in plain


def test_a_study_is_trained_once_and_tabulated(scene, plugin, tmp_path):
    words = ["--method", "mine", "--plugin", plugin, "--scene", scene, "--iterations", "20", "-o", tmp_path]
    words += ["--group", "size"]
    first = aw("ablate", *words)
    assert first.returncode == 0, first.stderr
    assert (tmp_path / "scene" / "mine@size-few" / "seed0" / "metrics.json").is_file()
    rows = {row["variant"]: row for row in csv.DictReader((tmp_path / "ablation.csv").open())}
    assert list(rows) == ["default", "few", "peer"]
    assert float(rows["few"]["psnr"]) > 10 and float(rows["default"]["difference_psnr"]) == 0
    assert rows["peer"]["status"] == "missing" and "not-here" in rows["peer"]["reason"]
    assert "| few |" in first.stdout and "- peer missing" in first.stdout
    again = aw("ablate", *words)
    assert again.stderr.count("finished before, kept") == 2
    assert list(csv.DictReader((tmp_path / "ablation.csv").open())) == list(rows.values())
    joined = aw("ablate", *words[:-1], "length")
    assert joined.returncode == 0 and "with what" in joined.stderr, joined.stderr
    together = list(csv.DictReader((tmp_path / "ablation.csv").open()))
    assert [(row["group"], row["variant"]) for row in together] == [
        ("size", "default"), ("size", "few"), ("size", "peer"), ("length", "default"), ("length", "brief"),
    ]  # fmt: skip
    made_by = json.loads((tmp_path / "ablation.json").read_text())["made_by"]
    assert made_by.endswith("--group length --group size")
    words[words.index("20")] = "30"
    longer = aw("ablate", *words, "--overwrite", "longer")
    assert longer.returncode == 0 and longer.stderr.count("finished before, kept") == 0, longer.stderr
    cost = json.loads((tmp_path / "scene" / "mine@size-few" / "seed0" / "metrics.json").read_text())["cost"]
    assert cost["iterations"] == 30
    # Other settings get a report of their own.
    assert "with what" not in aw("ablate", *words[:-1], "length", "--set", "mine.stop=700").stderr
