"""Methods are recipes of parts on one shared trainer."""

from ambiguous_wild.methods.entry import MethodEntry
from ambiguous_wild.methods.registry import all_methods, get_method, load_plugin, register

__all__ = ["MethodEntry", "all_methods", "get_method", "load_plugin", "register"]
