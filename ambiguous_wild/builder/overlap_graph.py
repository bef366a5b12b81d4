"""The graph of photos that overlap: its parts, its weak links, and a layout for photos without poses."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import networkx as nx

Link = tuple[int, int, int]  # two photos, the lower number first, and their matches
FEW_PARTNERS = 3  # a photo with fewer is held weakly
STRESS_ROUNDS = 100  # of the layout
ROUND = 0.95  # second axis of a layout, of the first, from which on it has no long axis
CLEAR = 0.1  # of the largest distance from the middle: photos nearer to it do not decide the orientation
SHORTEST, LONGEST = 0.6, 1.8  # length of a link on the layout; 1 = a link with the median number of matches


def graph_of(
    count: int,  # photos
    links: Iterable[Sequence[int]],
) -> nx.Graph:
    """Return the graph of photos and links."""
    import networkx as nx  # takes a third of a second, which commands that draw no graph do not wait

    graph = nx.Graph()
    graph.add_nodes_from(range(count))
    graph.add_edges_from(link[:2] for link in links)
    return graph


def bridges(graph: nx.Graph) -> set[tuple[int, int]]:
    """Return the links without which a part falls into two."""
    import networkx as nx

    return {(min(pair), max(pair)) for pair in nx.bridges(graph)}


def weakly_held(
    photos: Sequence[int],
    links: Iterable[Link],
) -> list[int]:
    """Return the photos that overlap with fewer than `FEW_PARTNERS` others, or with fewer than there are."""
    partners = dict.fromkeys(photos, 0)
    for a, b, _ in links:
        if a in partners and b in partners:
            partners[a] += 1
            partners[b] += 1
    return [k for k in photos if partners[k] < min(FEW_PARTNERS, len(photos) - 1)]


def best_join(inside: Collection[int], outside: Collection[int], links: Iterable[Link]) -> tuple[int, int]:
    """Return the photo inside and the one outside with most matches; without matches the nearest in order."""
    inside, outside = set(inside), set(outside)
    strongest = (0, -1, -1)
    for a, b, matches in links:
        if a in outside and b in inside:
            a, b = b, a
        if a in inside and b in outside and matches > strongest[0]:
            strongest = (matches, a, b)
    if strongest[0]:
        return strongest[1:]
    ordered = sorted(inside)
    at = {b: bisect_left(ordered, b) for b in outside}
    nearest = ((a, b) for b, k in at.items() for a in ordered[max(k - 1, 0) : k + 1])
    return min(nearest, key=lambda pair: (abs(pair[0] - pair[1]), pair))


def groups(graph: nx.Graph) -> list[list[int]]:
    """Return the connected parts, the largest first."""
    import networkx as nx

    return sorted(map(sorted, nx.connected_components(graph)), key=lambda part: (-len(part), part))


def lay_out(
    count: int,  # photos, in the order of capture
    links: Sequence[Link],
) -> np.ndarray:  # [count, 2] x right, y up
    """Lay the photos out so that distances follow the overlap: the more matches, the nearer.

    Each connected part is laid out by stress majorisation (Gansner et al., Graph Drawing 2004); parts stand
    side by side, photos without a link in rows below.
    """
    xy = np.zeros((count, 2))
    parts = groups(graph_of(count, links))
    right = 0.0
    for part in parts:
        if len(part) > 1:
            own = _lay_out_part(part, links)
            own -= own.min(axis=0)
            xy[part] = own + np.array([right, -own[:, 1].max() / 2])
            right = float(xy[part, 0].max()) + 1.5
    single = [part[0] for part in parts if len(part) == 1]
    low = float(xy[:, 1].min()) - 1.5 if len(single) < count else 0.0
    columns = max(int(right), int(np.ceil(np.sqrt(2 * len(single)))), 1)
    for number, photo in enumerate(sorted(single)):
        xy[photo] = number % columns, low - number // columns
    return xy


def _lay_out_part(part: Sequence[int], links: Sequence[Link]) -> np.ndarray:
    """Lay out one connected part, [len(part), 2]: its long axis horizontal, its first photo left."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import shortest_path

    at = {photo: k for k, photo in enumerate(part)}
    rows = np.array([(at[a], at[b], m) for a, b, m in links if a in at and b in at], float)
    lengths = np.clip(np.sqrt(np.median(rows[:, 2]) / rows[:, 2]), SHORTEST, LONGEST)
    ends = (rows[:, 0].astype(int), rows[:, 1].astype(int))
    apart = shortest_path(coo_array((lengths, ends), (len(part), len(part))).tocsr(), directed=False)
    # Classical scaling is the start: it depends on no random numbers.
    centring = np.eye(len(part)) - 1 / len(part)
    values, vectors = np.linalg.eigh(-centring @ apart**2 @ centring / 2)
    xy = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, :-3:-1]
    weights = 1 / np.maximum(apart, 1e-9) ** 2
    np.fill_diagonal(weights, 0.0)
    laplacian = np.diag(weights.sum(axis=1)) - weights
    inverse = np.linalg.pinv(laplacian)
    for _ in range(STRESS_ROUNDS):
        drawn = np.linalg.norm(xy[:, None] - xy[None], axis=2)
        force = -weights * apart / np.maximum(drawn, 1e-9)
        np.fill_diagonal(force, 0.0)
        np.fill_diagonal(force, -force.sum(axis=1))
        xy = inverse @ (force @ xy)
    return _oriented(xy - xy.mean(axis=0))


def _oriented(
    xy: np.ndarray,  # [N, 2] around 0
) -> np.ndarray:
    """Rotate and mirror a layout independently of rounding: photos decide what an SVD leaves open.

    The long axis is horizontal, the first photo left; without a long axis, as in a ring, the first photo is
    leftmost. The photo after a quarter of the capture is above.
    """
    _, sizes, axes = np.linalg.svd(xy, full_matrices=False)
    far = np.linalg.norm(xy, axis=1)
    if sizes[1] > ROUND * sizes[0]:
        first = int(np.argmax(far > CLEAR * far.max()))
        left = xy[first] / max(far[first], 1e-12)
        axes = -np.array([left, [-left[1], left[0]]])
    xy = xy @ axes.T
    for column, start, sign in ((0, 0, -1), (1, len(xy) // 4, 1)):
        from_start = np.roll(xy[:, column], -start)
        clear = from_start[int(np.argmax(np.abs(from_start) > CLEAR * np.abs(from_start).max()))]
        xy[:, column] *= -1 if clear * sign < 0 else 1
    return xy
