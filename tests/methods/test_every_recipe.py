"""Every recipe draws test views, resumes to the same bits, and does not make an accelerator's host wait."""

import pytest
import torch

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.builtin import BUILTIN
from ambiguous_wild.methods.uad import UncertaintyAware
from ambiguous_wild.splat.parts import Parts
from tests.host_reads import moved, no_transfers
from tests.methods.baselines import bits, parts_of, resumed_equals_whole, trainer_of
from tests.splat import fake_gsplat
from tests.splat.test_whole_step import late
from tests.tiny_scene import with_points, write_tiny_scene

# method: options that make it small; growth often, in a run of 120 iterations
GROWTH = {"density.every": "2000", "density.min_every": "10"}
RECIPES = {
    "gs-w": {**GROWTH, "side": "32", "width": "4"},
    "wildgaussians": {"width": "8", "mask_start": "0", "min_mask_start": "10"},
    "splatfacto-w": {**GROWTH, "width": "16"},
    "swag": {**GROWTH, "levels": "2", "entries": "256", "width": "8"},
    "nexussplats": {**GROWTH, "light_width": "8", "doubt_width": "8"},
    "hybridgs": {**GROWTH, "points": "60", "apart": "5000"},
    "t-3dgs": {**GROWTH, "min_mask_start": "10"},
    "forestsplats": {**GROWTH, "points": "40", "width": "8", "side": "32", "appearance": "true"},
}
CPU_ALONE = {"uad": "count"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")


@pytest.fixture(scope="module")
def sparse(scene):
    return with_points(load_scene(scene), 60)


@pytest.mark.parametrize("method", RECIPES)
def test_resuming_gives_the_same_bits(scene, tmp_path, method):
    resumed_equals_whole(scene, tmp_path, lambda: parts_of(method, **RECIPES[method]))
    whole, again = (
        trainer_of(scene, tmp_path / name, parts_of(method, **RECIPES[method])) for name in ("whole", "parts")
    )
    assert whole.resume() and again.resume() and bits(whole) == bits(again)
    camera, photo = whole.data.cameras[0], whole.data.photos[0]
    left = torch.zeros(photo.shape[:2])
    left[:, : photo.shape[1] // 2] = 1.0
    for trainer in (whole, again):
        assert torch.isfinite(trainer.render(camera).image).all()
    fitted = [trainer.render_fitted(camera, photo, left) for trainer in (whole, again)]
    assert torch.equal(*fitted) and torch.isfinite(fitted[0]).all()
    # what lies right of the middle of a test photo is not looked at
    other = photo.clone()
    other[:, photo.shape[1] // 2 :] = 0.5
    assert torch.equal(whole.render_fitted(camera, other, left), fitted[0])


@pytest.mark.parametrize("method", [*RECIPES, "desplat", "asymgs", "robustsplat"])
def test_saving_changes_nothing(scene, tmp_path, method):
    """To save makes Adam's postponed updates at once: rows that nobody saw must not be drawn without them."""
    options = {**RECIPES.get(method, {}), **({"points": "400"} if method == "forestsplats" else {})}
    runs = [trainer_of(scene, tmp_path / name, parts_of(method, **options)) for name in ("quiet", "saved")]
    for _ in range(40):
        for trainer in runs:
            trainer.step()
        runs[1].state()
    kept = ("gaussians", "extra", "optimiser", "fields", "mask", "effects")
    whole, saved = (flat({k: v for k, v in trainer.state().items() if k in kept}) for trainer in runs)
    assert whole.keys() == saved.keys()
    differing = [path for path, value in whole.items() if not same(value, saved[path])]
    assert not differing


def same(one, other):
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


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
    own = UncertaintyAware.observe

    def observe(self, step, gradients, keep=None):
        given.append(None if keep is None else float(keep.mean()))
        own(self, step, gradients, keep)

    monkeypatch.setattr(UncertaintyAware, "observe", observe)
    small = {"forestsplats": {"points": "40", "width": "8", "side": "32"}, "hybridgs": {"points": "60"}}
    options = {**small.get(host, {}), **({"apart": "1", "joint": "2"} if host == "hybridgs" else {})}
    options |= {"min_start": "0"} if host == "desplat" else {}
    parts = parts_of(f"{host}@density=uad", **{f"host.{k}": v for k, v in options.items()})
    trainer = trainer_of(scene, tmp_path / "run", parts)
    for _ in range(6):
        trainer.step()
    assert given and None not in given[1:]
    assert all(0 <= value < 1 for value in given[1:])


@pytest.mark.parametrize("method", ["spotlesssplats", "spotlesssplats-cluster", "mip-splatting", *RECIPES])
def test_a_step_on_an_accelerator_leaves_the_host_alone(sparse, tmp_path, monkeypatch, method):
    with fake_gsplat.installed(monkeypatch):
        trainer = late(sparse, tmp_path, method)
        trainer.step()
        trainer = moved(trainer)
        for _ in range(12):
            trainer.timeline.loss(trainer.step())
        with no_transfers():
            for _ in range(12):
                trainer.timeline.loss(trainer.step())


@pytest.mark.parametrize("method", ["gs-w", "splatfacto-w", "nexussplats", "hybridgs", "forestsplats"])
def test_masks_that_read_an_effect_are_not_grafted_without_it(scene, tmp_path, method):
    fields = method == "forestsplats"  # its masks belong to its fields: the effects alone would not do
    message = f"use {method} as the host" if fields else f"masks of {method} need its effects: add effects="
    with pytest.raises(AwError, match=message):
        parts_of(f"3dgs@mask={method}")
    # and where parts are put together by hand
    with pytest.raises(AwError, match=f"masks of {method} need its effects"):
        trainer_of(scene, tmp_path, Parts(mask=parts_of(method).mask))


@pytest.mark.parametrize("method", sorted(entry.name for entry in BUILTIN))
def test_what_a_mask_policy_reads_is_an_effect_of_its_method(method):
    parts = parts_of(method)
    read = [parts.mask.reads(), parts.mask.losses_read()]
    read += [] if parts.fields is None else [parts.fields.reads()]
    assert all(effect is None or any(effect is own for own in parts.effects) for effect in read)


@pytest.mark.parametrize("method", ["gs-w", "nexussplats"])
def test_masks_are_grafted_with_the_effect_that_they_read(scene, tmp_path, method):
    parts = parts_of(f"3dgs@mask={method},effects={method}")
    trainer = trainer_of(scene, tmp_path, parts)
    learnt = {"gs-w": "mask_weight1", "nexussplats": "doubt_weight2"}[method]
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
