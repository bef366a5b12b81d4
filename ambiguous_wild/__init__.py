"""Distractor-free 3D Gaussian Splatting in ambiguous scenes: builder, trainer, harness."""

__version__ = "0.1.0"
