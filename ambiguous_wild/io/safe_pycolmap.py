"""The only place that imports pycolmap: `from ambiguous_wild.io.safe_pycolmap import pycolmap`.

The pycolmap wheels (4.1.1 and 4.2.1 measured) export zlib's symbols. If they are imported first, they shadow
the library that PNG writers link against, and the next PNG write crashes the process; so zlib is imported
before. They also print a stack trace of 40 lines when a process is told to end (kill, a cluster's limit).
"""

import signal
import threading

import zlib  # noqa: F401  isort: skip  before pycolmap, see above

import pycolmap

if threading.current_thread() is threading.main_thread():  # Python sets signals in no other
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)

__all__ = ["pycolmap"]
