"""How long the probes of a plan may be: a tenth of the run that the plan is for, at most."""

from __future__ import annotations

from dataclasses import dataclass

from ambiguous_wild.core import Scene
from ambiguous_wild.harness.planning.probe import ITERATIONS, LONGEST, SETTLED, TIMED_ROUNDS, TIMED_STEPS
from ambiguous_wild.harness.running.step_time import expected_s, slowness
from ambiguous_wild.splat.pace import TrainConfig

SHARE = 0.1
LONGEST_ARM, SHORTEST_ARM = 300, 100  # iterations; a shorter probe tells no effect from noise
TIMED = (TIMED_ROUNDS + 1) * TIMED_STEPS  # iterations that time an effect, and as many without any
ARMS_OF_MASKS = 2


@dataclass(frozen=True)
class Allowance:
    """Expected reference seconds of a run, and of an iteration of the two kinds of probes."""

    run_s: float
    arm_step_s: float  # of a paired probe
    grown_step_s: float  # of the probe of masks, whose Gaussians grow

    def arm_iterations(self, arms: int, spent_s: float = 0.0) -> int:
        """Iterations of each of so many paired probes; 0 where the run is too short for them."""
        if arms == 0:
            return 0
        most = int((SHARE * self.run_s - spent_s) / (arms * self.arm_step_s) + 1e-9) - TIMED
        return 0 if most < SHORTEST_ARM else min(most, LONGEST_ARM)

    @property
    def masks_s(self) -> float:
        """What deciding about masks takes at most."""
        paired = ARMS_OF_MASKS * LONGEST_ARM * self.arm_step_s
        return (ITERATIONS + SETTLED) * self.grown_step_s + paired

    @property
    def masks_fit(self) -> bool:
        """Whether the run is long enough to decide about masks."""
        return self.masks_s <= SHARE * self.run_s

    def share(self, arm_iterations: int, grown_iterations: int = 0) -> float:
        """Expected share of the run."""
        spent = arm_iterations * self.arm_step_s + grown_iterations * self.grown_step_s
        return spent / self.run_s


def allowance(scene: Scene, train: TrainConfig) -> Allowance:
    """Of a run of that length; under a budget the kernels must be compiled.

    Args:
        scene: the scene, at the size that is trained on.
        train: length of the run.
    """
    camera = scene.train[0].camera
    pixels = camera.width * camera.height
    small = int(pixels * min(1.0, LONGEST / max(camera.width, camera.height)) ** 2)
    points = len(scene.points)
    if train.budget_s is None:
        run_s = expected_s(train.iterations, pixels, min(train.max_gaussians or pixels, pixels))
    else:
        run_s = train.budget_s / slowness()
    arm, grown = (expected_s(1, small, n) for n in (points, max(points, small)))
    return Allowance(run_s, arm, grown)
