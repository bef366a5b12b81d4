"""PUP 3D-GS: removes Gaussians that can move or change size without changing a picture, then refines. Source:
PUP 3D-GS (CVPR 2025) and its code: the score is log det of the 6x6 Gauss-Newton block of mean and log
scale over all train views. Ours: the block is estimated from Rademacher probes (Hutchinson; rank correlation
not measured), growth ends after a third of the run, 80 % are removed in equal rounds (released: 80 %, then
50 %), and rates do not fall by a further 5 % every 400 iterations of refining.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.data import shrink_camera
from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS


@dataclass(frozen=True)
class PupConfig(DensityConfig):
    """3DGS's density control, and rounds of pruning; times in nominal iterations (of 30 000)."""

    stop: float = 10_000.0
    prune_at: float = 10_000.0  # time of the first round
    rounds: int = 4
    between: float = 3000.0  # time between rounds
    share: float = 0.8  # share of the Gaussians that all rounds together remove
    signs: int = 8  # Rademacher probes (random signs) for each view, at 1/`divisor` of the photos' size
    divisor: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        check_limits(self, "pup-3dgs", share=(0, 0.999), rounds=(1, 99), between=(1, 30_000), signs=(1, 1e6))
        check_limits(self, "pup-3dgs", divisor=(1, 64), prune_at=(self.stop, 30_000))  # after growth
        last = self.prune_at + (self.rounds - 1) * self.between
        if last > NOMINAL_ITERATIONS:
            raise AwError(
                f"pup-3dgs.rounds={self.rounds}: the last round would be at {last:g}, after the end "
                f"({NOMINAL_ITERATIONS:g}); lower pup-3dgs.between or prune_at"
            )


def build(options: PupConfig) -> MethodHooks:
    """Return 3DGS whose density control prunes after growth."""
    return MethodHooks(density=PupDensity, density_config=options)


def log_det(blocks: Tensor) -> Tensor:
    """Return the score [N] of blocks [N, 6, 6] float64; 1e-12 on the diagonal keeps unseen ones finite."""
    return torch.linalg.slogdet(blocks + 1e-12 * torch.eye(6).to(blocks))[1]


def prune_mask(score: Tensor, share: float) -> Tensor:
    """Return rows up to the score at index int(share (N - 1)), with ties, as the released code, [N] bool."""
    return score <= score.sort().values[int(share * (len(score) - 1))]


class PupDensity(DensityControl):
    """Grows as 3DGS; then the sensitivity of all train views decides which Gaussians are removed."""

    config: PupConfig
    saved = (*DensityControl.saved, "pruning_rounds")
    pruning_rounds = 0  # number of rounds that are done

    def setup(self, data: TrainData) -> None:
        self.cameras = [shrink_camera(camera, self.config.divisor) for camera in data.cameras]

    @torch.no_grad()
    def refine(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> tuple[Gaussians, list[str]]:
        gaussians, events = super().refine(step, gaussians, optimiser)
        config = self.config
        if events or not self._round_due(step):  # rows that changed cannot be drawn
            return gaussians, events
        self.pruning_rounds += 1
        share = 1.0 - (1.0 - config.share) ** (1.0 / config.rounds)
        score = log_det(self.blocks(step, gaussians))
        drop = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.device)
        mutable = self.mutable_rows(~drop, gaussians)
        if bool(mutable.any()):
            drop[mutable] = prune_mask(score[mutable], share)  # a share of those that may be removed
        if self.leaves_only_protected(drop, gaussians):
            return gaussians, events
        optimiser.flush()
        self._match(gaussians)
        self.log.begin(step.iteration)
        self.log.now.pruned, self.log.now.count = int(drop.sum()), int((~drop).sum())
        return self.keep_rows(gaussians, optimiser, ~drop), ["prune"]

    def due(self, step: Step) -> bool:
        return super().due(step) or self._round_due(step)

    def _round_due(self, step: Step) -> bool:
        config = self.config
        return (
            self.pruning_rounds < config.rounds
            and step.nominal >= config.prune_at + self.pruning_rounds * config.between
        )

    def blocks(self, step: Step, gaussians: Gaussians) -> Tensor:
        """Sum the mean g g^T over views, g = d(sum(probe picture))/d(mean, log s), [N, 6, 6] float64."""
        total = torch.zeros(len(gaussians), 6, 6, dtype=torch.float64, device=gaussians.device)
        numba, draw = backend_of(total.device).kernels, torch.enable_grad()(step.draw)
        for camera in self.cameras:
            for index in range(self.config.signs):
                if not index or not numba:  # on a GPU a picture has one backward pass
                    rendered = draw(camera)
                probe = self.rng.integers(0, 2, (camera.height, camera.width, 3)) * 2 - 1
                g = rendered.backward(torch.from_numpy(probe.astype(np.float32)).to(total.device))
                both = torch.cat([g.means, g.log_scales], dim=1).double()
                total += both[:, :, None] * both[:, None, :] / self.config.signs
        return total
