"""Ward's agglomerative clustering of a grid in which only touching clusters may join."""

from __future__ import annotations

import heapq

import numpy as np

_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # half of the 8; the other half is their mirror


def ward_clusters(grid: np.ndarray, count: int) -> np.ndarray:
    """Labels [h, w] int32, 0 to count - 1, of a grid of features [h, w, C].

    At each step the two touching clusters join whose union adds least to the sum of squared distances to
    their means: |a| |b| / (|a| + |b|) times the squared distance of the means (Ward, 1963). Cells touch in 8
    directions. Of equal costs the pair that was found first joins, so equal grids give equal labels.
    """
    h, w, channels = grid.shape
    means = list(grid.reshape(-1, channels).astype(np.float64))
    sizes = [1] * (h * w)
    near: list[set[int]] = [set() for _ in means]
    for r in range(h):
        for c in range(w):
            for dr, dc in _NEIGHBOURS:
                if r + dr < h and 0 <= c + dc < w:
                    near[r * w + c].add((r + dr) * w + c + dc)
                    near[(r + dr) * w + c + dc].add(r * w + c)
    parent = list(range(h * w))

    def cost(a: int, b: int) -> float:
        apart = means[a] - means[b]
        return sizes[a] * sizes[b] / (sizes[a] + sizes[b]) * float(apart @ apart)

    heap = [(cost(a, b), a, b) for a in range(h * w) for b in near[a] if a < b]
    heapq.heapify(heap)
    alive, left = [True] * (h * w), h * w
    while left > count and heap:
        _, a, b = heapq.heappop(heap)
        if not (alive[a] and alive[b]):
            continue
        made = len(means)
        total = sizes[a] + sizes[b]
        means.append((means[a] * sizes[a] + means[b] * sizes[b]) / total)
        sizes.append(total)
        alive[a] = alive[b] = False
        alive.append(True)
        parent.append(made)
        parent[a] = parent[b] = made
        near.append({n for n in near[a] | near[b] if alive[n]})
        for n in sorted(near[made]):
            near[n].add(made)
            heapq.heappush(heap, (cost(n, made), n, made))
        left -= 1
    roots = np.arange(len(parent))
    for i in range(len(parent) - 1, -1, -1):  # a parent's number is larger than its child's
        roots[i] = i if parent[i] == i else roots[parent[i]]
    return np.unique(roots[: h * w], return_inverse=True)[1].reshape(h, w).astype(np.int32)
