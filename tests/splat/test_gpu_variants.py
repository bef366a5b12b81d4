"""Variants of a step on a GPU: each against the default, the float64 reference and the CPU's kernels."""

from dataclasses import replace

import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.cpu.render import render_cpu
from ambiguous_wild.splat.gpu import compiled, options, split_harmonics
from ambiguous_wild.splat.gpu.render import render_cuda
from ambiguous_wild.splat.reference import render_reference
from tests.host_reads import moved, no_transfers
from tests.tiny_scene import with_points, write_tiny_scene

from . import fake_gsplat
from .scenes import camera, cotangents, doubles, gaussians
from .test_trainer import trainer_for


@pytest.fixture
def fake(monkeypatch):
    with fake_gsplat.installed(monkeypatch):
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return with_points(load_scene(write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")), 60)


def late(scene, folder):
    """In the middle of a run: all harmonics are on, nothing grows."""
    trainer = trainer_for(scene, folder, iterations=100_000, probes=0)
    trainer.iteration = 50_000
    trainer.watchdog.every = 10**9
    still = {"start": 1e9, "stop": 1e9, "resets": (), "min_every": 10**9}
    trainer.density.config = replace(trainer.density.config, **still)
    return trainer


def drawn(g, cam, degree, d):
    with options.using(harmonics="split"):
        rendered = render_cuda(g, cam, sh_degree=degree, background=(0.0, 0.0, 0.0), antialias=False)
        return rendered, rendered.backward(d)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("rest", [8, 15])
def test_split_harmonics_are_those_of_the_reference_and_of_the_cpu(fake, degree, rest):
    g, cam = gaussians(3, rest=rest), camera()
    degree = min(degree, g.sh_degree)
    d = cotangents(cam.height, cam.width)["d_image"]
    rendered, grads = drawn(g, cam, degree, d)
    leaves = doubles(g)
    truth = render_reference(leaves, cam, sh_degree=degree)
    assert (rendered.image - truth.image).abs().max() < 3e-5
    wanted = torch.autograd.grad(
        (truth.image * d).sum(), list(leaves.values()), allow_unused=True, materialize_grads=True
    )
    for (name, leaf), value in zip(leaves.items(), wanted):
        error = (getattr(grads, name) - value).abs().max()
        assert error <= 3e-5 * max(value.abs().max(), 1e-3) and getattr(grads, name).shape == leaf.shape, name
    cpu = render_cpu(g, cam, sh_degree=degree)  # harmonics written a second time
    assert (rendered.image - cpu.image).abs().max() < 1e-3
    rest_there, rest_here = cpu.backward(d).sh_rest, grads.sh_rest
    assert (rest_there - rest_here).abs().max() <= 1e-3 * max(float(rest_there.abs().max()), 1e-3)
    off = rest_here[:, (degree + 1) ** 2 - 1 :]
    assert off.numel() == 0 or not off.any()  # of degrees that are not on yet


def test_the_switch_leaves_gsplats_kernel_alone(fake, monkeypatch):
    from ambiguous_wild.splat.gpu import gsplat_seam

    def refuse(*_, **__):
        raise AssertionError("called")

    monkeypatch.setattr(gsplat_seam, "shade", refuse)
    d = torch.ones(29, 37, 3)
    drawn(gaussians(1), camera(), 3, d)
    with pytest.raises(AssertionError, match="called"):
        render_cuda(gaussians(1), camera(), sh_degree=3, background=(0.0, 0.0, 0.0), antialias=False)


def test_split_harmonics_compile_to_one_graph_each_for_any_number_of_rows(fake, monkeypatch):
    """As on a GPU, with a backend that only runs what torch has traced."""
    monkeypatch.setattr(compiled, "compiles", lambda device: True)
    graphs = []

    def counting(graph, inputs):
        graphs.append(graph)
        return graph.forward

    pair = [compiled.Compiled(f, backend=counting) for f in (split_harmonics._colours, split_harmonics._pull)]
    for n in (7, 40, 90):
        g, centre, d = gaussians(2, n), torch.tensor([0.1, 0.2, 0.3]), torch.randn(n, 3)
        given = (g.means, g.sh0, g.sh_rest, centre, 2)
        assert torch.allclose(pair[0](*given), split_harmonics._colours(*given), atol=1e-6)
        given = (g.means, g.sh_rest, centre, d, 2)
        for a, b in zip(pair[1](*given), split_harmonics._pull(*given)):
            assert torch.allclose(a, b, atol=1e-6)
    assert len(graphs) == 2 and not pair[0].broken and not pair[1].broken


def test_training_with_split_harmonics_is_that_of_the_default(scene, tmp_path, fake):
    models = []
    for name in ("gsplat", "split"):
        with options.using(harmonics=name):
            trainer = late(scene, tmp_path / name)
            for _ in range(20):
                trainer.step()
        models.append(trainer.gaussians)
    assert models[0].sh_rest.abs().max() > 0
    for name in ("means", "sh0", "sh_rest", "opacity_logits"):
        apart = (getattr(models[0], name) - getattr(models[1], name)).abs() > 1e-3
        assert float(apart.float().mean()) < 0.02, name


def test_nothing_is_read_in_a_step_with_split_harmonics(scene, tmp_path, fake):
    with options.using(harmonics="split"):
        trainer = late(scene, tmp_path)
        trainer.step()
        trainer = moved(trainer)
        for _ in range(12):  # cameras are copied once, wherever an epoch begins
            trainer.step()
        with no_transfers():
            for _ in range(3):
                trainer.step()


def test_a_timed_budget_trains_coarse_to_fine_with_a_budget_of_gaussians(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("ambiguous_wild.splat.resolution.SMALLEST_SIDE", 10)
    timed = trainer_for(scene, tmp_path / "timed", budget_s=60.0, probes=0).pace
    counted = trainer_for(scene, tmp_path / "counted", iterations=30_000, probes=0).pace
    assert len(timed.divisors) > 1 and timed.divisor(0.0) > timed.divisor(1.0) == 1
    assert counted.divisors == (1,)
    assert timed.most == 48 * 64 < counted.most  # one a photo pixel
    ceilings = [timed.ceiling(timed.divisor(p), p) for p in (0.0, 0.2, 0.5, 1.0)]
    assert ceilings == sorted(ceilings) and ceilings[0] < ceilings[-1] == timed.most
    full = trainer_for(scene, tmp_path / "full", budget_s=60.0, probes=0, resolution="full").pace
    assert full.divisors == (1,)


def test_options_combine_and_are_named():
    found = options.parse("tiles=last-visit, harmonics=split")
    assert str(found) == "tiles=last-visit,harmonics=split"
    with pytest.raises(AwError, match="unknown value of harmonics"):
        options.parse("harmonics=fused")
