"""A newcomer's path, exactly as docs/add-a-method.md tells it."""

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.bench import command as bench
from ambiguous_wild.methods import registry
from tests.tiny_scene import write_tiny_scene

PAGE = Path(__file__).parents[2] / "docs" / "add-a-method.md"


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_registered", {})
    code = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert code is not None
    path = tmp_path / "trimmed.py"
    path.write_text(code[1])
    return path


def test_the_file_of_the_page_is_short(plugin):
    assert len(plugin.read_text().splitlines()) < 60


def test_the_file_of_the_page_trains_and_is_measured(plugin, tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    arguments = ["--plugin", plugin, "--method", "trimmed", "--scene", scene, "-o", tmp_path / "runs"]
    arguments += ["--iterations", "60", "--set", "trimmed.percentile=0.7"]
    result = CliRunner().invoke(bench, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    run = tmp_path / "runs" / "scene" / "trimmed" / "seed0"
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["options"]["percentile"] == 0.7
    assert metrics["per_image"][0]["psnr"] > 10
    masks = sorted((run / "masks").glob("*.png"))
    assert len(masks) == 6

    from ambiguous_wild.io.images import read_gray

    kept = sum((read_gray(m) > 127).mean() for m in masks) / len(masks)
    assert kept == pytest.approx(0.7, abs=0.03)


def test_the_function_of_the_page_is_a_method_by_its_path(plugin):
    entry = registry.get_method(f"{plugin}:build")
    assert entry.name == "build"
    assert entry.build(entry.options()).mask.config.percentile == 0.85
