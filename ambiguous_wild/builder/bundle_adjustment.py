"""COLMAP's options for bundle adjustment that repeats bit for bit, and whether a model can be right."""

from __future__ import annotations

from typing import Any

import numpy as np

from ambiguous_wild.builder.retrieval import FEW_PHOTOS
from ambiguous_wild.io.safe_pycolmap import pycolmap

DISTORTIONS = -0.5, 0.3  # k of SIMPLE_RADIAL, from an action camera to more than any pincushion
# Triangulation angle that a tenth of the points must have: 1.8 where a camera only turned, 12 where not.
MIN_ANGLE_DEG = 2.0
MAX_ANGLES = 1000  # points of which it is computed


def deterministic_pipeline_options(seed: int) -> Any:
    """Return COLMAP's options on one thread, because bundle adjustment sums in the order of its threads."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.ba_min_num_residuals_for_cpu_multi_threading = 10**9
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    return options


def plausible_distortion(model: Any) -> bool:
    """Tell whether the distortion is that of a lens: few or flat photos leave it undetermined."""
    low, high = DISTORTIONS
    return all(low <= camera.params[-1] <= high for camera in model.cameras.values())


def has_parallax(model: Any) -> bool:
    """Tell whether points were seen under enough parallax; pure rotation gives points at any depth."""
    centres = {k: model.images[k].projection_center() for k in model.reg_image_ids()}
    points = list(model.points3D.values())
    angles = []
    for point in points[:: len(points) // MAX_ANGLES + 1]:
        seen_from = np.array([centres[e.image_id] for e in point.track.elements if e.image_id in centres])
        rays = seen_from - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return bool(angles) and float(np.percentile(angles, 90)) >= MIN_ANGLE_DEG


def bundle_adjustment_options(distorted: bool, photos: int, *, final: bool) -> Any:
    """Return options of a bundle adjustment on one thread with a robust loss."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = distorted
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = 50 if final else 10
    options.ceres.solver_options.function_tolerance = 1e-6 if final else 1e-4
    options.ceres.min_num_residuals_for_cpu_multi_threading = 10**9
    if photos > FEW_PHOTOS:
        options.ceres.auto_select_solver_type = False
        solver: Any = options.ceres.solver_options  # its enumerations take names
        solver.linear_solver_type, solver.preconditioner_type = "ITERATIVE_SCHUR", "SCHUR_JACOBI"
    return options
