"""How well the matches determine the poses of a model: COLMAP's covariance of a joint adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambiguous_wild.io.safe_pycolmap import pycolmap


def joint_covariance(
    model: Any,  # pycolmap.Reconstruction; it does not change
    photos: Sequence[int],  # image ids
    options: Any,  # pycolmap.BundleAdjustmentOptions
) -> tuple[Any, Any] | None:
    """Return the covariance of a joint adjustment and the adjusted copy of the model; None: undetermined."""
    model = pycolmap.Reconstruction(model)
    config = pycolmap.BundleAdjustmentConfig()
    for number in photos:
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    wanted = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.ALL)
    covariance = pycolmap.estimate_ba_covariance(wanted, model, adjuster)
    return None if covariance is None else (covariance, model)


def deviations_deg(
    found: tuple[Any, Any] | None,  # as `joint_covariance` returns it
    ids: Mapping[int, int],  # photo -> image id
    reference: int | None,
) -> dict[int, float]:
    """Return the standard deviation of each photo's rotation, in degrees, where it is known.

    Args:
        found: covariance and model.
        ids: the photos.
        reference: the photo relative to which; None: the one that the adjustment held.
    """
    if found is None:
        return {}
    covariance, model = found
    images = {k: model.images[number] for k, number in ids.items()}
    deviations = {}
    for photo, image in images.items():
        if reference is None:
            both = covariance.get_cam_cov_from_world(image.image_id)
        else:
            ends = [x for one in (images[reference], image) for x in (one.image_id, one.cam_from_world())]
            both = None if photo == reference else covariance.get_cam2_cov_from_cam1(*ends)
        rotation = np.full((3, 3), np.nan) if both is None else np.asarray(both)[:3, :3]
        if np.isfinite(rotation).all():  # a lens that nothing determines makes all of them NaN
            variance = max(float(np.linalg.eigvalsh(rotation).max()), 0.0)
            # Ceres' tangent of a quaternion is half of the angle.
            deviations[photo] = 2.0 * float(np.degrees(np.sqrt(variance)))
    return deviations
