"""Every metric of a render and its photo that needs neither weights nor a scene, by name."""

from __future__ import annotations

from ambiguous_wild.metrics.affine import psnr_affine
from ambiguous_wild.metrics.flip import flip
from ambiguous_wild.metrics.image import METRICS

FULL_IMAGE = METRICS | {"psnr_affine": psnr_affine, "flip": flip}
