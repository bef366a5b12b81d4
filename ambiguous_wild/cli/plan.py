"""`aw plan`: recommend optional effects for a scene."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.paths import PathName

if TYPE_CHECKING:
    from ambiguous_wild.harness.planning.decide import Decision, Plan

MASKS = (
    "masks: no effect to switch on; a method makes them while it trains (aw bench --method refinesplat, or "
    "another of 'aw methods'), or you give your own (aw build-scene --masks FOLDER)"
)


@click.command("plan")
@click.argument("scene", type=PathName())
@click.option(
    "--factor", type=click.IntRange(1), help="Use the photos in images_N.  [default: as the scene was built]"
)
@click.option(
    "--probe/--no-probe",
    default=True,
    show_default=True,
    help="Train 3DGS on small photos to decide about masks; other effects do not need it.",
)
@click.option(
    "--costs/--no-costs",
    default=False,
    show_default=True,
    help="Measure the time of each effect on this machine.",
)
@click.option(
    "-o", "--out", type=PathName(dir_okay=False), help="File for the plan.  [default: SCENE-plan.json]"
)
@click.option("--json", "as_json", is_flag=True, help="Print the plan as JSON.")
def command(
    scene: Path, factor: int | None, probe: bool, costs: bool, out: Path | None, as_json: bool
) -> None:
    """Measure SCENE and decide which effects it needs: evidence, threshold, decision and (--costs) cost.

    'aw bench --effects auto' makes the same decisions, but without the probe.
    """
    from ambiguous_wild.core.errors import AwError
    from ambiguous_wild.harness.planning.decide import plan_without_training
    from ambiguous_wild.io.atomic import check_output, write_json
    from ambiguous_wild.io.scene_folder import load_scene

    loaded = load_scene(scene, factor=factor)
    path = out or scene.resolve().parent / f"{scene.resolve().name}-plan.json"
    if path.resolve().is_relative_to(scene.resolve()):
        raise AwError(f"{path} is inside {scene} and would change the scene; choose another -o")
    check_output(path)
    _check_overwrite(path, probe)
    plan = plan_without_training(loaded)
    if probe or costs:
        from ambiguous_wild.cli.devices import prepare_cpu

        prepare_cpu(None)
    if probe:
        from tqdm import tqdm

        from ambiguous_wild.harness.planning.probe import stays, with_occlusion

        colour = tuple(e for e in plan.effects(("exposure", "appearance")))
        bar = functools.partial(tqdm, unit="it", desc="probe", disable=as_json or None)
        plan = with_occlusion(plan, stays(loaded, colour, bar=bar))
    if costs:
        from ambiguous_wild.harness.planning.probe import effect_costs

        plan = plan.with_costs(effect_costs(loaded))
    write_json(path, plan.plain())
    if as_json:
        click.echo(json.dumps({**plan.plain(), "file": str(path)}, indent=2))
        return
    for line in table(plan):
        click.echo(line)
    click.echo(f"wrote {path}")


def _check_overwrite(path: Path, probe: bool) -> None:
    """Only an earlier plan may be replaced, and not one with a probe by one without."""
    from ambiguous_wild.core.errors import AwError
    from ambiguous_wild.harness.planning.file import read_plan

    if not path.exists():
        return
    try:
        earlier = read_plan(path)
    except AwError:
        raise AwError(f"{path} exists and is not a plan of 'aw plan'; choose another -o") from None
    if earlier.probed and not probe:
        raise AwError(
            f"{path} holds the result of a probe, which --no-probe would discard; choose another -o"
        )


def table(plan: Plan) -> list[str]:
    """The plan as text lines for a terminal."""
    head = ("effect", "evidence", "found", "from", "decision", "ms/iteration", "why")
    rows = [head, *(_row(d) for d in plan.decisions)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(head) - 1)]
    lines = ["  ".join([*(cell.ljust(w) for cell, w in zip(row, widths)), row[-1]]).rstrip() for row in rows]
    effects = ",".join(plan.effects()) or "none"
    masks = [MASKS] if any(d.effect == "masks" for d in plan.decisions) else []
    return [*lines, *masks, f"{plan.scene}: --effects {effects}"]


def _row(d: Decision) -> tuple[str, ...]:
    found = "—" if math.isnan(d.value) else f"{d.value:.3g} {d.unit}"
    cost = "—" if d.cost_ms is None else f"{d.cost_ms:+.2f}"
    return d.effect, d.evidence, found, f"{d.threshold:g}", d.decision, cost, d.why
