"""A scene in another layout than ours, read but not yet written as a scene folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from ambiguous_wild.core.camera import pose_at
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.names import stays_below
from ambiguous_wild.core.scene import Evaluation, Split
from ambiguous_wild.io.colmap_records import LARGEST_COORDINATE, ColmapModel
from ambiguous_wild.io.scene_folder import SIDES, without_suffix


@dataclass(frozen=True)
class ForeignScene:
    """A scene as every reader returns it, with the model's names, relative to the folder of photos."""

    kind: str  # the layout, a key of `readers.READERS`
    root: Path
    model: ColmapModel  # poses and cameras at full size; may have no points
    photos: Path  # folder that the model's names refer to
    split: dict[str, Split]  # photos of neither side are left out
    factor: int = 1  # downsampling in the published tables
    missing: dict[Split, list[str]] = field(default_factory=dict)  # listed names that the model lacks
    masks: dict[str, Path] = field(default_factory=dict)  # keep masks by photo, white = keep
    max_width: int | None = None  # px; wider photos are reduced to it
    background: tuple[int, int, int] | None = None  # RGB, put behind photos with alpha
    dataset: str = ""  # its name in result tables
    evaluation: Evaluation = field(default_factory=Evaluation)
    points: Literal["model", "triangulate", "random"] = "model"  # source of the initial points
    notes: tuple[str, ...] = ()  # decisions and omissions, for the user

    @property
    def only_small(self) -> bool:
        """Whether the dataset has downsampled photos only."""
        return not self.photos.is_dir()

    @property
    def photo_folder(self) -> Path:
        """The folder of the photos that are read: full-size ones, if there are any."""
        return self.root / f"images_{self.factor}" if self.only_small else self.photos


def inside(name: str, root: Path) -> str:
    """Return a relative name of the dataset after checking that it stays below its folder.

    Raises:
        AwError: it is absolute, empty or holds "..".
    """
    if not name.isprintable():  # the split lists hold one name a line, in UTF-8
        raise AwError(f"{root} has a photo called {ascii(name)[:80]}, which no list can hold; rename it")
    if not stays_below(name) or "\\" in name:
        raise AwError(f"{root} names a file outside itself: {name[:80]!r}; do not use this dataset")
    return str(PurePosixPath(name))


def plain(name: str) -> str:
    """Normalise a scene's name, so that spellings like Patio-High and patio_high are equal."""
    return "".join(c for c in name.casefold() if c.isalnum())


def split_by_lists(
    names: Iterable[str],
    listed: Mapping[Split, list[str]],
    where: Path,
    key: Callable[[str], str] = without_suffix,
) -> tuple[dict[str, Split], dict[Split, list[str]]]:
    """Split the model's photos by lists of names, with or without extension or folder.

    Args:
        names: the model's names.
        listed: names by side.
        where: file or folder of the lists, for messages.
        key: normalises a name, so that two spellings of one photo are equal.

    Returns:
        Sides by name, and per side the listed names that the model lacks.

    Raises:
        AwError: a photo is on both sides, a spelling fits two photos, or a side has no photo in the model.
    """
    in_model = list(names)
    exact, by_key, by_base, by_any_case = (
        set(in_model),
        grouped(in_model, key),
        grouped(in_model, lambda n: key(PurePosixPath(n).name)),
        grouped(in_model, lambda n: key(n).casefold()),
    )
    split: dict[str, Split] = {}
    missing: dict[Split, list[str]] = {}
    for side in SIDES:
        missing[side] = []
        for name in listed[side]:
            fits = [name] if name in exact else by_key.get(key(name)) or by_base.get(key(name), [])
            fits = fits or by_any_case.get(key(name).casefold(), [])
            if len(fits) > 1:
                raise AwError(
                    f"{where}: {name!r} fits {shortlist(fits, 3)}; write the extension or the folder"
                )
            if not fits:
                missing[side].append(name)
            elif split.setdefault(fits[0], side) != side:
                raise AwError(f"{where}: {name!r} is in the training and in the test list; keep it in one")
    for side in SIDES:
        if side not in split.values():
            if not listed[side]:
                raise AwError(f"{where} lists no {side} photos: add them, or leave the lists out")
            raise AwError(
                f"{where}: none of the {len(listed[side])} {side} photos is in the model "
                f"({shortlist(listed[side], 3)}; the model has {shortlist(sorted(in_model), 3)}): the list "
                "belongs to another scene"
            )
    return split, missing


def pose_from_opengl(matrix: np.ndarray) -> np.ndarray:
    """Convert camera-to-world [4, 4] with OpenGL axes (y up, z back) to cam_from_world with OpenCV axes.

    Raises:
        AwError: it is no rigid motion.
    """
    c2w = np.asarray(matrix, dtype=np.float64)
    if c2w.shape not in ((4, 4), (3, 4)) or not np.isfinite(c2w).all():
        raise AwError(f"a transform_matrix of shape {list(c2w.shape)} is not [4, 4] finite numbers")
    if c2w.shape == (4, 4) and not np.allclose(c2w[3], (0.0, 0.0, 0.0, 1.0)):
        raise AwError(f"a transform_matrix has the last row {c2w[3].tolist()}, not 0, 0, 0, 1 (transposed?)")
    rotation = c2w[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise AwError("a transform_matrix has no rotation in its left 3x3 part (scaled or mirrored)")
    if not (np.abs(c2w[:3, 3]) < LARGEST_COORDINATE).all():
        raise AwError(f"a transform_matrix has the position {c2w[:3, 3].tolist()}, which is too far away")
    return pose_at(c2w[:3, 3], rotation.T)
