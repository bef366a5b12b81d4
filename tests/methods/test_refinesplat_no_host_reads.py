"""Masks on an accelerator read no value back: the host never waits for the device."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F

from ambiguous_wild.methods.refinesplat.density_control import EntropyAwareDensity, EntropyDensityConfig
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig
from ambiguous_wild.methods.refinesplat.masks import MaskStore
from ambiguous_wild.methods.refinesplat.recipe import RefineSplatMask
from ambiguous_wild.splat import backend
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.vision.sparse_surface import static_surfaces
from tests.host_reads import READ
from tests.methods.on_device import (
    LOOK,
    PLAIN,
    capture,
    made,
    visit,
)
from tests.methods.test_refinesplat_policy import (
    FAST,
    HEIGHT,
    VIEWS,
    WIDTH,
)
from tests.splat import scenes


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return capture(tmp_path_factory.mktemp("scene"))


class Launches(torch.utils._python_dispatch.TorchDispatchMode):
    """Counts what a device has to start; views are free."""

    FREE = frozenset(
        (
            "view", "_unsafe_view", "unbind", "select", "slice", "permute", "unsqueeze", "expand", "t",
            "transpose", "detach", "alias",
        )
    )  # fmt: skip

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function, types, arguments=(), named=None):
        self.count += function.overloadpacket.__name__ not in self.FREE
        return function(*arguments, **(named or {}))


META = torch.device("meta")
MOST_LAUNCHES = 640  # 626 with the defaults, a third of them in the two runs of components


def on_meta(step, downsampling=1):
    rendered = step.rendered
    h, w = HEIGHT // downsampling, WIDTH // downsampling
    maps = {"image": (h, w, 3), "alpha": (h, w), "depth": (h, w)}
    empty = {name: torch.empty(size, device=META) for name, size in maps.items()}
    return dataclasses.replace(
        step, downsampling=downsampling, rendered=SimpleNamespace(**(vars(rendered) | empty))
    )


def moved(policy: RefineSplatMask) -> RefineSplatMask:
    """The policy with its masks made where no value can be read."""
    photos = policy.data.photos
    surfaces = static_surfaces(policy.data.cameras, policy.data.scene.points.xyz)
    policy.data = dataclasses.replace(
        policy.data, device=META, photos=[photo.to(META) for photo in policy.data.photos]
    )
    inputs, readable = policy.inputs, dataclasses.replace(policy.data, photos=photos)
    policy.masks = MaskStore(
        policy.config, readable, surfaces, policy.looks, inputs.labels, inputs.static, policy.compare
    )
    policy.masks.pixels.photos = policy.data.photos
    policy.first = {view: first.to(META) for view, first in policy.first.items()}
    return policy


@pytest.mark.parametrize(
    "changes",
    [
        {}, {"combine": "union", "threshold": "hard"}, {"dilation": 5, "scope": "photo", "w2": 0.5},
        {"gate": 0.0, "ceiling": 0.0, "memory": 0.0}, {"threshold": "literal"}, {"threshold": "statistics"},
    ],
)  # fmt: skip
def test_an_examination_reads_nothing_back(scene, changes):
    policy = moved(made(scene, dataclasses.replace(PLAIN, mask=MaskConfig(**changes))))
    for number in range(VIEWS + 2):
        step = on_meta(visit(scene, number), downsampling=1 + number % 2)
        with Launches() as launches:
            keep = policy.keep(step)
        assert keep.device == META and keep.shape == step.rendered.alpha.shape
    assert policy.predict(step).shape == keep.shape
    assert 100 < launches.count <= MOST_LAUNCHES
    early = dataclasses.replace(step, iteration=1, nominal=1.0, downsampling=1)
    assert policy.keep(early).device == META  # the first look
    with pytest.raises((RuntimeError, NotImplementedError), match=READ):
        policy.masks.state_dict()  # this test would notice a read


@pytest.mark.parametrize("with_keep", [True, False])
def test_a_look_of_density_control_reads_nothing_back(monkeypatch, with_keep):
    cam = scenes.camera()
    gaussians = scenes.gaussians().to(META)
    keep = torch.empty(cam.height, cam.width, device=META) if with_keep else None
    step = SimpleNamespace(
        iteration=4,
        nominal=100.0,
        gaussians=gaussians,
        camera=cam,
        rendered=SimpleNamespace(visible=torch.empty(len(gaussians), dtype=torch.bool, device=META)),
    )
    gradients = Gradients(
        **{name: torch.empty_like(t) for name, t in gaussians.items()},
        screen=torch.empty(len(gaussians), 2, device=META),
    )
    control = EntropyAwareDensity(EntropyDensityConfig(), 1.0, 0)
    control.observe(step, gradients, keep)
    assert control.support.looked.device == META
    monkeypatch.setattr(backend, "accelerated", lambda device: False)
    with pytest.raises((RuntimeError, NotImplementedError), match=READ):
        control.observe(step, gradients, keep)


@pytest.mark.parametrize("variant", ["sigmoid", "softmax"])
def test_the_entropy_terms_read_nothing_back(scene, variant):
    config = dataclasses.replace(
        FAST, entropy_every=1, mask=dataclasses.replace(FAST.mask, variant=variant), first_look=LOOK
    )
    policy = made(scene, config)
    found = policy.inputs.semantics
    found.psi.to(META)
    moved(policy)
    for stack in (found.phi, found.identities, found.grid):
        stack[:] = [t.to(META) for t in stack]
    h, w, channels = found.phi[0].shape

    def features(image):  # what these do is theirs to test
        cells = F.adaptive_avg_pool2d(image.permute(2, 0, 1), (h, w)).mean(0)
        return cells[..., None].expand(h, w, channels)

    policy.inputs.features = features
    step = on_meta(visit(scene, 0))
    keep = torch.empty(HEIGHT, WIDTH, device=META)
    for given in (keep, None):
        assert policy.cotangent(step, given).shape == (HEIGHT, WIDTH, 3)
