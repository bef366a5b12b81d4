"""Pairs of photos to match where matching all of them would take too long."""

from __future__ import annotations

PAIRS = "pairs.txt"  # in the stage's folder: what was matched
MOTIONS = "motions.npz"  # beside it: the motions of each pair
OVERLAP = 10  # neighbours on each side
FAST_EXHAUSTIVE_LIMIT = 25  # photos
EXHAUSTIVE_LIMIT = 200  # photos; 19 900 pairs, about nine minutes on two cores at 3000 features


def sequential_pairs(names: list[str], test_names: set[str]) -> list[tuple[str, str]]:
    """Neighbours in the given order, and photos 2^k further on.

    Photos of a separate test set are not part of the walk: their neighbours by name are other test photos.
    `retrieval.pairs_of_tests` finds their partners.

    Args:
        names: in the order of capture.
        test_names: those of a separate test set; may be empty.

    Returns:
        Each pair once, in a fixed order.
    """
    walk = [n for n in names if n not in test_names]
    steps = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(4, 10))})
    return [(walk[i], walk[i + s]) for i in range(len(walk)) for s in steps if i + s < len(walk)]
