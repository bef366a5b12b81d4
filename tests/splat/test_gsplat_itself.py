"""gsplat's own Python, its checks and its graph, around a stand-in for its compiled kernels alone.

Runs where gsplat is installed, with or without a GPU: what the render call hands over must pass gsplat's
assertions on shapes, and come back through gsplat's own backward functions.
"""

import pytest
import torch

from ambiguous_wild.splat.gpu import gsplat_seam
from ambiguous_wild.splat.render import render
from ambiguous_wild.stress.case import agree, cloud
from ambiguous_wild.stress.case import camera as front_camera

from . import fake_kernels
from .scenes import camera, cotangents, gaussians, given

pytest.importorskip("gsplat")


@pytest.fixture
def kernels():
    with fake_kernels.in_place():
        yield


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("degree", [0, 1])
def test_what_comes_out_is_what_float64_gives(kernels, seed, antialias, degree):
    measured = agree(cloud(30, seed), front_camera(), "cpu", "", sh_degree=degree, antialias=antialias)
    assert measured.error <= measured.tolerance, measured


def test_what_is_culled_leaves_no_number_that_is_none(kernels):
    """Colours of rows that are culled are memory as it was, NaN here; nothing of them may be read."""
    g, cam = gaussians(3), camera()
    rendered = render(g, cam, sh_degree=3)
    assert not rendered.visible.all()
    d = cotangents(cam.height, cam.width)
    grads = rendered.backward(given(d), frozenset({"absolute"}))
    for name in (*dict(g.items()), "screen", "screen_extra", "screen_abs"):
        assert torch.isfinite(getattr(grads, name)).all(), name
        assert not getattr(grads, name)[~rendered.visible].any(), name
    assert torch.isfinite(rendered.image).all()


def test_the_clamp_is_measured(kernels):
    assert gsplat_seam.max_alpha("cpu") == 0.999
