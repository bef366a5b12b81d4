"""Find the 3D points that a photo may show, by its matches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ambiguous_wild.builder.matched import Matched
from ambiguous_wild.builder.motions import Pair


@dataclass
class PointLookup:
    """Points of a model, found by the features that observe them."""

    matched: Matched
    rows: list[np.ndarray]  # a photo each: [N] row of `xyz` that a feature observes, -1 without a point
    xyz: np.ndarray  # [P, 3]
    views: np.ndarray  # [P] number of photos that observe the point

    @classmethod
    def read(cls, matched: Matched, model: Any) -> PointLookup:
        at = {number: k for k, number in enumerate(matched.ids)}
        rows = [np.full(len(f), -1) for f in matched.features]
        xyz, views = np.zeros((len(model.points3D), 3)), np.zeros(len(model.points3D), int)
        for row, point in enumerate(model.points3D.values()):
            xyz[row] = point.xyz
            elements = point.track.elements
            views[row] = len({e.image_id for e in elements})
            for element in elements:
                rows[at[element.image_id]][element.point2D_idx] = row
        return cls(matched, rows, xyz, views)

    def matched_with(
        self, photo: int, pairs: Sequence[Pair], poses: Mapping[int, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return features [K] of a photo, and their points [K, 3], which at least two others observe."""
        own = np.zeros(len(self.xyz), int)
        own[np.unique(self.rows[photo][self.rows[photo] >= 0])] = 1
        links = [np.zeros((0, 2), int)]
        for pair in pairs:
            side = pair.index(photo)
            if pair[1 - side] in poses:
                matches = self.matched.matches[pair].astype(int)
                seen = self.rows[pair[1 - side]][matches[:, 1 - side]]
                links.append(np.column_stack([matches[:, side], seen])[seen >= 0])
        both = np.unique(np.concatenate(links), axis=0)
        both = both[self.views[both[:, 1]] - own[both[:, 1]] >= 2]
        return both[:, 0], self.xyz[both[:, 1]]
