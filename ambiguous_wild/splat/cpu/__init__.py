"""The CPU back end: hand-written Numba kernels over the whole chain raw parameters -> image and back."""

from ambiguous_wild.splat.cpu.threads import set_threads

__all__ = ["set_threads"]
