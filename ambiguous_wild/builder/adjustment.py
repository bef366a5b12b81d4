"""COLMAP's options for mapping and bundle adjustment that gives the same bits each time."""

from __future__ import annotations

from typing import Any

from ambiguous_wild.builder.retrieval import FEW
from ambiguous_wild.io.safe_pycolmap import pycolmap

DISTORTIONS = -0.5, 0.3  # k of SIMPLE_RADIAL, from an action camera to more than any pincushion


def pipeline_options(seed: int) -> Any:
    """Return COLMAP's options on one thread, because bundle adjustment sums in the order of its threads."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.ba_min_num_residuals_for_cpu_multi_threading = 10**9
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    return options


def plausible(model: Any) -> bool:
    """Tell whether the distortion is that of a lens: few or flat photos leave it undetermined."""
    low, high = DISTORTIONS
    return all(low <= camera.params[-1] <= high for camera in model.cameras.values())


def adjustment_options(distorted: bool, photos: int, *, final: bool) -> Any:
    """Return options of a joint adjustment on one thread in which a match that does not fit counts little."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = distorted
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = 50 if final else 10
    options.ceres.solver_options.function_tolerance = 1e-6 if final else 1e-4
    options.ceres.min_num_residuals_for_cpu_multi_threading = 10**9
    if photos > FEW:
        options.ceres.auto_select_solver_type = False
        solver: Any = options.ceres.solver_options  # its enumerations take names
        solver.linear_solver_type, solver.preconditioner_type = "ITERATIVE_SCHUR", "SCHUR_JACOBI"
    return options
