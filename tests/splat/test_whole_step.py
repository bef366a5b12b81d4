"""A method's whole step on an accelerator: no read of a value, no copy from the host."""

from dataclasses import replace

import pytest
import torch

from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from tests.host_reads import READ, moved, no_transfers
from tests.tiny_scene import with_points

ALL = ("poses", "exposure", "appearance", "antialias")
METHODS = ("3dgs", "3dgs+truth", "dronesplat", "refinesplat")


@pytest.fixture(scope="module")
def scene(scene):
    return with_points(scene, 60)


def late(scene, folder, method, effects=()) -> Trainer:
    """A trainer in the middle of a run: masks have begun, all harmonics are on, nothing grows."""
    entry = get_method(method)
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder / "cache")
    parts = with_effects(entry.build(entry.options()), effects)
    trainer = Trainer(data, parts, TrainConfig(iterations=100_000, probes=0), folder=folder / "run")
    trainer.iteration = 50_000
    trainer.watchdog.every = 10**9  # looking does read
    trainer.density.config = replace(trainer.density.config, start=1e9, stop=1e9, resets=(), min_every=10**9)
    return trainer


@pytest.mark.parametrize("effects", [(), ALL], ids=["plain", "effects"])
@pytest.mark.parametrize("method", METHODS)
def test_nothing_is_read_and_nothing_sent(scene, tmp_path, fake, method, effects):
    trainer = late(scene, tmp_path, method, effects)
    trainer.step()  # what is made at the first step needs numbers
    trainer = moved(trainer)
    for _ in range(12):  # what is copied once, is: every photo, wherever its epoch begins
        trainer.timeline.loss(trainer.step())
    with no_transfers():
        for _ in range(6 if effects else 24):  # every photo four times: masks are made anew
            trainer.timeline.loss(trainer.step())
    with pytest.raises((RuntimeError, NotImplementedError), match=READ):
        trainer.check_parameters()  # reading is what raises there
