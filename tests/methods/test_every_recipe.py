"""Every method is saved and resumed to the same bits; recipes that learn from photos fit test photos."""

import pytest
import torch

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.builtin import BUILTIN
from ambiguous_wild.methods.uad import UncertaintyAwareDensity
from ambiguous_wild.splat.effects import effect_pipeline
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train
from tests.methods.baselines import parts_of, trainer_of
from tests.splat import fake_gsplat
from tests.splat.scenes import same
from tests.splat.test_whole_step import late
from tests.tiny_scene import with_points

# recipes whose effects or masks learn from each photo, and options that make them small
RECIPES = {
    "gs-w": {"side": "32", "width": "4"},
    "wildgaussians": {"width": "8", "mask_start": "0"},
    "splatfacto-w": {"width": "16"},
    "swag": {"levels": "2", "entries": "256", "width": "8"},
    "nexussplats": {"light_width": "8", "doubt_width": "8"},
    "hybridgs": {"points": "60", "apart": "5000"},
    "t-3dgs": {"min_mask_start": "10"},
    "forestsplats": {"points": "400", "width": "8", "side": "32", "appearance": "true"},
}
# every method, in a run of 20 iterations: growth and masks before and after the eleventh
GROWN = {"density.every": "3000", "density.min_every": "2"}
ITSELF = {"every": "3000", "min_every": "2"}  # methods that are density control
MASKED = {"min_mask_start": "4"}
HAND_MADE = {"features": "labhog", "instances": "graph", "psi.steps": "30"}
RESUMED: dict[str, dict[str, str]] = {
    "3dgs": {},
    "3dgs+truth": {},
    "refinesplat": {**GROWN, **MASKED, "min_reset_pause": "2"},
    "refinesplat-paper": {**GROWN, **MASKED, **HAND_MADE},
    "refinesplat-printed": {**GROWN, **MASKED, **HAND_MADE},
    "robustsplat": {**GROWN, **MASKED},
    "dronesplat": {**GROWN, **MASKED},
    "absgs": {**ITSELF, "clamp_every": "6000", "min_clamp_every": "4"},
    "mcmc": {**ITSELF, "max_gaussians": "450"},
    "pup-3dgs": {**ITSELF, "prune_at": "20000", "rounds": "1", "share": "0.75", "divisor": "2", "signs": "2"},
    "uad": ITSELF,
    "mip-splatting": {**GROWN, "growth": "absolute"},
    "desplat": {**GROWN, "points": "100", "min_start": "0"},
    "asymgs": {**GROWN, "density.grow_scale": "0.001"},
    "asymgs-twin": {**GROWN, "density.grow_scale": "0.001"},
    "spotlesssplats": {**GROWN, "clusters": "30"},
    "spotlesssplats-cluster": {**GROWN, "clusters": "30"},
    **{name: options | GROWN for name, options in RECIPES.items()},
    "wildgaussians": {**RECIPES["wildgaussians"], **MASKED},
    "3dgs@mask=robustsplat,density=refinesplat,regulariser=refinesplat": {
        "mask.min_mask_start": "4",
        "regulariser.min_mask_start": "4",
        "regulariser.lambda_cr": "0.2",
        "regulariser.lambda_id": "0.01",
        "regulariser.psi.steps": "30",
    },
}
CPU_ALONE = {"uad": "count"}


@pytest.fixture(scope="module")
def sparse(scene):
    return with_points(load_scene(scene), 60)


def test_every_method_is_resumed():
    """But those that need what the tiny scene lacks, and are made of parts that are here."""
    assert {entry.name for entry in BUILTIN} - {"3dgs+motion", "3dgs-clean"} <= RESUMED.keys()


@pytest.fixture(scope="module", params=RESUMED)
def runs(request, scene, tmp_path_factory):
    """The method; a run of it without a stop, one whose state is asked for at every step, one resumed."""
    folder = tmp_path_factory.mktemp("runs")

    def trainer(name: str) -> Trainer:
        parts = parts_of(request.param, **RESUMED[request.param])
        return trainer_of(scene, folder / name, parts, iterations=20)

    whole, saved = trainer("whole"), trainer("saved")
    train(whole)
    while saved.iteration < 11:
        saved.step()
        saved.state()
    saved.save()
    again = trainer("saved")
    assert again.resume() and again.iteration == 11
    while saved.iteration < 20:
        saved.step()
        saved.state()
    train(again)
    return request.param, whole, saved, again


def test_resuming_gives_the_same_bits(runs):
    """All of the state: Gaussians, other fields, optimisers, masks, effects, density control."""
    method, whole, _, again = runs
    assert differing(whole, again) == []
    assert whole.hooks.mask.facts() == again.hooks.mask.facts()
    if RESUMED[method].keys() & {"every", "density.every"}:
        assert any(r.split or r.cloned or r.pruned for r in whole.density.log.rounds)


def test_saving_changes_nothing(runs):
    """To save makes Adam's postponed updates at once: rows that nobody saw must not be drawn without them."""
    _, whole, saved, _ = runs
    assert differing(whole, saved) == []


@pytest.mark.parametrize("runs", RECIPES, indirect=True)
def test_a_test_photo_is_fitted_by_its_left_half(runs, monkeypatch):
    monkeypatch.setattr(effect_pipeline, "FIT_STEPS", 12)
    trainer = runs[1]
    camera, photo = trainer.data.cameras[0], trainer.data.photos[0]
    left = torch.zeros(photo.shape[:2])
    left[:, : photo.shape[1] // 2] = 1.0
    assert torch.isfinite(trainer.render(camera).image).all()
    fitted = trainer.render_fitted(camera, photo, left)
    assert torch.isfinite(fitted).all()
    # what lies right of the middle of a test photo is not looked at
    other = photo.clone()
    other[:, photo.shape[1] // 2 :] = 0.5
    assert torch.equal(trainer.render_fitted(camera, other, left), fitted)


def differing(one: Trainer, other: Trainer) -> list[str]:
    """Paths in the state at which the two runs are not the same bits."""
    left, right = flat(kept(one)), flat(kept(other))
    assert left.keys() == right.keys()
    return [path for path, value in left.items() if not same(value, right[path])]


def kept(trainer):
    """The checkpoint without what a clock decides."""
    names = ("gaussians", "extra", "optimiser", "fields", "mask", "effects")
    return {name: value for name, value in trainer.state().items() if name in names}


def flat(state, name=""):
    """Nested dicts and lists as one dict, by path."""
    if not isinstance(state, dict | list | tuple):
        return {name: state}
    items = state.items() if isinstance(state, dict) else enumerate(state)
    return {path: value for key, held in items for path, value in flat(held, f"{name}/{key}").items()}


@pytest.mark.parametrize("host", ["forestsplats", "desplat", "hybridgs"])
def test_density_control_gets_the_masks_of_a_composite(scene, tmp_path, monkeypatch, host):
    """Such a method weighs no loss by `keep`; UAD reads what its composite weighs."""
    given = []
    own = UncertaintyAwareDensity.observe

    def observe(self, step, gradients, keep=None):
        given.append(None if keep is None else float(keep.mean()))
        own(self, step, gradients, keep)

    monkeypatch.setattr(UncertaintyAwareDensity, "observe", observe)
    small = {"forestsplats": {"points": "40", "width": "8", "side": "32"}, "hybridgs": {"points": "60"}}
    options = {**small.get(host, {}), **({"apart": "1", "joint": "2"} if host == "hybridgs" else {})}
    options |= {"min_start": "0"} if host == "desplat" else {}
    parts = parts_of(f"{host}@density=uad", **{f"host.{k}": v for k, v in options.items()})
    trainer = trainer_of(scene, tmp_path / "run", parts)
    for _ in range(6):
        trainer.step()
    assert given and None not in given[1:]
    assert all(0 <= value < 1 for value in given[1:])


@pytest.mark.parametrize("method", ["gs-w", "splatfacto-w", "nexussplats", "hybridgs", "forestsplats"])
def test_masks_that_read_an_effect_are_not_grafted_without_it(scene, tmp_path, method):
    fields = method == "forestsplats"  # its masks belong to its fields: the effects alone would not do
    message = f"use {method} as the host" if fields else f"masks of {method} need its effects: add effects="
    with pytest.raises(AwError, match=message):
        parts_of(f"3dgs@mask={method}")
    # and where parts are put together by hand
    with pytest.raises(AwError, match=f"masks of {method} need its effects"):
        trainer_of(scene, tmp_path, MethodHooks(mask=parts_of(method).mask))


@pytest.mark.parametrize("method", sorted(entry.name for entry in BUILTIN))
def test_what_a_mask_policy_reads_is_an_effect_of_its_method(method):
    parts = parts_of(method)
    read = [parts.mask.required_effect(), parts.mask.loss_effect()]
    read += [] if parts.fields is None else [parts.fields.required_effect()]
    assert all(effect is None or any(effect is own for own in parts.effects) for effect in read)


@pytest.mark.parametrize("method", ["gs-w", "nexussplats"])
def test_masks_are_grafted_with_the_effect_that_they_read(scene, tmp_path, method):
    parts = parts_of(f"3dgs@mask={method},effects={method}")
    trainer = trainer_of(scene, tmp_path, parts)
    learnt = {"gs-w": "mask_weight1", "nexussplats": "uncertainty_weight2"}[method]
    before = parts.effects[0]._adam[learnt].values.clone()
    for _ in range(12):  # of 120: masks begin at a twelfth
        trainer.step()
    assert not torch.equal(parts.effects[0]._adam[learnt].values, before)
    assert not parts.mask.mask.regularises()


@pytest.mark.parametrize("method", CPU_ALONE)
def test_what_gsplat_does_not_offer_is_refused_in_one_line(sparse, tmp_path, monkeypatch, method):
    with (
        fake_gsplat.installed(monkeypatch),
        pytest.raises(AwError, match=f"{CPU_ALONE[method]}.*gsplat.*--device cpu"),
    ):
        late(sparse, tmp_path, method)
