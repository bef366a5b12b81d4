"""The CPU back end: hand-written Numba kernels over the whole chain raw parameters -> image and back."""

from ambiguous_wild.splat.cpu.compile import set_threads

__all__ = ["set_threads"]
