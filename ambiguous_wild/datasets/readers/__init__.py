"""One file a layout: each turns a folder into a `ForeignScene`."""
