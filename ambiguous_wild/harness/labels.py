"""How methods are called and ordered wherever runs are shown: tables, figures, plots and pages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.core.names import is_text, plain

IN_FOLDER = " in "  # between a method and its folder, where several folders hold runs of it
LONGEST = 100  # characters of a name


def shown_names(labels: Sequence[str], methods: Iterable[str]) -> dict[str, str]:
    """Return the name under which each method is shown, in the order in which methods are shown.

    Methods without a label come first, by name, under their own name; then those with one, in the order of
    the labels. So a paper's own method is the last row, and labels for all methods order all rows.

    Args:
        labels: "METHOD=NAME", or "METHOD" alone for its place in the order. A label of "mine" is also one of
            "mine in FOLDER".
        methods: methods that have runs; a graft's name may hold "=".

    Raises:
        AwError: a label of a method without runs, two labels of one method, two methods of one name, or a
            name that cannot be printed.
    """
    present = sorted(set(methods))
    alone = {method.partition(IN_FOLDER)[0] for method in present}
    named: dict[str, str] = {}
    for text in labels:
        method, name = _split(text, {*present, *alone})
        if method in named:
            raise AwError(f"--label names {method} twice: leave one out")
        named[method] = name
    shown: dict[str, str] = {method: method for method in present}
    for label, name in named.items():
        for method in (m for m in present if m == label or m.startswith(label + IN_FOLDER)):
            if method != label and method in named:
                continue
            del shown[method]  # to the end
            shown[method] = name + method.removeprefix(label)
    owners: dict[str, str] = {}
    for method, name in shown.items():
        if name in owners:
            raise AwError(
                f"{owners[name]} and {method} are both called {plain(name)!r}: give one another --label"
            )
        owners[name] = method
    return shown


def _split(label: str, methods: set[str]) -> tuple[str, str]:
    """Return method and name of a label; the longest method that fits, as both may hold "="."""
    fitting = [m for m in methods if label == m or label.startswith(m + "=")]
    if not fitting:
        method = label.rpartition("=")[0] or label
        raise unknown("method", method, methods, "write --label METHOD=NAME, with a method that has runs")
    method = max(fitting, key=len)
    name = label[len(method) + 1 :].strip() or method
    if label == method + "=" or len(name) > LONGEST or not is_text(name):
        raise AwError(
            f"--label {plain(label[:LONGEST])!r}: write METHOD=NAME, NAME of 1 to {LONGEST} characters"
        )
    return method, name
