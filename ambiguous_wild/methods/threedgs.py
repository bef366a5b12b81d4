"""Plain 3DGS: the baseline every other method is measured against.

Source: 3D Gaussian Splatting for Real-Time Radiance Field Rendering, Kerbl et al., SIGGRAPH 2023.
"""

from __future__ import annotations

from ambiguous_wild.methods.registry import NoOptions
from ambiguous_wild.splat.parts import Parts


def build(options: NoOptions) -> Parts:
    """Every place at its default: no mask, 3DGS density control with a reset that fires."""
    return Parts()
