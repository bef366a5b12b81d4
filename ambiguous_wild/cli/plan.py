"""`aw plan`: recommend optional effects for a scene."""

from __future__ import annotations

import functools
import json
import math
import shutil
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.options import PathName

if TYPE_CHECKING:
    from ambiguous_wild.core import Scene
    from ambiguous_wild.harness.effects_plan import Decision, Plan

COLUMNS = 100  # of the table
MASKS = (
    "masks: no effect to switch on; a method makes them while it trains (aw bench --method refinesplat, or "
    "another of 'aw methods'), or you give your own (aw build-scene --keep-masks FOLDER)"
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
    help="Try effects and masks in short trainings on small photos; without probes only the limits decide.",
)
@click.option(
    "--iterations",
    type=click.IntRange(1),
    default=30_000,
    show_default=True,
    help="Length of the run that the plan is for: probes take a tenth of it at most.",
)
@click.option(
    "--costs/--no-costs",
    default=False,
    show_default=True,
    help="Measure the time of each effect on this machine.",
)
@click.option(
    "-o", "--output", type=PathName(dir_okay=False), help="File for the plan.  [default: SCENE-plan.json]"
)
@click.option("--json", "as_json", is_flag=True, help="Print the plan as JSON.")
def command(
    scene: Path,
    factor: int | None,
    probe: bool,
    iterations: int,
    costs: bool,
    output: Path | None,
    as_json: bool,
) -> None:
    """Measure SCENE and decide which effects it needs: evidence, limit, gain of a probe, decision and cost.

    An effect that reaches its limit is tried in two short trainings, with and without it, and measured on pixels
    that both leave out. 'aw bench --effects auto' decides the same way, but not about masks.
    """
    from ambiguous_wild.core.errors import AwError
    from ambiguous_wild.harness.effects_plan import plan_without_training
    from ambiguous_wild.harness.select_effects import untried
    from ambiguous_wild.io.files import check_output, write_json
    from ambiguous_wild.io.scene_folder import load_scene

    loaded = load_scene(scene, factor=factor)
    path = output or scene.resolve().parent / f"{scene.resolve().name}-plan.json"
    if path.resolve().is_relative_to(scene.resolve()):
        raise AwError(f"{path} is inside {scene} and would change the scene; choose another -o")
    check_output(path)
    _check_overwrite(path, probe)
    if probe or costs:
        from ambiguous_wild.cli.options import prepare_cpu

        prepare_cpu(None)
    if probe:
        plan = _probed(loaded, iterations, path, as_json)
    else:
        plan = untried(plan_without_training(loaded), "--no-probe")
    if costs:
        from ambiguous_wild.harness.residual_probe import effect_costs

        plan = plan.with_costs(effect_costs(loaded))
    write_json(path, plan.plain())
    if as_json:
        click.echo(json.dumps({**plan.plain(), "file": str(path)}, indent=2))
        return
    for line in table(plan):
        click.echo(line)
    if plan.cost is not None:
        click.echo(plan.cost.line())
    click.echo(f"wrote {path}")


def _probed(scene: Scene, iterations: int, path: Path, quiet: bool) -> Plan:
    """Make the plan from probes; finished probes are kept beside its file until it is written."""
    from tqdm import tqdm

    from ambiguous_wild.harness.make_plan import plan_with_probes
    from ambiguous_wild.splat.pace import TrainConfig

    folder = path.parent / f".{path.name}.probes"
    plan = plan_with_probes(
        scene,
        TrainConfig(iterations=iterations),
        folder,
        masks=True,
        prepare=lambda: None,  # done
        say=lambda text: None if quiet else click.echo(text),
        bar=functools.partial(tqdm, unit="it", desc="probe", disable=quiet or None),
    )
    shutil.rmtree(folder, ignore_errors=True)
    return plan


def _check_overwrite(path: Path, probe: bool) -> None:
    """Refuse to replace any other file than a plan, or a plan with probes by one without."""
    from ambiguous_wild.core.errors import AwError
    from ambiguous_wild.harness.effects_plan import read_plan

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
    """Return the plan as lines of at most `COLUMNS` characters: a table, and a sentence for each effect."""
    head = ("effect", "decision", "found", "on from", "gain on held-back pixels", "ms/iteration")
    rows = [head, *(_row(d) for d in plan.decisions)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths)).rstrip() for row in rows]
    for d in plan.decisions:
        sentence = f"{d.effect} {d.decision}: {d.why} ({d.evidence}, {d.unit})"
        lines += textwrap.wrap(sentence, COLUMNS, subsequent_indent="  ")
    if any(d.effect == "masks" for d in plan.decisions):
        lines += textwrap.wrap(MASKS, COLUMNS, subsequent_indent="  ")
    return [*lines, f"{plan.scene}: --effects {','.join(plan.effects()) or 'none'}"]


def _row(d: Decision) -> tuple[str, ...]:
    found = "—" if math.isnan(d.value) else f"{d.value:.3g}"
    gain = "—" if d.gain_db is None else f"{d.gain_db:+.2f} ± {d.error_db:.2f} dB"
    cost = "—" if d.cost_ms is None else f"{d.cost_ms:+.2f}"
    return d.effect, d.decision, found, f"{d.threshold:g}", gain, cost
