"""LPIPS on random weights saved in the published layout, against a plain numpy computation."""

from __future__ import annotations

import functools
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from safetensors.torch import save_file

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics import lpips
from tests.metrics.pairs import pairs

ALEX_CONVS = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
VGG_CHANNELS = {
    0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128), 10: (256, 128), 12: (256, 256), 14: (256, 256),
    17: (512, 256), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512),
}  # fmt: skip
VGG_CONVS = {i: (out, into, 3) for i, (out, into) in VGG_CHANNELS.items()}
CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


def backbone(convs: dict[int, tuple[int, int, int]], seed: int) -> dict[str, torch.Tensor]:
    """A random backbone file: convolutions, and a classifier that must be ignored."""
    g = torch.Generator().manual_seed(seed)
    state = {}
    for i, (out, into, k) in convs.items():
        state[f"features.{i}.weight"] = torch.randn(out, into, k, k, generator=g) * math.sqrt(
            2 / (into * k * k)
        )
        state[f"features.{i}.bias"] = 0.1 * torch.randn(out, generator=g)
    return state | {"classifier.6.bias": torch.zeros(1000)}


def heads(kind: str, seed: int) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {
        f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1, generator=g) for i, c in enumerate(CHANNELS[kind])
    }


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    torch.save(backbone(ALEX_CONVS, 1), folder / "alexnet-owt-7be5be79.pth")
    torch.save(backbone(VGG_CONVS, 2), folder / "vgg16-397923af.pth")
    torch.save(heads("alex", 3), folder / "lpips_alex.pth")
    torch.save(heads("vgg", 4), folder / "lpips_vgg.pth")
    return folder


@pytest.fixture(autouse=True)
def no_weights_of_the_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path / "none"))


def pictures(height: int, width: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = rng.random((height, width, 3))
    return a, np.clip(a + 0.3 * rng.standard_normal(a.shape), 0, 1)


@functools.lru_cache(maxsize=1)
def convolutions(folder: Path, kind: str) -> dict[str, np.ndarray]:
    name = "alexnet-owt-7be5be79.pth" if kind == "alex" else "vgg16-397923af.pth"
    return {k: v.double().numpy() for k, v in torch.load(folder / name, weights_only=True).items()}


def naive(folder: Path, kind: str, a: np.ndarray, b: np.ndarray, *, centred: bool) -> float:
    """LPIPS v0.1 in float64 without torch's layers: metrics.md, equation 4."""
    state = convolutions(folder, kind)
    linear = torch.load(folder / f"lpips_{kind}.pth", weights_only=True)
    total = 0.0
    for level, (f, g) in enumerate(
        zip(naive_taps(state, kind, a, centred), naive_taps(state, kind, b, centred))
    ):
        w = linear[f"lin{level}.model.1.weight"].double().numpy().reshape(-1, 1, 1)
        f, g = (x / (np.sqrt((x**2).sum(axis=0)) + 1e-10) for x in (f, g))
        total += float((w * (f - g) ** 2).sum(axis=0).mean())
    return total


def naive_taps(state: dict[str, np.ndarray], kind: str, image: np.ndarray, centred: bool) -> list[np.ndarray]:
    x = (2 * image - 1 if centred else image).transpose(2, 0, 1)
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x = (x - shift[:, None, None]) / scale[:, None, None]
    convs = ALEX_CONVS if kind == "alex" else VGG_CONVS
    pools = {2, 5} if kind == "alex" else {4, 9, 16, 23}
    pool = (3, 2) if kind == "alex" else (2, 2)
    taps = (
        {0: True, 3: True, 6: True, 8: True, 10: True}
        if kind == "alex"
        else dict.fromkeys((2, 7, 14, 21, 28))
    )
    found = []
    for i in range(max(convs) + 1):
        if i in pools:
            k, s = pool
            rows, cols = (x.shape[1] - k) // s + 1, (x.shape[2] - k) // s + 1
            x = np.stack(
                [
                    x[:, r : r + rows * s : s, c : c + cols * s : s][:, :rows, :cols]
                    for r in range(k)
                    for c in range(k)
                ]
            ).max(axis=0)
        if i in convs:
            weight, bias = state[f"features.{i}.weight"], state[f"features.{i}.bias"]
            pad, stride = {11: (2, 4), 5: (2, 1), 3: (1, 1)}[weight.shape[2]]
            padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
            windows = sliding_window_view(padded, weight.shape[2:], axis=(1, 2))[:, ::stride, ::stride]
            y = np.tensordot(weight, windows, axes=([1, 2, 3], [0, 3, 4]))
            x = np.maximum(y + bias[:, None, None], 0)
            if i in taps:
                found.append(x)
    return found


def test_identity_symmetry_and_number_types(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AW_WEIGHTS", str(weights))
    rng = np.random.default_rng(5)
    a, b = (rng.integers(0, 256, (40, 33, 3), dtype=np.uint8) for _ in range(2))
    for name in lpips.VARIANTS:
        metric = lpips.load(name)
        assert metric(a, a) == 0.0
        assert metric(a, b) == metric(b, a) > 0.0
        assert metric(a, b) == pytest.approx(metric(a / 255.0, b / 255.0), rel=1e-6)


def test_smallest_pictures(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AW_WEIGHTS", str(weights))
    for name, side in (("lpips_alex", 31), ("lpips_vgg", 16)):
        metric = lpips.load(name)
        assert metric(*pictures(side, 40)) > 0.0
        with pytest.raises(AwError, match=f"at least {side} px"):
            metric(*pictures(side - 1, 40))


def test_without_weights_every_variant_says_which_command_downloads_them() -> None:
    reasons = lpips.available()
    assert list(reasons) == ["lpips_alex", "lpips_vgg", "lpips_vgg_01"]
    assert (
        reasons["lpips_alex"]
        == "weights missing: alexnet, lpips-alex; run: aw weights get alexnet lpips-alex"
    )
    for name, reason in reasons.items():
        with pytest.raises(AwError) as error:
            lpips.load(name)
        assert str(error.value) == reason
    with pytest.raises(AwError, match="lpips_alex"):
        lpips.load("lpips_alexnet")


def test_one_of_two_files_is_not_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path
) -> None:
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path))
    (tmp_path / "lpips_alex.pth").write_bytes((weights / "lpips_alex.pth").read_bytes())
    assert lpips.available()["lpips_alex"] == "weights missing: alexnet; run: aw weights get alexnet"
    hub = tmp_path / "torch" / "hub" / "checkpoints"
    hub.mkdir(parents=True)
    (hub / "alexnet-owt-7be5be79.pth").write_bytes((weights / "alexnet-owt-7be5be79.pth").read_bytes())
    assert lpips.available()["lpips_alex"] is None
    assert lpips.available()["lpips_vgg"] is not None


def test_safetensors_give_what_the_published_files_give(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path
) -> None:
    a, b = pictures(33, 40)
    monkeypatch.setenv("AW_WEIGHTS", str(weights))
    expected = lpips.load("lpips_alex")(a, b)
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path))
    for name, file, made in (
        ("alexnet", "alexnet-owt-7be5be79.pth", "alexnet.safetensors"),
        ("lpips-alex", "lpips_alex.pth", "lpips_alex.safetensors"),
    ):
        (tmp_path / name).mkdir()
        save_file(torch.load(weights / file, weights_only=True), tmp_path / name / made)
    assert lpips.load("lpips_alex")(a, b) == expected


@pytest.mark.parametrize("damage", ["cut", "other", "heads", "pickle"])
def test_unusable_files_are_named(
    damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path
) -> None:
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path))
    trunk, head = tmp_path / "alexnet-owt-7be5be79.pth", tmp_path / "lpips_alex.pth"
    trunk.write_bytes((weights / trunk.name).read_bytes())
    head.write_bytes((weights / head.name).read_bytes())
    if damage == "cut":
        trunk.write_bytes(trunk.read_bytes()[:5000])
    elif damage == "other":
        torch.save({k: v for k, v in backbone(ALEX_CONVS, 1).items() if "features.10" not in k}, trunk)
    elif damage == "heads":
        torch.save(heads("vgg", 3), head)
    else:
        torch.save({"lin0.model.1.weight": Path("code in a pickle")}, head)
    with pytest.raises(AwError, match=head.name if damage in ("heads", "pickle") else trunk.name):
        lpips.load("lpips_alex")


def test_a_replaced_file_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path
) -> None:
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path))
    for name in ("alexnet-owt-7be5be79.pth", "lpips_alex.pth"):
        (tmp_path / name).write_bytes((weights / name).read_bytes())
    a, b = pictures(32, 32)
    before = lpips.load("lpips_alex")(a, b)
    torch.save({k: 2 * v for k, v in heads("alex", 3).items()}, tmp_path / "lpips_alex.pth")
    assert lpips.load("lpips_alex")(a, b) == pytest.approx(2 * before, rel=1e-5)


def test_import_and_availability_do_not_load_torch() -> None:
    code = (
        "import sys; from ambiguous_wild.metrics import lpips; "
        "lpips.available(); print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("variant", ["lpips_alex", "lpips_vgg", "lpips_vgg_01"])
def test_random_and_hard_pairs_equal_the_plain_computation(
    variant: str, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AW_WEIGHTS", str(weights))
    kind, side = ("alex", 31) if variant == "lpips_alex" else ("vgg", 16)
    metric = lpips.load(variant)
    for name, (a, b) in pairs(side).items():
        # the plain computation is slow: no picture is larger than it must be
        a, b = a[: side + 1, : side + 1], b[: side + 1, : side + 1]
        expected = naive(weights, kind, a / 255.0, b / 255.0, centred=variant != "lpips_vgg_01")
        assert metric(a, b) == pytest.approx(expected, abs=1e-4), name
