"""From run folders to what `viewing` shows and `aw export` writes."""
