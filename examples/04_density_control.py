"""A density control: which Gaussians are cloned and split?

    aw bench --method 3dgs --method examples/04_density_control.py:by_pixels --scene SCENE -o runs
    aw table runs

3DGS grows where the mean gradient of a Gaussian's position is large, over all photos alike. Here a photo
counts by how many pixels show the Gaussian in it (as in Pixel-GS): large, blurred Gaussians grow sooner.
`needs` asks the backward pass for the pixel counts; what nobody asks for is not computed. `sums` are kept
per Gaussian, carried through growth and pruning, and saved in checkpoints.
"""

import torch

from ambiguous_wild.splat.density import DensityControl, Growth, top_k_mask
from ambiguous_wild.splat.method_hooks import MethodHooks


class ByPixels(DensityControl):
    needs = frozenset({"count"})
    sums = {**DensityControl.sums, "pixels": ()}  # noqa: RUF012 - read, never changed

    @torch.no_grad()
    def observe(self, step, gradients, keep=None):
        """Add one view: its gradient times the pixels in which each Gaussian is drawn."""
        if step.nominal > self.config.stop:
            return
        self._match(step.gaussians)
        half = gradients.screen.new_tensor([step.camera.width / 2, step.camera.height / 2])
        self.grad_sum += (gradients.screen * half).norm(dim=1) * gradients.count
        self.pixels += gradients.count
        self.views_seen += step.rendered.visible.float()

    def choose(self, step, gaussians) -> Growth:
        score = self.grad_sum / self.pixels.clamp(min=1)
        chosen = top_k_mask(score, score > self.config.grow_grad, self.room(step, gaussians))
        small = self.small(gaussians)
        clones, splits = (torch.nonzero(chosen & rows).squeeze(1) for rows in (small, ~small))
        return Growth(clones, splits)


def by_pixels() -> MethodHooks:
    """The rest of the loop is that of 3DGS."""
    return MethodHooks(density=ByPixels)
