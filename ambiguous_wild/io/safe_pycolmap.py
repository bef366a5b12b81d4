"""The only place that imports pycolmap: `from ambiguous_wild.io.safe_pycolmap import pycolmap`.

The pycolmap wheels (4.1.1 and 4.2.1 measured) export zlib's symbols. Imported first, they shadow the
library that PNG writers link against, and the next PNG write crashes the process. zlib goes first.
"""

import zlib  # noqa: F401  isort: skip  before pycolmap, see above

import pycolmap

__all__ = ["pycolmap"]
