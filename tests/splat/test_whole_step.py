"""A method's whole step on an accelerator: no read of a value, no copy from the host."""

from dataclasses import replace

import pytest
import torch

from ambiguous_wild.core.config import with_options
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.run_schedule import ResolutionLevel
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from tests.host_reads import READ, moved, no_transfers
from tests.tiny_scene import TRAIN, with_points

PHOTOS = len(TRAIN)
ALL = ("poses", "exposure", "appearance", "antialias")
# the first look of the tiny scene masks nothing unless whatever differs counts
LOOK = {
    "first_look.on": "true",
    "first_look.least": "0",
    "first_look.threshold": "0.1",
    "first_look.known_by": "1",
}
TERMS = {"lambda_id": "1", "lambda_cr": "0.2", "entropy_every": "1", "psi.steps": "9", "features": "labhog"}
# method, effects, and what `late` is told: where in the run, at what size, the method's options
STEPS = [
    ("3dgs", (), {}),
    ("3dgs", ALL, {}),
    ("3dgs+truth", (), {}),
    ("3dgs@mask=robustsplat", (), {}),
    ("dronesplat", (), {"divisor": 2}),
    ("robustsplat", ALL, {"at": 0.3, "divisor": 2}),
    ("robustsplat", (), {"at": 0.8}),
    ("refinesplat", (), {"divisor": 2}),
    ("refinesplat", ALL, {}),
    ("refinesplat", (), {"at": 0.0, **LOOK}),
    ("refinesplat", (), {"mask.combine": "union", "mask.threshold": "hard"}),
    ("refinesplat", (), {"mask.dilation": "5", "mask.scope": "photo", "mask.w2": "0.5"}),
    ("refinesplat", (), {"mask.gate": "0", "mask.ceiling": "0", "mask.memory": "0"}),
    ("refinesplat", (), {"mask.threshold": "literal", "mask.variant": "softmax", **TERMS}),
    ("refinesplat", (), {"mask.threshold": "statistics", **TERMS}),
    ("spotlesssplats", (), {}),
    ("spotlesssplats-cluster", (), {}),
    ("mip-splatting", (), {}),
    ("gs-w", (), {}),
    ("wildgaussians", (), {}),
    ("splatfacto-w", (), {}),
    ("swag", (), {}),
    ("nexussplats", (), {}),
    ("hybridgs", (), {}),
    ("t-3dgs", (), {}),
    ("forestsplats", (), {}),
]


@pytest.fixture(scope="module")
def scene(scene):
    return with_points(scene, 60)


def late(scene, folder, method, effects=(), at=0.5, divisor=1, **options) -> Trainer:
    """A trainer in the middle of a run: masks have begun, all harmonics are on, nothing grows."""
    entry = get_method(method)
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder / "cache")
    parts = with_effects(entry.build(with_options(entry.options(), options)), effects)
    trainer = Trainer(data, parts, TrainConfig(iterations=100_000, probes=0), folder=folder / "run")
    trainer.iteration = int(at * 100_000) // PHOTOS * PHOTOS  # an epoch begins
    trainer.run_schedule.levels = (ResolutionLevel(0.0, divisor),)
    trainer.watchdog.every = 10**9  # looking does read
    trainer.density.config = replace(trainer.density.config, start=1e9, stop=1e9, resets=(), min_every=10**9)
    return trainer


def steps(trainer, count):
    for _ in range(count):
        trainer.timeline.loss(trainer.step())


@pytest.mark.parametrize(("method", "effects", "changes"), STEPS)
def test_nothing_is_read_and_nothing_sent(scene, tmp_path, fake, method, effects, changes):
    often = {"mask_every": "1"} if method == "refinesplat" else {}  # masks are made anew at each visit
    trainer = late(scene, tmp_path, method, effects, **often, **changes)
    if "first_look.least" in changes:
        assert trainer.hooks.mask.keep(trainer.make_step(1, 0)) is not None
    trainer.step()  # what is made at the first step needs numbers
    trainer.iteration -= 1
    trainer = moved(trainer)
    steps(trainer, 2 * PHOTOS)  # what is copied once, as cameras are, is; that of a pose at its second visit
    trainer.iteration += 5000  # smoothing copies all cameras when it is next due
    steps(trainer, 2)
    trainer.iteration -= 5002
    mask, reset = trainer.hooks.mask, trainer.make_step(trainer.iteration, 0)
    with no_transfers():
        steps(trainer, PHOTOS)
        mask.predict(reset)
        mask.on_opacity_reset(reset)
        steps(trainer, 1)  # masks rest
        trainer.iteration += 5000
        steps(trainer, 2)
    with pytest.raises((RuntimeError, NotImplementedError), match=READ):
        trainer.check_parameters()  # reading is what raises there
