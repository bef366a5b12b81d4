"""AsymGS with two models: the terms by hand, and what a run makes of them."""

from types import SimpleNamespace

import pytest
import torch

from ambiguous_wild.methods.asymgs import TWIN, HardMask, TwinConfig, TwinField
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.fields import STATIC
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.rendered import Frame
from tests.methods.baselines import data_of, parts_of, trained, trainer_of


@pytest.fixture
def twin(scene, tmp_path):
    data = data_of(scene, tmp_path / "cache")
    masks = HardMask(TwinConfig())
    masks.setup(data)
    fields = TwinField(TwinConfig(), masks)
    fields.data = data
    return fields


def frames(first, second):
    alpha = torch.ones(first.shape[:2])
    return {STATIC: Frame(first, alpha, lambda: alpha), TWIN: Frame(second, alpha, lambda: alpha)}


def test_pictures_are_drawn_to_each_other_after_the_warm_up(twin):
    first = torch.full_like(twin.data.photos[0], 0.5)
    second = first.clone()
    second[:, :32] += 0.1
    context = SimpleNamespace(nominal=1001.0, camera=twin.data.cameras[0], downsampling=1)
    found = twin.regularise(frames(first, second), context)
    each = 1.0 / first.numel()
    assert found[STATIC].image[:, :32].unique().tolist() == pytest.approx([-each])
    assert found[TWIN].image[:, :32].unique().tolist() == pytest.approx([each])
    assert not found[STATIC].image[:, 32:].any() and not found[TWIN].image[:, 32:].any()
    early = twin.regularise(frames(first, second), SimpleNamespace(**vars(context) | {"nominal": 1000.0}))
    assert not early[STATIC].image.any() and not early[TWIN].image.any()


def test_the_second_model_learns_its_own_photo_under_its_own_mask(twin):
    view, first = 2, torch.full_like(twin.data.photos[0], 0.5)
    soft = torch.sigmoid(8 * twin.masks.soft[view].values[0]).clone()
    camera = twin.data.cameras[view]
    twin._second = camera
    photo = twin.data.photos[view]
    context = SimpleNamespace(nominal=500.0, view=view, camera=camera, photo=photo, downsampling=1)
    found = twin.regularise(frames(first, first), context)
    keep = torch.nn.functional.interpolate(soft[None, None], size=first.shape[:2], mode="bilinear")[0, 0]
    wanted = photometric(first, photo, keep).d_image
    assert torch.allclose(found[TWIN].image, wanted, atol=1e-9) and wanted.abs().sum() > 0
    assert not found[STATIC].image.any()
    after = torch.sigmoid(8 * twin.masks.soft[view].values[0])
    assert not torch.equal(after, soft)  # the map was learnt, after it was used


def test_the_learnt_masks_weigh_the_second_model_alone(twin):
    hard = twin.masks
    step = SimpleNamespace(
        iteration=1, view=0, photo=twin.data.photos[0],
        rendered=SimpleNamespace(image=torch.full_like(twin.data.photos[0], 0.5)),
    )  # fmt: skip
    assert torch.equal(hard.keep(step), hard.hard_keep(step)) and hard.cotangent(step, None) is None


def make():
    growth = {"density.every": "2000", "density.min_every": "10", "density.grow_scale": "0.001"}
    return parts_of("asymgs-twin", **growth)


def test_both_models_learn_and_grow_and_differ(scene, tmp_path):
    trainer = trained(scene, tmp_path, make())
    other = trainer.drawing.others[TWIN]
    assert sum(r.split for r in trainer.density.log.rounds) > 0
    assert sum(r.split for r in other.density.log.rounds) > 0
    assert len(other.gaussians) == other.density.log.rounds[-1].count
    camera = trainer.data.cameras[0]
    first = trainer.drawing._draw(trainer.gaussians, trainer.context(camera), None).image
    second = trainer.drawing._draw(other.gaussians, trainer.context(camera), None).image
    assert 0.0 < float((first - second).abs().mean()) < 0.1
    assert torch.equal(trainer.render(camera).image, first)  # the result is the first model


def test_the_second_view_moves_no_camera_of_the_first(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path, with_effects(make(), ("poses", "appearance")))
    found = trainer.hooks.fields.gradients(trainer.make_step(100, 0), None)[STATIC]
    assert found.means.any() and not found.effect_grads


def test_both_models_grow_under_effects_and_keep_their_skybox(scene, tmp_path):
    trainer = trained(scene, tmp_path, with_effects(make(), ("exposure", "skybox")))
    other = trainer.drawing.others[TWIN]
    first = trainer.effects.facts()["skybox"]["points"]
    assert sum(r.split for r in other.density.log.rounds) > 0 and first > 0
    for field in (trainer.field, other):
        assert int(field.density.protected(field.gaussians.means).sum()) == first
