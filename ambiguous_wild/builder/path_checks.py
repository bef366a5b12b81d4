"""Checks on the folders of a build: photos and scene lie apart, and the photos are no scene."""

from __future__ import annotations

from pathlib import Path

from ambiguous_wild.core.errors import AwError


def check_paths(raw: Path | str, target: Path) -> None:
    """Refuse a scene folder among the photos, and photos that are a scene.

    Args:
        raw: the capture folder, as given.
        target: the scene folder, absolute.

    Raises:
        AwError: `target` holds the photos or lies among them, or `raw` is a scene already.
    """
    root, scene = Path(raw).resolve(), target.resolve()
    if root.is_relative_to(scene):
        raise AwError(f"{target} holds the photos themselves; choose another folder for -o")
    if scene.is_relative_to(root):
        raise AwError(
            f"{target} lies inside {raw}, the folder of photos, which must stay as it is; "
            "choose a folder outside it for -o"
        )
    found = next((n for n in ("scene.json", "sparse") if (root / n).exists()), None)
    if found is not None:
        raise AwError(
            f"{raw} is a scene already (it holds {found}): run 'aw bench' on it, or give the folder of the "
            "original photos"
        )
