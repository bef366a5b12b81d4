"""DeSplat: where the layers lie, how pictures are composed, what the alpha terms pull, and what is tested."""

from types import SimpleNamespace

import pytest
import torch

from ambiguous_wild.methods.desplat import DeSplatConfig, ViewLayers
from ambiguous_wild.splat.fields import STATIC, frames_of
from ambiguous_wild.splat.rendered import Cotangents, Frame
from ambiguous_wild.splat.step import ViewContext
from ambiguous_wild.splat.watchdog import NonFinite
from tests.methods.baselines import data_of, masked_more_inside, parts_of, trained, trainer_of


@pytest.fixture(scope="module")
def starts(scene, tmp_path_factory):
    data = data_of(scene, tmp_path_factory.mktemp("cache"))
    return data, ViewLayers(DeSplatConfig(points=300, speed=2.0)).setup(
        data, None, lambda progress: {"means": 0.5 - progress}
    )


def context(view=0, iteration=300):
    return ViewContext(iteration=iteration, nominal=1.0, view=view, camera=SimpleNamespace())


def frame(value, alpha):
    return Frame(torch.full((2, 3, 3), value), torch.full((2, 3), alpha), lambda: torch.zeros(2, 3))


def test_a_layer_covers_the_frame_of_its_photo_just_in_front_of_it(starts):
    data, found = starts
    assert list(found) == [str(view) for view in range(6)]
    for view, camera in enumerate(data.cameras):
        g = found[str(view)].gaussians
        local = g.means.double().numpy() @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        assert local[:, 2] == pytest.approx(max(0.02 * data.scene.extent, 0.02), abs=1e-5)
        u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
        v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
        assert -0.1 < u.min() < 5 and 59 < u.max() < 64.1 and -0.1 < v.min() < 5 and 43 < v.max() < 48.1
        assert g.sh_degree == 0 and len(g) == 300
        assert torch.sigmoid(g.opacity_logits).tolist() == pytest.approx([0.1] * 300)
    assert not torch.equal(found[str(0)].gaussians.sh0, found[str(1)].gaussians.sh0)


def test_learning_rates_are_the_released_ones_times_the_speed(starts):
    rates = starts[1][str(0)].rates(0.2)
    assert rates["means"] == pytest.approx(0.6)  # of the static field, decay included
    assert rates["sh0"] * 0.28209479 == pytest.approx(0.05)
    assert (rates["opacity_logits"], rates["log_scales"], rates["quats"]) == (0.1, 0.1, 0.02)


def test_the_composite_by_hand():
    layers = ViewLayers(DeSplatConfig())
    frames = {STATIC: frame(0.8, 0.9), str(0): frame(0.3, 0.4)}
    made, vjp = layers.compose(frames, context())
    assert made.image[0, 0].tolist() == pytest.approx([0.3 + 0.6 * 0.8] * 3)
    assert made.alpha[0, 0].item() == pytest.approx(0.4 + 0.6 * 0.9)
    back = vjp(Cotangents(image=torch.ones(2, 3, 3)))
    assert back[STATIC].image[0, 0].tolist() == pytest.approx([0.6] * 3)
    assert back[str(0)].image[0, 0].tolist() == [1.0] * 3
    assert back[str(0)].alpha[0, 0].item() == pytest.approx(-3 * 0.8)


def test_layers_are_not_drawn_before_their_start():
    layers = ViewLayers(DeSplatConfig(min_start=300))
    assert layers.drawn(context(4)) == ("4",) and layers.drawn(context(4, 299)) == ()
    assert layers.drawn(context(None)) == ()
    static, given = frame(0.8, 0.9), Cotangents(image=torch.ones(2, 3, 3))
    made, vjp = layers.compose({STATIC: static}, context(4, 299))
    assert made is static and vjp(given) == {STATIC: given}
    assert set(layers.regularise({STATIC: static}, context(4, 299))) == {STATIC}


def test_the_alpha_terms_pull_static_up_and_the_layer_down():
    layers = ViewLayers(DeSplatConfig(alpha_static=0.6, alpha_own=0.3))
    terms = layers.regularise({STATIC: frame(0.8, 0.9), str(2): frame(0.3, 0.4)}, context(2))
    assert terms[STATIC].alpha.tolist() == [[pytest.approx(-0.1)] * 3] * 2  # 0.6 over 6 pixels
    assert terms[str(2)].alpha.tolist() == [[pytest.approx(0.05)] * 3] * 2


def test_only_the_layer_of_the_view_learns(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path, parts_of("desplat", points="200", min_start="0"))
    others = trainer.drawing.others
    before = {name: field.gaussians.sh0.clone() for name, field in others.items()}
    trainer.step()
    seen = str(trainer.run_schedule.view(1))
    assert {name for name, field in others.items() if not torch.equal(field.gaussians.sh0, before[name])} == {
        seen
    }


def test_test_views_show_the_static_field_alone_and_the_mask_is_what_the_layer_leaves(scene, tmp_path):
    trainer = trained(scene, tmp_path, parts_of("desplat", points="200", min_start="0"), iterations=60)
    for view, camera in enumerate(trainer.data.cameras):
        step = trainer.make_step(trainer.iteration, view)
        alpha = frames_of(step.rendered)[str(view)].alpha
        assert float(alpha.max()) > 0.02
        assert torch.equal(trainer.hooks.mask.predict(step), 1.0 - alpha)
        assert trainer.hooks.mask.keep(step) is None
        alone = trainer.render(camera).image
        assert torch.equal(alone, frames_of(step.rendered)[STATIC].image)
        assert not torch.equal(alone, step.rendered.image)


def test_a_clear_layer_lets_a_white_background_through(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path, parts_of("desplat", points="200", min_start="0"), behind=255)
    for layer in trainer.drawing.others.values():
        layer.gaussians.opacity_logits.fill_(-20.0)
    shown = trainer.make_step(1, 0).rendered
    alone = frames_of(shown)[STATIC]
    assert alone.alpha.min() < 0.5 and torch.equal(shown.image, alone.image)


def test_layers_take_up_distractors(scene, tmp_path):
    """The red squares of the photos are covered more than the rest of them."""
    trainer = trained(scene, tmp_path, parts_of("desplat", points="200", min_start="0"), iterations=400)
    inside, outside = masked_more_inside(trainer)
    assert inside < outside - 0.15


def test_a_layer_that_is_not_finite_is_found_before_a_checkpoint(scene, tmp_path):
    trainer = trainer_of(scene, tmp_path, parts_of("desplat", points="200", min_start="0"))
    trainer.step()
    trainer.check_parameters()
    trainer.drawing.others["3"].gaussians.means[7] = float("nan")
    with pytest.raises(NonFinite, match="parameter of means in 1 Gaussians"):
        trainer.check_parameters()
