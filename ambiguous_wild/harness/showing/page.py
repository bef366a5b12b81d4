"""What `aw view RUNS` does, as a call; and the same page in a notebook."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from pathlib import Path

from ambiguous_wild.harness.showing.read import read_models
from ambiguous_wild.viewing.page_file import MOST_GAUSSIANS, Page, check_page_folder, page_text, write_page


def view_runs(
    paths: Sequence[Path],
    output: Path,
    *,
    scene: str | None = None,
    scene_folder: Path | None = None,
    most_gaussians: int = MOST_GAUSSIANS,
    title: str | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Page:
    """Write OUTPUT/index.html with the models of runs.

    Args:
        paths: run folders, or folders of runs, all of one scene.
        output: folder of the page.
        scene: name of the scene, where the runs are of several.
        scene_folder: where it lies; None = where the runs say.
        most_gaussians: a larger model is reduced to so many, with a note on the page.
        title: of the page; None = the scene's name.
        say: told what is done.

    Raises:
        AwError: no run with a model, several scenes, no scene, or another page in the folder.
    """
    check_page_folder(output)
    shown = read_models(paths, scene=scene, scene_folder=scene_folder)
    return write_page(
        output,
        shown.scene,
        shown.models,
        title=shown.scene.name if title is None else title,
        most_gaussians=most_gaussians,
        notes=shown.notes,
        say=say,
    )


class Viewer:
    """The page of one or more runs, shown by a notebook in a frame of its own."""

    def __init__(self, paths: Sequence[Path], *, height: int = 640, scene_folder: Path | None = None) -> None:
        """
        Args:
            paths: run folders, or folders of runs, all of one scene.
            height: of the frame, px.
            scene_folder: where the scene lies; None = where the runs say.

        Raises:
            AwError: as `view_runs`.
        """
        shown = read_models(paths, scene_folder=scene_folder)
        self.labels = tuple(model.label for model in shown.models)
        self.height = height
        self.page, _, _ = page_text(shown.scene, shown.models, title=shown.scene.name, notes=shown.notes)

    def __repr__(self) -> str:
        return f"Viewer of {', '.join(self.labels)}; a notebook shows it, 'aw view' writes it to a file"

    def _repr_html_(self) -> str:
        """A frame without access to the notebook's page; its scripts run."""
        page = html.escape(self.page, quote=True)
        return (
            f'<iframe sandbox="allow-scripts" srcdoc="{page}" '
            f'style="width:100%;height:{self.height}px;border:0"></iframe>'
        )
