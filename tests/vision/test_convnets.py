"""EfficientNet-Lite0 and VGG-16 against plain second implementations, on random tensors in their layout."""

from __future__ import annotations

import dataclasses
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from ambiguous_wild.core import AwError
from ambiguous_wild.vision import convnets, weight_registry
from ambiguous_wild.vision.convnets import NETWORKS, ConvConfig, ConvFeatures
from ambiguous_wild.vision.weight_conversion import read_as_arrays, tensors_digest
from tests.vision.stub_sources import VGG, efficientnet_tensors, vgg_tensors


def plain_vgg(image: torch.Tensor) -> torch.Tensor:
    """relu3_3 [C, h, w] of an image [H, W, 3]."""
    state = vgg_tensors()
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    x = ((image - mean) / std).permute(2, 0, 1)[None]
    for index, _, _ in VGG:
        if index in (5, 10):
            x = F.max_pool2d(x, 2)
        x = F.conv2d(x, state[f"features.{index}.weight"], state[f"features.{index}.bias"], padding=1).relu()
    return x[0]


def plain_efficientnet(pixels: torch.Tensor, blocks: int) -> torch.Tensor:
    """As the reference: batch norms apart, SAME padding by its formula; input [1, 3, H, W] in [-1, 1]."""
    state = efficientnet_tensors()

    def conv(x: torch.Tensor, name: str, norm: str, stride: int = 1, groups: int = 1) -> torch.Tensor:
        kernel = state[f"{name}.weight"].shape[2]
        pads = []
        for side in (x.shape[3], x.shape[2]):
            total = max((math.ceil(side / stride) - 1) * stride + kernel - side, 0)
            pads += [total // 2, total - total // 2]
        y = F.conv2d(F.pad(x, pads), state[f"{name}.weight"], stride=stride, groups=groups)
        parts = [state[f"{norm}.{k}"] for k in ("running_mean", "running_var", "weight", "bias")]
        return F.batch_norm(y, *parts, eps=1e-3)

    x = conv(pixels, "_conv_stem", "_bn0", 2).clamp(0, 6)
    for i, (_, stride, expansion, into, out) in enumerate(convnets.BLOCKS[: blocks + 1]):
        y = x
        if expansion > 1:
            y = conv(y, f"_blocks.{i}._expand_conv", f"_blocks.{i}._bn0").clamp(0, 6)
        y = conv(y, f"_blocks.{i}._depthwise_conv", f"_blocks.{i}._bn1", stride, y.shape[1]).clamp(0, 6)
        y = conv(y, f"_blocks.{i}._project_conv", f"_blocks.{i}._bn2")
        x = x + y if stride == 1 and into == out else y
    return x


def test_vgg_equals_the_plain_network(nets: Path, photo) -> None:
    image = photo(0, 64, 96)
    found = ConvFeatures("vgg16", ConvConfig(size=0), nets)(image)
    assert found.shape == (16, 24, 256)
    assert torch.allclose(found, plain_vgg(image).permute(1, 2, 0), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("layer", "blocks", "shape"), [("stride8", 4, (8, 12, 40)), ("stride4", 2, (16, 24, 24))]
)
def test_efficientnet_equals_the_plain_network(
    nets: Path, photo, layer: str, blocks: int, shape: tuple[int, ...]
) -> None:
    image = photo(1, 64, 96)
    features = ConvFeatures("efficientnet-lite0", ConvConfig(layer=layer), nets)
    found = features(image)
    assert found.shape == shape
    pixels = (image.permute(2, 0, 1)[None] * 255 - 127) / 128
    moved = features.stride // 2
    pixels = F.pad(pixels, (moved, 0, moved, 0), mode="replicate")[:, :, :64, :96]
    expected = plain_efficientnet(pixels, blocks)[0].permute(1, 2, 0)
    assert torch.allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_cell_sees_the_middle_of_its_pixels(nets: Path, name: str) -> None:
    """Otherwise masks on the grid lie beside the objects: without the shift by 4 px, 3.5 px beside them."""
    features = ConvFeatures(name, ConvConfig(size=0), nets)
    row = column = 48 // features.stride
    weight = torch.zeros(96, 96, dtype=torch.float64)
    for seed in range(4):  # noise: a max pool over equal values always takes the first
        noise = torch.rand(96, 96, 3, generator=torch.Generator().manual_seed(seed))
        image = (0.4 + 0.2 * noise).requires_grad_(True)
        found = features(image)
        (gradient,) = torch.autograd.grad(found[row, column].square().sum(), image)
        weight += gradient.abs().sum(2).double()
    at = torch.arange(96).double() + 0.5
    middle = (row + 0.5) * features.stride
    for axis in (0, 1):
        centre = float((weight.sum(1 - axis) * at).sum() / weight.sum())
        assert abs(centre - middle) < 1.0, centre


@pytest.mark.parametrize("name", NETWORKS)
def test_sizes_and_gradients(nets: Path, photo, name: str) -> None:
    features = ConvFeatures(name, ConvConfig(size=64), nets)
    image = photo(2, 90, 130).requires_grad_(True)
    found = features(image)
    assert found.shape[:2] == features.grid(90, 130) and found.shape[2] == features.channels
    (gradient,) = torch.autograd.grad(found.sum(), image)
    assert gradient.shape == image.shape and bool((gradient != 0).any())
    assert not features(image.detach()).requires_grad
    assert all(not p.requires_grad for p in features.model.parameters())
    assert ConvFeatures(name, ConvConfig(size=64), nets).name == features.name
    assert ConvFeatures(name, ConvConfig(size=72), nets).name != features.name


# Blocks 4 and 10 of package efficientnet-lite-pytorch 0.1.0 with the published weights (torch 2.13.0, CPU):
# channels 0 to 5 of cell (1, 2), and the mean of all magnitudes
PUBLISHED = {
    "stride8": ((-1.75241, 8.38766, -3.69097, -13.24115, 1.75768, -1.42979), 7.734275),
    "stride16": ((7.17772, -2.25251, 8.18438, 1.45713, 9.71202, 2.83107), 4.59049),
}


@pytest.mark.usefixtures("machine_weights")
@pytest.mark.parametrize("layer", PUBLISHED)
def test_the_published_network_gives_the_values_of_the_reference_package(layer: str) -> None:
    if weight_registry.weight_path(weight_registry.get_weight("efficientnet-lite0")) is None:
        pytest.skip(f"weights missing; run: {weight_registry.get_command('efficientnet-lite0')}")
    rows, columns = np.mgrid[0:64, 0:96].astype(np.float64)
    waves = [0.5 + 0.4 * np.sin(rows / 5 + k) * np.cos(columns / (7 + k)) for k in range(3)]
    pixels = torch.from_numpy(np.stack(waves).astype(np.float32))[None]
    with torch.no_grad():
        found = ConvFeatures("efficientnet-lite0", ConvConfig(layer=layer)).model((pixels * 255 - 127) / 128)
    values, mean = PUBLISHED[layer]
    assert found[0, :6, 1, 2].tolist() == pytest.approx(values, abs=2e-3)
    assert float(found.abs().mean()) == pytest.approx(mean, rel=1e-4)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("damage", ["missing", "shape", "cut", "pickle", "infinite"])
def test_files_of_another_network_are_named(tmp_path: Path, name: str, damage: str, photo) -> None:
    tensors = vgg_tensors() if name == "vgg16" else efficientnet_tensors()
    key = next(k for k in tensors if k.endswith("weight") and tensors[k].ndim == 4)
    path = tmp_path / weight_registry.get_weight(name).files[0]
    if damage == "missing":
        del tensors[key]
    elif damage == "shape":
        tensors[key] = tensors[key][:5].clone()
    save_file(tensors, path)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:2000])
    elif damage == "infinite":
        save_file(tensors | {key: torch.full_like(tensors[key], float("inf"))}, path)
    elif damage == "pickle":
        torch.save({"a": Path("x")}, path)
    words = {"missing": f"is not {name}", "shape": f"is not {name}", "infinite": "not finite, in tensor"}
    with pytest.raises(
        AwError, match=f"{words.get(damage, 'cannot be read')}.*aw weights get {name}"
    ) as error:
        ConvFeatures(name, None, tmp_path)(photo(0, 40, 40))
    assert "\n" not in str(error.value)
    with pytest.raises(AwError, match=f"has no {path.name}"):
        ConvFeatures(name, None, tmp_path / "absent")


@pytest.mark.parametrize("name", NETWORKS)
def test_the_registered_place_holds_the_published_network_and_a_folder_any(
    nets: Path, own: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    weight = weight_registry.get_weight(name)
    path = own / name / weight.files[0]
    path.parent.mkdir(parents=True)
    shutil.copy(nets / path.name, path)
    with pytest.raises(AwError, match=f"{path} holds other tensors.*; run: aw weights get {name}"):
        _ = ConvFeatures(name).model
    assert ConvFeatures(name, None, path.parent).model is not None
    published = dataclasses.replace(weight, tensors=tensors_digest(read_as_arrays(path)))
    monkeypatch.setattr(weight_registry, "get_weight", lambda _: published)
    assert ConvFeatures(name).model is not None


def test_a_file_of_torch_in_the_registered_place_has_the_hash_of_its_name(own: Path) -> None:
    own.mkdir()
    torch.save(vgg_tensors(), own / "vgg16-397923af.pth")
    with pytest.raises(
        AwError, match=r"vgg16-397923af\.pth does not have the sha256 of its name; run: aw weights"
    ):
        _ = ConvFeatures("vgg16").model
