"""How far the features of a photo are from those of its render: what uncertainties are learnt from."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.methods.masking_common import upsampled
from ambiguous_wild.methods.robustsplat.supervision import calibrated, resized
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import make_features
from ambiguous_wild.vision.precompute import photo_features


class FeatureDistance:
    """WildGaussians' distance: clip(2 - 2 cosine, 0, 1), 1 from a cosine of 0.5 down."""

    def __init__(self, features: str, normal_units: float) -> None:
        """
        Args:
            features: see vision/backends.py.
            normal_units: of hand-made features: the distance, in units of what blur alone makes, that is 1.

        Raises:
            AwError: unknown features, or their weights are missing.
        """
        self.features = make_features(features)
        self.normal_units = normal_units if features.startswith("labhog") else None

    @property
    def name(self) -> str:
        return self.features.name

    def setup(self, data: TrainData) -> None:
        self.cameras = data.cameras
        self.features.fit(data.photos)
        self.photos = photo_features(self.features, data.photos, data.cache_dir)  # [h, w, C] each

    @torch.no_grad()
    def __call__(self, step: Step) -> Tensor:
        """[H, W] at the size of the step's photo."""
        full = self.cameras[step.view]  # not the photo, which may not be on the device
        seen = self.features(upsampled(step.rendered.image.detach(), full.height, full.width))
        cosine = F.cosine_similarity(self.photos[step.view], seen, dim=2)
        if self.normal_units is not None:
            cosine = calibrated(cosine, self.features.unit, self.normal_units)
        return resized((2.0 - 2.0 * cosine).clamp(0.0, 1.0), *step.photo.shape[:2])
