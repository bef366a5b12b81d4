"""Which pairs of photos are matched when matching all of them would take too long."""

from __future__ import annotations

OVERLAP = 10  # neighbours on each side
EXHAUSTIVE_LIMIT = 200  # photos; 19 900 pairs, about nine minutes on two cores at 3000 features


def sequential_pairs(names: list[str], test_names: set[str]) -> list[tuple[str, str]]:
    """Neighbours in the given order, partners 2^k further on, and every test photo against all.

    A test photo stands apart from the training walk: in order of names it would meet its own kind only.

    Args:
        names: in the order of capture.
        test_names: those of `names` that belong to a separate test set; may be empty.

    Returns:
        Pairs without repetition, in a fixed order.
    """
    walk = [n for n in names if n not in test_names]
    steps = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(4, 10))})
    pairs = [(walk[i], walk[i + s]) for i in range(len(walk)) for s in steps if i + s < len(walk)]
    tests = [n for n in names if n in test_names]
    pairs += [(a, b) for a in tests for b in walk]
    pairs += [(a, b) for i, a in enumerate(tests) for b in tests[i + 1 :]]
    return pairs
