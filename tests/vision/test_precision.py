"""Features on an accelerator: bfloat16 in the net alone, alike for photos and renders, and no waiting."""

import pytest
import torch
import torch.nn.functional as F

from ambiguous_wild.vision import dino
from ambiguous_wild.vision.dino import DinoConfig, DinoFeatures
from ambiguous_wild.vision.labhog import LabHog
from ambiguous_wild.vision.precompute import photo_features
from ambiguous_wild.vision.sceneconv import SceneConv
from tests.host_reads import moved, no_transfers

KINDS = ("dinov2", "registers", "dinov1")


@pytest.fixture
def half(monkeypatch):
    """The GPU's precision on the CPU."""
    monkeypatch.setattr(dino, "mixed", lambda device: True)


def cosine_distance(one, two):
    return float((1 - F.cosine_similarity(one, two, dim=2)).max())


def test_a_cpu_stays_in_float32():
    assert not dino.mixed(torch.device("cpu")) and dino.mixed(torch.device("cuda", 0))
    assert SceneConv().precision(torch.device("cpu")) == LabHog().precision(torch.device("cuda")) == ""
    assert SceneConv().precision(torch.device("cuda")) == "tf32"


@pytest.mark.parametrize("kind", KINDS)
def test_features_in_mixed_precision_are_those_in_float32_nearly(checkpoint, photo, monkeypatch, kind):
    features = DinoFeatures(kind, DinoConfig(size=70), checkpoint(kind))
    image = photo(0, 60, 80).requires_grad_(True)
    exact = features(image)
    cotangent = torch.randn(exact.shape, generator=torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad((exact * cotangent).sum(), image)
    monkeypatch.setattr(dino, "mixed", lambda device: True)
    there = DinoFeatures(kind, DinoConfig(size=70), checkpoint(kind))
    found = there(image)
    assert found.dtype == torch.float32 and not torch.equal(found, exact)  # it did run in another precision
    assert cosine_distance(found.detach(), exact.detach()) < 1e-3
    dtypes = {type(m): {p.dtype for p in m.parameters()} for m in there.model.modules()}
    assert dtypes[torch.nn.Linear] == dtypes[torch.nn.Conv2d] == {torch.bfloat16}
    assert dtypes[torch.nn.LayerNorm] == {torch.float32}
    (gradient_there,) = torch.autograd.grad((found * cotangent).sum(), image)
    assert gradient_there.dtype == torch.float32
    assert float(F.cosine_similarity(gradient_there.ravel(), gradient.ravel(), dim=0)) > 0.99
    assert torch.equal(found, there(image))  # the same picture, the same features: no distance to itself
    monkeypatch.undo()
    there._device = torch.device("meta")  # as if it had been elsewhere: the weights are read again
    assert torch.equal(there(image), exact)


def test_no_graph_is_kept_where_no_gradient_is_asked_for(checkpoint, photo, half):
    features = DinoFeatures("dinov2", DinoConfig(size=70), checkpoint("dinov2"))
    assert not features.model.training and not features(photo(0, 60, 80)).requires_grad
    with torch.no_grad():
        assert not features(photo(0, 60, 80).requires_grad_(True)).requires_grad
    assert torch.is_grad_enabled()


def test_photos_are_cached_by_precision(checkpoint, photo, monkeypatch, tmp_path):
    features = DinoFeatures("dinov2", DinoConfig(size=70), checkpoint("dinov2"))
    image = photo(0, 60, 80)
    exact = photo_features(features, [image], tmp_path)[0]
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(dino, "mixed", lambda device: True)
    assert features.precision(image.device) == "bfloat16"
    found = photo_features(features, [image], tmp_path)[0]
    assert len(list(tmp_path.iterdir())) == 2
    assert torch.equal(found, features(image)) and not torch.equal(found, exact)
    assert torch.equal(photo_features(features, [image], tmp_path)[0], found)
    monkeypatch.setattr(dino, "mixed", lambda device: False)
    assert torch.equal(photo_features(features, [image], tmp_path)[0], exact)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("kind", ["labhog", "sceneconv", *KINDS])
def test_features_of_a_render_leave_the_host_alone(backend, photo, kind):
    features = backend(kind)
    features.fit([photo(1, 60, 80)])
    shape = features(photo(0, 60, 80)).shape
    features, image = moved([features, photo(0, 60, 80)])
    features(image)  # constants are copied at their first use
    with no_transfers():
        assert features(image).shape == shape
        image.requires_grad_(True)
        found = features(image)
        assert found.device.type == "meta" and found.dtype == torch.float32
        (gradient,) = torch.autograd.grad(found.sum(), image)
        assert gradient.shape == image.shape
