"""WildGaussians: its appearance by hand, what it carries, and what its uncertainty masks."""

import numpy as np
import pytest
import torch

from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.methods.wildgaussians import (
    GAUSSIAN,
    PHOTO,
    UncertaintyHead,
    WildAppearance,
    WildGaussiansConfig,
    fourier,
    uncertainty_loss,
)
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects.autograd_effect import VisibleGaussians
from ambiguous_wild.splat.step import ViewContext
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train
from tests.methods.baselines import masked_more_inside, parts_of, trainer_of
from tests.splat.scenes import camera
from tests.tiny_scene import write_tiny_scene


def test_fourier_features_by_hand():
    means = torch.tensor([[-1.0, 0.0, 2.0], [1.0, 0.0, -2.0], [0.0, 0.0, 0.0]])
    found = fourier(means, means)
    assert torch.equal(fourier(means[1:], means), found[1:])  # of what is scaled, the rest has no say
    assert found.shape == (3, GAUSSIAN) == (3, 24)
    spread = np.quantile([1.0, 1.0, 0.0], 0.97)
    unit = 0.5 * 1.0 / spread + 0.5  # of the second point's x
    for k in range(4):
        assert found[1, 3 * k] == pytest.approx(np.sin(2 * np.pi * 2**k * unit), abs=1e-5)
        assert found[1, 12 + 3 * k] == pytest.approx(np.cos(2 * np.pi * 2**k * unit), abs=1e-5)


def test_the_formula_by_hand():
    effect = WildAppearance(WildGaussiansConfig(scale=0.5))
    base, code = torch.tensor([[0.2, 0.4, 0.6]]), torch.full((1, GAUSSIAN), 0.1)
    inputs = 3 + GAUSSIAN + PHOTO
    leaf = {
        "photo": torch.full((PHOTO,), 0.2),
        "net_weight0": torch.ones(inputs, 1), "net_bias0": torch.tensor([0.5]),
        "net_weight1": torch.tensor([[2.0]]), "net_bias1": torch.tensor([-1.0]),
        "net_weight2": torch.tensor([[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]]), "net_bias2": torch.zeros(6),
    }  # fmt: skip
    hidden = 2.0 * (1.2 + 24 * 0.1 + 32 * 0.2 + 0.5) - 1.0  # both layers are positive
    context = ViewContext(iteration=1, nominal=0, view=0, camera=camera())
    found = effect.forward(VisibleGaussians(base, torch.zeros(1, 3), {"wild_embedding": code}), leaf, context)
    # offset on red, gain on green, blue as it was
    expected = torch.tensor([[0.2 + 0.5 * hidden, (1 + 0.5 * hidden) * 0.4, 0.6]])
    torch.testing.assert_close(found, expected)


def test_it_trains_and_carries_its_embeddings(tmp_path):
    scene = load_scene(write_tiny_scene(tmp_path / "scene", distractors=False))

    entry = get_method("wildgaussians")
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=tmp_path)
    config = TrainConfig(iterations=60, probes=0, max_gaussians=500)
    whole = Trainer(data, entry.build(entry.options()), config, folder=tmp_path / "run")
    start = whole.gaussians.attributes["wild_embedding"].clone()
    train(whole)
    after = whole.gaussians.attributes["wild_embedding"]
    assert len(after) == len(whole.gaussians) and not torch.equal(after[: len(start)], start)
    assert whole.effects.facts()["wildgaussians"]["photo_std"] > 0


def test_the_uncertainty_is_least_lossy_where_its_square_is_twice_the_distance():
    distance = torch.tensor([[0.05, 0.3], [0.7, 1.0]])
    best = (distance / 0.5).sqrt()
    at_best = uncertainty_loss(best, distance, 0.5)
    by_hand = (distance / (2 * best**2) + 0.5 * best.log()).mean()
    torch.testing.assert_close(at_best, by_hand)
    for factor in (0.9, 1.1):
        assert uncertainty_loss(factor * best, distance, 0.5) > at_best


def test_the_head_starts_near_one_and_is_never_below_a_tenth():
    features = torch.randn(6, 8, 20, generator=torch.Generator().manual_seed(0)) * 3.0 + 5.0
    head = UncertaintyHead([features], seed=0)
    sigma = head(features, 12, 16).detach()
    assert sigma.shape == (12, 16) and (sigma - 1.0).abs().max() < 0.15
    with torch.no_grad():
        head.bias -= 20.0
    assert head(features, 12, 16).detach().min() == pytest.approx(0.1)


def test_it_masks_what_only_one_photo_shows_and_can_do_without_either_part(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    options = {"width": "8", "mask_start": "0", "min_mask_start": "100"}
    trainer = trainer_of(scene, tmp_path / "run", parts_of("wildgaussians", **options), iterations=300)
    assert trainer.hooks.mask.predict(trainer.make_step(1, 0)) is None  # not begun
    train(trainer)
    inside, outside = masked_more_inside(trainer)
    assert inside < outside - 0.3, (inside, outside)
    alone = parts_of("wildgaussians", appearance="false")
    assert not alone.effects and type(alone.mask).__name__ == "UncertaintyMask"
    colours = parts_of("wildgaussians", masks="false")
    assert colours.effects and type(colours.mask).__name__ == "MaskPolicy"


def test_after_an_opacity_reset_the_head_rests(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    options = {"width": "8", "mask_start": "0", "min_mask_start": "5", "min_reset_pause": "20"}
    trainer = trainer_of(scene, tmp_path / "run", parts_of("wildgaussians", **options))
    policy = trainer.hooks.mask
    for _ in range(10):
        trainer.step()
    policy.on_opacity_reset(trainer.make_step(10, 0))
    before = policy.head.weight.detach().clone()
    for _ in range(9):
        trainer.step()
    assert torch.equal(policy.head.weight, before) and policy.state_dict()["last_reset"] == 10
    for _ in range(30):
        trainer.step()
    assert not torch.equal(policy.head.weight, before)
