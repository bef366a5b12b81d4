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


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("missing", r"1 missing: .*layer.*q_proj.weight.*would be random"),
        ("left over", r"1 unexpected: head.weight"),
        ("not finite", r"model\.safetensors holds values that are not finite, in tensor .*q"),
        ("shape", r"could not be loaded.*replace this folder"),
        ("cut", "could not be loaded as Dinov2Model"),
        ("pickle", r"pytorch_model.bin only, a pickle"),
    ],
)
def test_a_model_that_is_not_the_whole_one_is_refused(checkpoint, tmp_path: Path, damage, message):
    folder = Path(shutil.copytree(checkpoint("dinov2"), tmp_path / "copy"))
    path = folder / "model.safetensors"
    tensors = load_file(path)
    key = next(k for k in tensors if "query.weight" in k)
    if damage == "missing":
        del tensors[key]
    elif damage == "left over":
        tensors["head.weight"] = torch.zeros(2)
    elif damage == "not finite":
        tensors[key][0, 0] = float("nan")
    save_file(tensors, path, metadata={"format": "pt"})
    if damage == "shape":
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, "hidden_size": 64}))
    elif damage == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif damage == "pickle":
        path.rename(folder / "pytorch_model.bin")
    with pytest.raises(AwError, match=message):
        _ = DinoFeatures("x", folder=folder).model


def test_a_pooler_is_left_over_and_does_no_harm(tmp_path: Path):
    from transformers import ViTConfig, ViTModel

    config = ViTConfig(
        hidden_size=16, num_hidden_layers=1, num_attention_heads=2, patch_size=8, image_size=32
    )
    ViTModel(config).save_pretrained(tmp_path)
    assert "pooler.dense.weight" in load_file(tmp_path / "model.safetensors")
    assert DinoFeatures("x", folder=tmp_path)(torch.rand(24, 24, 3)).shape == (32, 32, 16)


def test_another_kind_of_model_is_refused_before_it_is_loaded(checkpoint):
    with pytest.raises(AwError, match="holds a model of type 'dinov2_with_registers', x needs dinov2"):
        locate("x", ("dinov2",), checkpoint("registers"))
    with pytest.raises(AwError, match="type 'sam', x needs dinov2 or dinov2_with_registers or vit"):
        DinoFeatures("x", folder=checkpoint("sam"))


def test_folders_that_hold_no_model(tmp_path: Path):
    for text, message in (
        (None, r"no folder .*absent"),
        ("", r"no config\.json"),
        ("{", "cannot read"),
        ("[1]", "type None"),
    ):
        folder = tmp_path / "absent" if text is None else tmp_path
        if text:
            (folder / "config.json").write_text(text)
        with pytest.raises(AwError, match=message):
            locate("x", ("dinov2",), folder)


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
        assert weight_registry.get_weight(name).kind == "hub"


def test_without_transformers_the_message_is_the_command(checkpoint, monkeypatch):
    monkeypatch.setattr(pretrained.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(AwError, match=r"needs transformers.*pip install.*\[masks\]"):
        locate("x", ("dinov2",), checkpoint("dinov2"))


def test_a_class_the_library_lacks_comes_with_a_way_out(checkpoint):
    source = locate("x", ("dinov2",), checkpoint("dinov2"))
    with pytest.raises(AwError, match=r"no usable NoSuchModel.*pip install"):
        load(source, "NoSuchModel")


def test_transformers_is_imported_late_and_a_torchvision_that_does_not_fit_is_named(
    checkpoint, tmp_path: Path
):
    """As pip leaves it: the package is found, has a version, and its import dies."""
    package, facts = tmp_path / "torchvision", tmp_path / "torchvision-0.99.0.dist-info"
    package.mkdir()
    facts.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')\n")
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: torchvision\nVersion: 0.99.0\n")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "import ambiguous_wild.vision.backends, ambiguous_wild.vision.grounded\n"
        "import ambiguous_wild.vision.sam_video, ambiguous_wild.vision.precompute\n"
        "from ambiguous_wild.vision.dino import DinoFeatures\n"
        "assert not {'transformers', 'huggingface_hub'} & sys.modules.keys()\n"
        f"DinoFeatures('x', folder={str(checkpoint('dinov2'))!r}).model\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    last = done.stderr.strip().splitlines()[-1]
    assert "AwError" in last and "pip uninstall -y torchvision" in last
