"""What comes before the first run: the recipes are tried, the CPU kernels are made ready."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.harness.running.cell import Cell


def try_recipes(cells: Sequence[Cell]) -> None:
    """Put every method's parts together once: the last method's fault is found before the first is trained.

    Raises:
        AwError: an option or the weights that a recipe refuses. Other errors are a run's own.
    """
    from ambiguous_wild.splat.effects import with_effects

    different = {(cell.method.name, repr(cell.options), cell.chosen.effects): cell for cell in cells}
    for cell in different.values():
        try:
            with_effects(cell.method.build(cell.options), cell.chosen.effects)
        except AwError as error:
            raise AwError(f"{cell.method.name}: {error}") from error
        except Exception:
            continue  # a plug-in's bug: its runs fail with their traceback, the others are trained


def check_grafts(cells: Sequence[Cell]) -> list[str]:
    """Warnings of grafts, each once.

    Raises:
        AwError: a graft that could not train, or would change nothing.
    """
    from ambiguous_wild.methods.graft import check_graft

    lines = []
    for name, cell in {cell.method.name: cell for cell in cells}.items():
        try:
            lines += [f"warning: {name}: {line}" for line in check_graft(cell.method, cell.options)]
        except AwError as error:
            raise AwError(f"{name}: {error}") from error
    return lines


def prepare_cpu(threads: int | None, say: Callable[[str], None] = lambda text: None) -> None:
    """Set the threads of the kernels and compile them, once per machine.

    Args:
        threads: of the kernels; None = as many as there are.
        say: told when something is compiled.
    """
    from ambiguous_wild.splat.calibration import warm_up
    from ambiguous_wild.splat.cpu import set_threads

    if threads is not None:
        set_threads(threads)
    warm_up(say)
