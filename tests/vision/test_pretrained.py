import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from ambiguous_wild.core import AwError
from ambiguous_wild.vision import pretrained, weight_registry
from ambiguous_wild.vision.dino import DinoFeatures
from ambiguous_wild.vision.pretrained import load, locate


@pytest.fixture
def copy(checkpoint, tmp_path: Path):
    """A copy of a checkpoint that a test may damage."""

    def make(name: str) -> Path:
        return Path(shutil.copytree(checkpoint(name), tmp_path / name))

    return make


def test_a_model_that_lacks_a_tensor_is_refused_by_its_name(copy):
    folder = copy("dinov2")
    tensors = load_file(folder / "model.safetensors")
    key = next(k for k in tensors if "query.weight" in k)
    del tensors[key]
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(AwError, match=r"1 missing: .*layer.*q_proj.weight.*would be random"):
        _ = DinoFeatures("x", folder=folder).model


def test_left_over_tensors_are_refused_and_a_pooler_is_not(copy, tmp_path: Path):
    folder = copy("dinov2")
    tensors = load_file(folder / "model.safetensors")
    save_file({**tensors, "head.weight": torch.zeros(2)}, folder / "model.safetensors", {"format": "pt"})
    with pytest.raises(AwError, match=r"1 unexpected: head.weight"):
        _ = DinoFeatures("x", folder=folder).model
    from transformers import ViTConfig, ViTModel

    config = ViTConfig(
        hidden_size=16, num_hidden_layers=1, num_attention_heads=2, patch_size=8, image_size=32
    )
    ViTModel(config).save_pretrained(tmp_path / "pooled")
    assert "pooler.dense.weight" in load_file(tmp_path / "pooled" / "model.safetensors")
    assert DinoFeatures("x", folder=tmp_path / "pooled")(torch.rand(24, 24, 3)).shape == (32, 32, 16)


def test_tensors_of_another_shape_and_damaged_files_are_refused(copy):
    folder = copy("dinov2")
    path = folder / "config.json"
    config = json.loads(path.read_text())
    path.write_text(json.dumps({**config, "hidden_size": 64}))
    with pytest.raises(AwError, match=r"could not be loaded.*replace this folder"):
        _ = DinoFeatures("x", folder=folder).model
    path.write_text(json.dumps(config))
    data = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(data[: len(data) // 2])
    with pytest.raises(AwError, match="could not be loaded as Dinov2Model"):
        _ = DinoFeatures("x", folder=folder).model


def test_values_that_are_not_finite_are_refused(copy):
    folder = copy("dinov2")
    tensors = load_file(folder / "model.safetensors")
    key = next(k for k in tensors if "query.weight" in k)
    tensors[key][0, 0] = float("nan")
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(AwError, match=r"model\.safetensors holds values that are not finite, in tensor .*q"):
        _ = DinoFeatures("x", folder=folder).model


def test_another_kind_of_model_is_refused_before_it_is_loaded(checkpoint):
    with pytest.raises(AwError, match="holds a model of type 'dinov2_with_registers', x needs dinov2"):
        locate("x", ("dinov2",), checkpoint("registers"))
    with pytest.raises(AwError, match="type 'sam', x needs dinov2 or dinov2_with_registers or vit"):
        DinoFeatures("x", folder=checkpoint("sam"))


def test_a_pickle_is_never_opened(copy):
    folder = copy("dinov2")
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(AwError, match=r"pytorch_model.bin only, a pickle"):
        locate("x", ("dinov2",), folder)


def test_folders_that_hold_no_model(tmp_path: Path):
    with pytest.raises(AwError, match=r"no folder .*absent"):
        locate("x", ("dinov2",), tmp_path / "absent")
    with pytest.raises(AwError, match=r"no config\.json"):
        locate("x", ("dinov2",), tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(AwError, match="cannot read"):
        locate("x", ("dinov2",), tmp_path)
    (tmp_path / "config.json").write_text("[1]")
    with pytest.raises(AwError, match="type None"):
        locate("x", ("dinov2",), tmp_path)


def test_offline_the_message_is_the_command(offline: Path):
    with pytest.raises(AwError) as error:
        locate("dinov2-small", ("dinov2",))
    text = str(error.value)
    assert "\n" not in text
    assert "the hub is switched off by HF_HUB_OFFLINE; unset HF_HUB_OFFLINE and run: aw weights get" in text
    assert "copy its folder" in text and "download them" not in text
    with pytest.raises(AwError, match="did you mean 'dinov2-small'"):
        locate("dinov2-smal", ("dinov2",))


def test_every_name_a_user_can_write_is_a_known_weight():
    from ambiguous_wild.vision import backends

    for name in (*backends.DINO.values(), *backends.SAM.values(), *backends.SAM_VIDEO.values()):
        assert weight_registry.named(name).kind == "hub"


def test_without_transformers_the_message_is_the_command(checkpoint, monkeypatch):
    monkeypatch.setattr(pretrained.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(AwError, match=r"needs transformers.*pip install.*\[masks\]"):
        locate("x", ("dinov2",), checkpoint("dinov2"))


def test_a_class_the_library_lacks_comes_with_a_way_out(checkpoint):
    source = locate("x", ("dinov2",), checkpoint("dinov2"))
    with pytest.raises(AwError, match=r"no usable NoSuchModel.*pip install"):
        load(source, "NoSuchModel")


def test_a_torchvision_that_does_not_fit_is_named(checkpoint, tmp_path: Path):
    """As pip leaves it: the package is found, has a version, and its import dies."""
    package, facts = tmp_path / "torchvision", tmp_path / "torchvision-0.99.0.dist-info"
    package.mkdir()
    facts.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')\n")
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: torchvision\nVersion: 0.99.0\n")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from ambiguous_wild.vision.dino import DinoFeatures\n"
        f"DinoFeatures('x', folder={str(checkpoint('dinov2'))!r}).model\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    last = done.stderr.strip().splitlines()[-1]
    assert "AwError" in last and "pip uninstall -y torchvision" in last


def test_importing_the_back_ends_does_not_import_transformers():
    code = (
        "import sys, ambiguous_wild.vision.backends, ambiguous_wild.vision.dino,"
        " ambiguous_wild.vision.grounded, ambiguous_wild.vision.sam_video, ambiguous_wild.vision.precompute\n"
        "sys.exit('transformers' in sys.modules or 'huggingface_hub' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
