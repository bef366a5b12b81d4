"""Refuses runs that several GPUs cannot share, before anything starts."""

from __future__ import annotations

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import MaskPolicy, Parts

MOST = 9  # GPUs: gsplat's rule for batches leaves Adam no momentum at ten photos a step
_INSTEAD = "leave --gpus out to train on one GPU; several GPUs train several runs at a time with --jobs"


def refuse(parts: Parts, config: TrainConfig, gpus: int) -> None:
    """Raise AwError, one line, where a run cannot be trained on several GPUs.

    Args:
        parts: of the method, effects included.
        config: of the run.
        gpus: how many.
    """
    if not 2 <= gpus <= MOST:
        raise AwError(f"--gpus {gpus}: one model is shared by 2 to {MOST} GPUs; one GPU needs no --gpus")
    if parts.effects:
        names = ", ".join(effect.name for effect in parts.effects)
        raise AwError(f"--gpus {gpus}: effects ({names}) are not shared between GPUs yet; {_INSTEAD}")
    mask = type(parts.mask)
    if mask.state_dict is not MaskPolicy.state_dict or parts.mask.regularises():
        raise AwError(
            f"--gpus {gpus}: masks of {mask.__name__} are learnt in the run from every photo, and no GPU "
            f"sees them all; {_INSTEAD}"
        )
    if parts.fields is not None:
        raise AwError(
            f"--gpus {gpus}: {type(parts.fields).__name__} draws several fields into a picture, and only one "
            f"is shared yet; {_INSTEAD}"
        )
    if parts.density.needs:
        names = ", ".join(sorted(parts.density.needs))
        raise AwError(
            f"--gpus {gpus}: {parts.density.__name__} needs statistics of the backward pass ({names}) that "
            f"GPUs do not exchange; {_INSTEAD}"
        )
    if parts.density.before_optimiser:
        raise AwError(
            f"--gpus {gpus}: {parts.density.__name__} changes Gaussians before the optimiser moves, which is "
            f"not shared yet; {_INSTEAD}"
        )
    if parts.density is not DensityControl:
        raise AwError(
            f"--gpus {gpus}: {parts.density.__name__} compares Gaussians that lie on different GPUs; "
            f"{_INSTEAD}"
        )
    if config.budget_s is not None:
        raise AwError(
            f"--gpus {gpus}: --budget stops by a clock, and every GPU has one of its own; give --iterations"
        )
    if config.on_nonfinite == "rollback":
        raise AwError(
            f"--gpus {gpus}: --on-nonfinite rollback is for one GPU; leave it out, or leave --gpus out"
        )


def refuse_more_than(have: int, gpus: int) -> None:
    """Raise AwError where there are fewer GPUs than asked for.

    Args:
        have: GPUs that torch sees here.
        gpus: how many are asked for.
    """
    if gpus > have:
        there = {0: "no GPU", 1: "1 GPU"}.get(have, f"{have} GPUs")
        raise AwError(
            f"--gpus {gpus}: torch sees {there} here; give no more than that, or check CUDA_VISIBLE_DEVICES"
        )
