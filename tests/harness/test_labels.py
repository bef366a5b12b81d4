"""Names and order of methods."""

from __future__ import annotations

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.labels import shown_names

METHODS = ("robustsplat", "mine", "3dgs", "3dgs@mask=mine")


def test_methods_without_a_label_come_first_and_labels_order_the_others() -> None:
    assert list(shown_names((), METHODS)) == sorted(METHODS)
    shown = shown_names(("mine=Ours", "3dgs", "3dgs@mask=mine=3DGS, our = masks"), METHODS)
    assert list(shown.items()) == [
        ("robustsplat", "robustsplat"),
        ("mine", "Ours"),
        ("3dgs", "3dgs"),
        ("3dgs@mask=mine", "3DGS, our = masks"),
    ]


def test_a_label_holds_for_runs_of_every_folder() -> None:
    methods = ("3dgs", "mine in a", "mine in b")
    assert shown_names(("mine=Ours", "3dgs"), methods) == {
        "mine in a": "Ours in a", "mine in b": "Ours in b", "3dgs": "3dgs"
    }  # fmt: skip
    own = shown_names(("mine in b=Ours, tuned", "mine=Ours"), methods)
    assert list(own.items())[1:] == [("mine in b", "Ours, tuned"), ("mine in a", "Ours in a")]


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (("mne=Ours",), "unknown method 'mne'.*mine"),
        (("mine=",), "write METHOD=NAME"),
        (("mine=" + "x" * 101,), "1 to 100 characters"),
        (("mine=\ud800",), "write METHOD=NAME"),
        (("mine=A", "mine=B"), "names mine twice"),
        (("mine=A", "3dgs=A"), "both called 'A'"),
        (("mine=3dgs",), "both called '3dgs'"),
    ],
)
def test_a_wrong_label_is_refused(labels: tuple[str, ...], message: str) -> None:
    with pytest.raises(AwError, match=message):
        shown_names(labels, METHODS)
