"""A scene in somebody else's layout, read but not yet written as a scene folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal, TypedDict

import numpy as np

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.scene import Split
from ambiguous_wild.io.colmap_records import LARGEST_COORDINATE, Model
from ambiguous_wild.io.scene_folder import TEST_EVERY

SIDES: tuple[Split, Split] = ("train", "test")
LARGEST = 100_000_000  # bytes of a text file
SUFFIXES = (".jpg", ".jpeg", ".png", ".JPG", ".JPEG", ".PNG")


class Evaluation(TypedDict, total=False):
    """How the dataset's papers measure: scene.json's key "evaluation", which `aw bench` follows."""

    protocol: Literal["full", "half"]
    effects: list[str]  # fitted on the left half of a test photo
    source: str


@dataclass(frozen=True)
class ForeignScene:
    """What every reader gives.

    Names are those of the model, relative to the folder of photos.
    """

    kind: str  # the layout, a key of `readers.READERS`
    root: Path
    model: Model  # poses and cameras at full size; may have no points
    photos: Path  # folder that the model's names refer to
    split: dict[str, Split]  # photos of neither side are left out
    factor: int = 1  # as published
    missing: dict[Split, list[str]] = field(default_factory=dict)  # listed names that the model lacks
    masks: dict[str, Path] = field(default_factory=dict)  # keep masks of training photos, white = keep
    max_width: int | None = None  # px; wider photos are reduced to it
    background: tuple[int, int, int] | None = None  # RGB, put behind photos with alpha
    dataset: str = ""  # as result tables call it
    evaluation: Evaluation = field(default_factory=Evaluation)
    points: Literal["model", "triangulate", "random"] = "model"  # where initial points come from
    notes: tuple[str, ...] = ()  # what was decided or left out


def inside(name: str, root: Path) -> str:
    """A relative name of the dataset, checked to stay below its folder.

    Raises:
        AwError: it is absolute, empty or holds "..".
    """
    pure = PurePosixPath(name)
    if not name.isprintable():  # lists hold one name a line, in UTF-8
        raise AwError(f"{root} has a photo called {ascii(name)[:80]}, which no list can hold; rename it")
    if pure.is_absolute() or ".." in pure.parts or not pure.parts or "\\" in name or "\0" in name:
        raise AwError(f"{root} names a file outside itself: {name[:80]!r}; do not use this dataset")
    return str(pure)


def read_text(path: Path) -> str:
    """A text file in UTF-8, with or without byte order mark.

    Raises:
        AwError: unreadable, too large, or another encoding.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise AwError(f"{path} is larger than {LARGEST // 10**6} MB")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise AwError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise AwError(f"{path} is no text in UTF-8; export it again") from error


def without_suffix(name: str) -> str:
    """The name without its last extension."""
    return str(PurePosixPath(name).with_suffix(""))


def plain(name: str) -> str:
    """A scene's name without what its spellings differ in: Patio-High, patio_high."""
    return "".join(c for c in name.casefold() if c.isalnum())


def split_by_lists(
    names: Iterable[str],
    listed: Mapping[Split, list[str]],
    where: Path,
    key: Callable[[str], str] = without_suffix,
) -> tuple[dict[str, Split], dict[Split, list[str]]]:
    """Sides of the model's photos by lists of names, with or without extension or folder.

    Args:
        names: of the model.
        listed: names by side.
        where: of the lists, for messages.
        key: what two spellings of one photo share.

    Returns:
        Sides by name, and per side the listed names that the model lacks.

    Raises:
        AwError: a photo is on both sides, a spelling fits two photos, or a side has no photo in the model.
    """
    known = list(names)
    exact, by_key, by_base = (
        set(known),
        _index(known, key),
        _index(known, lambda n: key(PurePosixPath(n).name)),
    )
    split: dict[str, Split] = {}
    missing: dict[Split, list[str]] = {}
    for side in SIDES:
        missing[side] = []
        for name in listed[side]:
            found = [name] if name in exact else by_key.get(key(name)) or by_base.get(key(name), [])
            if len(found) > 1:
                raise AwError(
                    f"{where}: {name!r} fits {shortlist(found, 3)}; write the extension or the folder"
                )
            if not found:
                missing[side].append(name)
            elif split.setdefault(found[0], side) != side:
                raise AwError(f"{where}: {name!r} is in the training and in the test list; keep it in one")
    for side in SIDES:
        if side not in split.values():
            raise AwError(
                f"{where}: none of the {len(listed[side])} {side} photos is in the model "
                f"({shortlist(listed[side], 3)}; the model has {shortlist(sorted(known), 3)}): the "
                "list belongs "
                "to another scene"
            )
    return split, missing


def _index(names: Iterable[str], key: Callable[[str], str]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(key(name), []).append(name)
    return found


def every_nth(names: Iterable[str]) -> tuple[dict[str, Split], str]:
    """Sides where the dataset states none: every 8th photo tests; and the note that says so."""
    sides: dict[str, Split] = {n: "train" if i % TEST_EVERY else "test" for i, n in enumerate(sorted(names))}
    return sides, f"no test set given: every {TEST_EVERY}th photo tests, distractors in it count as truth"


def find_photo(folder: Path, name: str) -> Path | None:
    """The photo's file below `folder`, under another extension where it must be; None where it is absent."""
    exact = folder / name
    if exact.is_file():
        return exact
    # A copy may have been saved in another format; names with several dots keep all but the last part.
    base = exact.with_suffix("") if exact.suffix in SUFFIXES else exact
    for suffix in SUFFIXES:
        path = base.with_name(base.name + suffix)
        if path.is_file():
            return path
    return None


def pose_from_opengl(matrix: np.ndarray) -> np.ndarray:
    """[4, 4] camera-to-world with OpenGL axes (y up, z back) to cam_from_world with OpenCV axes.

    Raises:
        AwError: it is no rigid motion.
    """
    c2w = np.asarray(matrix, dtype=np.float64)
    if c2w.shape not in ((4, 4), (3, 4)) or not np.isfinite(c2w).all():
        raise AwError(f"a transform_matrix of shape {list(c2w.shape)} is not [4, 4] finite numbers")
    rotation = c2w[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise AwError("a transform_matrix has no rotation in its left 3x3 part (scaled or mirrored)")
    if not (np.abs(c2w[:3, 3]) < LARGEST_COORDINATE).all():
        raise AwError(f"a transform_matrix has the position {c2w[:3, 3].tolist()}, which is too far away")
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ c2w[:3, 3]
    return pose


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """[3, 3] to (w, x, y, z), w >= 0; source: Shepperd 1978."""
    m = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(m)
    choice = int(np.argmax([trace, m[0, 0], m[1, 1], m[2, 2]]))
    if choice == 0:
        q = np.array([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        i, j, k = ((0, 1, 2), (1, 2, 0), (2, 0, 1))[choice - 1]
        q = np.zeros(4)
        q[0] = m[k, j] - m[j, k]
        q[1 + i] = 1 + m[i, i] - m[j, j] - m[k, k]
        q[1 + j] = m[j, i] + m[i, j]
        q[1 + k] = m[k, i] + m[i, k]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q
