"""The graph of photos that overlap: its components, its weak links, and a layout for photos without poses.

`predict_growth` forecasts which photos structure from motion will register: a mapper starts from two photos,
and registers another one by its features that two registered photos show, because only these have a point.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import networkx as nx

Link = tuple[int, int, int]  # two photos, the lower number first, and their matches
FEW_COVISIBLE = 3  # a photo with fewer is connected weakly
SHARED = 8  # features of a photo that two registered photos show, from which on it is registered
SMALLEST = 3  # photos of a component
STRESS_ROUNDS = 100  # of the layout
ROUND = 0.95  # second axis of a layout, of the first, from which on it has no long axis
CLEAR = 0.1  # of the largest distance from the middle: photos nearer to it do not decide the orientation
SHORTEST, LONGEST = 0.6, 1.8  # length of a link on the layout; 1 = a link with the median number of matches


def overlap_graph(
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
    """Return the links without which a component falls into two."""
    import networkx as nx

    return {(min(pair), max(pair)) for pair in nx.bridges(graph)}


def weakly_connected(
    photos: Sequence[int],
    links: Iterable[Link],
) -> list[int]:
    """Return the photos that overlap with fewer than `FEW_COVISIBLE` others, or with fewer than there are."""
    covisible = dict.fromkeys(photos, 0)
    for a, b, _ in links:
        if a in covisible and b in covisible:
            covisible[a] += 1
            covisible[b] += 1
    return [k for k in photos if covisible[k] < min(FEW_COVISIBLE, len(photos) - 1)]


def best_link_between(
    inside: Collection[int], outside: Collection[int], links: Iterable[Link]
) -> tuple[int, int]:
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


def connected_components(graph: nx.Graph) -> list[list[int]]:
    """Return the connected components, the largest first."""
    import networkx as nx

    return sorted(
        map(sorted, nx.connected_components(graph)), key=lambda component: (-len(component), component)
    )


@dataclass(frozen=True)
class GrowthForecast:
    """Prediction for a capture."""

    components: list[list[int]]  # photos of each, the largest first; the first is what will be built
    others: list[int]  # photos of none


def predict_growth(
    count: int,  # photos
    matches: Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray]],  # features of both photos, [M] each
) -> GrowthForecast:
    """Grow components from the pairs with the most matches, until no photo can be added."""
    features = [0] * count
    for pair, ends in matches.items():
        for photo, rows in zip(pair, ends):
            features[photo] = max(features[photo], int(rows.max(initial=-1)) + 1)
    pairs: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for pair in matches:
        for photo in pair:
            pairs[photo].append(pair)
    strongest_first = sorted(matches, key=lambda pair: (-len(matches[pair][0]), pair))
    free, components = set(range(count)), []
    while True:
        grown: set[int] = set()
        for start in strongest_first:
            if free.issuperset(start):
                grown = _grow(start, free, pairs, matches, features)
                if len(grown) >= SMALLEST:
                    break
        if len(grown) < SMALLEST:
            break
        components.append(sorted(grown))
        free -= grown
    components.sort(key=lambda component: (-len(component), component))
    return GrowthForecast(components, sorted(free))


def _grow(
    start: tuple[int, int],
    free: set[int],
    pairs: list[list[tuple[int, int]]],
    matches: Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray]],
    features: list[int],
) -> set[int]:
    """Return the photos that a component reaches from two photos."""
    has_point = [np.zeros(0, bool)] * len(features)  # features that two registered photos show
    registered: set[int] = set()

    def register(photo: int) -> None:
        registered.add(photo)
        has_point[photo] = np.zeros(features[photo], bool)
        for pair in pairs[photo]:
            if registered.issuperset(pair):
                for end, rows in zip(pair, matches[pair]):
                    has_point[end][rows] = True

    def shared(photo: int) -> int:
        seen = np.zeros(features[photo], bool)
        for pair in pairs[photo]:
            side = pair.index(photo)
            if pair[1 - side] in registered:
                own, other = matches[pair][side], matches[pair][1 - side]
                seen[own[has_point[pair[1 - side]][other]]] = True
        return int(seen.sum())

    for photo in start:
        register(photo)
    added = set(start)
    while added:
        near = {end for photo in added for pair in pairs[photo] for end in pair}
        # A new photo gives points to its registered neighbours, which their neighbours may need.
        near |= {end for photo in near & registered for pair in pairs[photo] for end in pair}
        added = {photo for photo in sorted((near & free) - registered) if shared(photo) >= SHARED}
        for photo in sorted(added):
            register(photo)
    return registered


def component_labels(count: int, pairs: Iterable[Sequence[int]]) -> np.ndarray:
    """Number the components of `count` photos that pairs connect, [count] int, 0 the largest."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = np.array([tuple(pair) for pair in pairs], int).reshape(-1, 2).T
    graph = coo_array((np.ones(ends.shape[1]), tuple(ends)), (count, count))
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(-np.bincount(label), kind="stable")
    return np.argsort(order)[label]


def graph_layout(
    count: int,  # photos, in the order of capture
    links: Sequence[Link],
) -> np.ndarray:  # [count, 2] x right, y up
    """Lay the photos out so that distances follow the overlap: the more matches, the nearer.

    Each component is laid out by stress majorisation (Gansner et al., Graph Drawing 2004); components
    stand side by side, photos without a link in rows below.
    """
    xy = np.zeros((count, 2))
    components = connected_components(overlap_graph(count, links))
    right = 0.0
    for component in components:
        if len(component) > 1:
            own = _lay_out_component(component, links)
            own -= own.min(axis=0)
            xy[component] = own + np.array([right, -own[:, 1].max() / 2])
            right = float(xy[component, 0].max()) + 1.5
    single = [component[0] for component in components if len(component) == 1]
    low = float(xy[:, 1].min()) - 1.5 if len(single) < count else 0.0
    columns = max(int(right), int(np.ceil(np.sqrt(2 * len(single)))), 1)
    for number, photo in enumerate(sorted(single)):
        xy[photo] = number % columns, low - number // columns
    return xy


def _lay_out_component(component: Sequence[int], links: Sequence[Link]) -> np.ndarray:
    """Lay out one component, [len(component), 2]: its long axis horizontal, its first photo left."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import shortest_path

    at = {photo: k for k, photo in enumerate(component)}
    rows = np.array([(at[a], at[b], m) for a, b, m in links if a in at and b in at], float)
    lengths = np.clip(np.sqrt(np.median(rows[:, 2]) / rows[:, 2]), SHORTEST, LONGEST)
    ends = (rows[:, 0].astype(int), rows[:, 1].astype(int))
    apart = shortest_path(
        coo_array((lengths, ends), (len(component), len(component))).tocsr(), directed=False
    )
    # Classical scaling is the start: it depends on no random numbers.
    centring = np.eye(len(component)) - 1 / len(component)
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
