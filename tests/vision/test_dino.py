import json
from pathlib import Path

import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.dino import DinoConfig, DinoFeatures

KINDS = {"dinov2": (14, 1), "registers": (14, 5), "dinov1": (8, 1)}  # patch, tokens that are no patch


def imagenet(image: torch.Tensor) -> torch.Tensor:
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    return ((image - mean) / std).permute(2, 0, 1)[None]


@pytest.mark.parametrize("kind", KINDS)
def test_whole_patches_equal_the_library_itself(checkpoint, photo, kind):
    patch, extra = KINDS[kind]
    features = DinoFeatures(kind, DinoConfig(size=0), checkpoint(kind))
    image = photo(0, 4 * patch, 6 * patch)
    call = {"interpolate_pos_encoding": True} if kind == "dinov1" else {}
    with torch.no_grad():
        tokens = features.model(imagenet(image), **call).last_hidden_state[0, extra:]
        phi = features(image)
    assert phi.shape == (4, 6, 32) and phi.dtype == torch.float32
    for row in range(4):  # row by row: patches run along the width first
        assert torch.equal(phi[row], tokens[row * 6 : row * 6 + 6])
    raw = DinoFeatures(kind, DinoConfig(size=0, normalise="raw"), checkpoint(kind))
    assert not torch.allclose(raw(image), phi, atol=1e-2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("height, width, size", [(135, 240, 126), (97, 61, 0), (50, 333, 100), (200, 9, 70)])
def test_any_size_is_seen_whole(checkpoint, photo, kind, height, width, size):
    patch, _ = KINDS[kind]
    features = DinoFeatures(kind, DinoConfig(size=size), checkpoint(kind))
    image = photo(1, height, width).requires_grad_(True)
    phi = features(image)
    assert phi.shape[:2] == features.grid(height, width)
    longer = size or max(height, width)
    assert (
        abs(max(phi.shape[:2]) * patch - longer) <= patch / 2
    )  # nearest whole patch, never below by cutting
    cotangent = torch.randn(phi.shape, generator=torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad((phi * cotangent).sum(), image)
    assert torch.isfinite(gradient).all()
    # the last row and column, which the library would have cut, matter
    for edge in (gradient[0], gradient[-1], gradient[:, 0], gradient[:, -1]):
        assert float(edge.abs().max()) > 0.0
    assert all(p.grad is None for p in features.model.parameters())


def test_a_cell_is_its_share_of_the_image(checkpoint, photo):
    """What changes in a corner changes the features of that corner most, at a size of no whole patches."""
    features = DinoFeatures("dinov2", DinoConfig(size=140, blocks=1), checkpoint("dinov2"))
    one = photo(2, 101, 171)
    for rows, columns, corner in [
        (slice(0, 8), slice(0, 8), (0, 0)),
        (slice(-8, None), slice(-8, None), (-1, -1)),
    ]:
        two = one.clone()
        two[rows, columns] = 1.0 - two[rows, columns]
        change = (features(one) - features(two)).norm(dim=2)
        assert float(change[corner]) == float(change.max())


@pytest.mark.parametrize("kind", KINDS)
def test_fewer_blocks_are_the_normed_output_of_that_block(checkpoint, photo, kind):
    patch, extra = KINDS[kind]
    image = photo(3, 3 * patch, 5 * patch)
    whole = DinoFeatures(kind, DinoConfig(size=0), checkpoint(kind)).model
    call = {"interpolate_pos_encoding": True} if kind == "dinov1" else {}
    with torch.no_grad():
        hidden = whole(imagenet(image), output_hidden_states=True, **call).hidden_states
        expected = whole.layernorm(hidden[2])[0, extra:].reshape(3, 5, 32)
        found = DinoFeatures(kind, DinoConfig(size=0, blocks=2), checkpoint(kind))(image)
    assert torch.allclose(found, expected, atol=1e-5)


def test_the_name_tells_weights_and_settings_apart(checkpoint, tmp_path: Path):
    folder = checkpoint("dinov2")
    other = tmp_path / "other"
    other.mkdir()
    for file in folder.iterdir():
        data = file.read_bytes()
        (other / file.name).write_bytes(data[:-1] + bytes([data[-1] ^ 1]) if "model" in file.name else data)
    names = {
        DinoFeatures("x", config, where).name
        for where in (folder, other)
        for config in (DinoConfig(), DinoConfig(size=70), DinoConfig(blocks=1), DinoConfig(normalise="raw"))
    }
    assert len(names) == 8
    assert DinoFeatures("x", folder=folder).name in names


def test_impossible_settings_are_refused(checkpoint):
    folder = checkpoint("dinov2")
    with pytest.raises(AwError, match="has 3 blocks"):
        DinoFeatures("x", DinoConfig(blocks=4), folder)
    with pytest.raises(AwError, match="at least one cell of 14 px"):
        DinoFeatures("x", DinoConfig(size=13), folder)


def test_what_a_config_leaves_unsaid_is_what_the_library_assumes(checkpoint, tmp_path: Path):
    from transformers import Dinov2Config, Dinov2WithRegistersConfig, ViTConfig

    for kind, cls in (
        ("dinov2", Dinov2Config),
        ("registers", Dinov2WithRegistersConfig),
        ("dinov1", ViTConfig),
    ):
        bare = tmp_path / kind
        bare.mkdir()
        (bare / "config.json").write_text(json.dumps({"model_type": cls().model_type}))
        (bare / "model.safetensors").write_bytes((checkpoint(kind) / "model.safetensors").read_bytes())
        features = DinoFeatures(kind, folder=bare)
        library = cls()
        assert features.patch == library.patch_size
        assert features.channels == library.hidden_size
        assert features.extra_tokens == 1 + getattr(library, "num_register_tokens", 0)
