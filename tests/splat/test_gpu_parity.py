"""Where the accelerator differed from the CPU: tiny splats, needles, masked photos."""

from dataclasses import replace

import pytest
import torch

from ambiguous_wild.splat import gpu_kernels
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.reference import render_reference
from ambiguous_wild.splat.render import render
from tests.tiny_scene import with_points

from .scenes import camera, cotangents, doubles, gaussians, trainer_for


@pytest.fixture(scope="module")
def scene(scene):
    return with_points(scene, 60)


# -- splats ---------------------------------------------------------------------------------------


def test_splats_that_cover_no_pixel_centre_are_not_visible_as_on_the_cpu(fake):
    g, cam = gaussians(0, 600), camera()
    g.log_scales.fill_(-9.0)  # the blur alone: under a pixel
    g.opacity_logits.copy_(torch.linspace(-5.5, -3.0, 600))  # faint: their contours are small
    there, cpu = render(g, cam), render_cpu(g, cam)
    drawn = (there._shown > 0).all(1)
    assert torch.equal(there.visible, cpu.visible)
    assert int((drawn & ~cpu.visible).sum()) > 20  # gsplat's own box counts these


@pytest.mark.parametrize("seed", range(3))
def test_what_is_visible_is_what_the_cpu_draws(fake, seed):
    g, cam = gaussians(seed, 400), camera()
    there, cpu = render(g, cam), render_cpu(g, cam)
    apart = there.visible != cpu.visible
    # gsplat's radius ends at 3.33 deviations, the contour of opaque splats at the border a little later
    assert int(apart.sum()) <= 2 and int(cpu.visible.sum()) > 100


def test_antialiased_needles_keep_their_opacity_and_its_gradient(fake):
    """A determinant as a difference of products is 0 for them in float32."""
    g, cam = gaussians(5, 40), camera()
    g.log_scales[:] = torch.tensor([0.0, -7.0, -7.0])
    g.opacity_logits.fill_(3.0)
    d = cotangents(cam.height, cam.width)["d_image"]
    leaves = {name: value.requires_grad_(True) for name, value in doubles(g).items()}
    truth = render_reference(leaves, cam, sh_degree=0, antialias=True)
    wanted = torch.autograd.grad((truth.image * d).sum(), [leaves["log_scales"], leaves["opacity_logits"]])
    rendered = render(g, cam, sh_degree=0, antialias=True)
    assert truth.image.max() > 0.05
    assert (rendered.image - truth.image).abs().max() < 1e-3
    grads = rendered.backward(d)
    for name, value in zip(("log_scales", "opacity_logits"), wanted):
        assert (getattr(grads, name) - value).abs().max() < 2e-3 * value.abs().max(), name
    narrow = wanted[0][:, 1:].abs().max()  # what a zero gradient of antialiasing would lose
    assert narrow > 0 and (grads.log_scales[:, 1:] - wanted[0][:, 1:]).abs().max() < 1e-2 * narrow


# -- masked photos --------------------------------------------------------------------------------


class Nothing(MaskPolicy):
    """Keeps nothing at one iteration, everything else at the others."""

    def __init__(self, iteration):
        self.iteration = iteration

    def keep(self, step):
        return torch.full_like(step.photo[..., 0], float(step.iteration != self.iteration))


def growing(scene, folder, bare):
    config = DensityConfig(start=0.0, every=1.0, min_every=6, resets=(), max_gaussians=300)
    parts = MethodHooks(density_config=replace(config, grow_grad=1e-9), mask=Nothing(bare))
    trainer = trainer_for(scene, folder, parts=parts, iterations=30, probes=0)
    counts = []
    for _ in range(9):
        trainer.step()
        counts.append(len(trainer.gaussians))
    return counts, trainer


def test_growth_waits_for_the_next_photo_where_one_is_all_masked(scene, tmp_path, fake, monkeypatch):
    """As on the CPU, which returns before growth; the round is made at the next step."""
    counts, trainer = growing(scene, tmp_path / "gpu", 6)
    with monkeypatch.context() as patch:
        patch.setattr("ambiguous_wild.splat.backend.accelerated", lambda device: str(device) != "cpu")
        cpu, other = growing(scene, tmp_path / "cpu", 6)
    assert counts[5] == 60 and counts[6] > 60
    assert [n > 60 for n in counts] == [n > 60 for n in cpu]
    assert trainer.density.last_growth == other.density.last_growth == 7
    assert trainer.skipped == other.skipped != set()


# -- the loss, compiled before the clock starts ---------------------------------------------------


def test_every_size_of_the_run_is_compiled_before_it_starts(scene, tmp_path, fake, monkeypatch):
    seen = []

    def record(render, photo, keep, lambda_dssim, weighting):
        seen.append((*render.shape[:2], keep is not None))

    monkeypatch.setattr(gpu_kernels, "compiles", lambda device: True)
    monkeypatch.setattr(gpu_kernels, "photometric_fused", record)
    monkeypatch.setattr("ambiguous_wild.splat.run_schedule.SMALLEST_SIDE", 10)
    gpu_kernels.prepare.cache_clear()
    trainer = trainer_for(scene, tmp_path, iterations=30, probes=0, resolution="coarse-to-fine")
    sizes = {(48 // d, 64 // d) for d in trainer.run_schedule.factors}
    assert len(sizes) > 1
    assert sorted(seen) == sorted((*size, masked) for size in sizes for masked in (False, True))
    before = len(seen)
    trainer_for(scene, tmp_path, iterations=30, probes=0, resolution="coarse-to-fine")
    assert len(seen) == before  # once a process
    gpu_kernels.prepare.cache_clear()
