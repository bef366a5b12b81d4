"""Plain 3DGS: the baseline of all other methods.

Source: 3D Gaussian Splatting for Real-Time Radiance Field Rendering, Kerbl et al., SIGGRAPH 2023.
"""

from __future__ import annotations

from ambiguous_wild.methods.entry import NoOptions
from ambiguous_wild.splat.method_hooks import MethodHooks


def build(options: NoOptions) -> MethodHooks:
    """Return the default parts: no mask, growth by `DensityControl` of splat/density.py."""
    return MethodHooks()
