"""`aw plan`: recommend optional effects for a scene."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.options import PathName, json_option, prepare_cpu
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.terminal import line_width, say

if TYPE_CHECKING:
    from ambiguous_wild.harness.effects_plan import Decision, EffectsPlan

NOTHING = "—"  # a cell without a value; a column of them is not printed
COLUMNS = 100  # of the sentences, at most
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
    help="Find out in short trainings on small photos whether distractors call for masks.",
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
@json_option
def command(
    scene: Path,
    factor: int | None,
    probe: bool,
    costs: bool,
    output: Path | None,
    as_json: bool,
) -> None:
    """Measure SCENE and decide which effects it needs: evidence, limit, decision, cost, and a sentence why.

    'aw bench --effects auto' decides the same way. Masks are not its decision, but that of METHOD.
    """
    from ambiguous_wild.harness.cell import scene_identity
    from ambiguous_wild.harness.effects_plan import plan_effects
    from ambiguous_wild.io.files import check_output, write_json
    from ambiguous_wild.io.scene_folder import load_scene

    loaded = load_scene(scene, factor=factor)
    path = output or scene.resolve().parent / f"{scene.resolve().name}-plan.json"
    if path.resolve().is_relative_to(scene.resolve()):
        raise AwError(f"{path} is inside {scene} and would change the scene; choose another -o")
    check_output(path)
    _check_overwrite(path, probe)
    if probe or costs:
        prepare_cpu(None)
    plan = dataclasses.replace(plan_effects(loaded), scene_hash=scene_identity(loaded))
    if probe:
        from tqdm import tqdm

        from ambiguous_wild.harness.mask_plan import with_masks

        bar = functools.partial(tqdm, unit="it", desc="masks", disable=as_json or None)
        plan = with_masks(plan, loaded, bar)
    if costs:
        from ambiguous_wild.harness.mask_plan import effect_costs

        plan = plan.with_costs(effect_costs(loaded))
    write_json(path, plan.plain())
    if as_json:
        click.echo(json.dumps({**plan.plain(), "file": str(path)}, indent=2))
        return
    for line in table(plan):
        say(line, out=True)
    say(f"wrote {path}", out=True)


def _check_overwrite(path: Path, probe: bool) -> None:
    """Refuse to replace any other file than a plan, or a plan with probes by one without."""
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


def table(plan: EffectsPlan) -> list[str]:
    """Return the plan as lines: a table, and a sentence for each effect."""
    columns = min(line_width() or COLUMNS, COLUMNS)
    head = ("effect", "decision", "measured", "limit", "gain on held-out pixels", "ms/iteration")
    rows = [head, *(_row(d) for d in plan.decisions)]
    shown = [k for k in range(len(head)) if any(row[k] != NOTHING for row in rows[1:])]
    rows = [tuple(row[k] for k in shown) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths)).rstrip() for row in rows]
    for d in plan.decisions:
        unit = f", % {d.unit}" if d.unit.startswith("of ") else ""
        evidence = f"measured: {d.evidence}{unit}" if d.unit else d.evidence
        sentence = f"{d.effect} {d.decision}: {d.why} ({evidence})"
        lines += textwrap.wrap(sentence, columns, subsequent_indent="  ")
    if any(d.effect == "masks" for d in plan.decisions):
        lines += textwrap.wrap(MASKS, columns, subsequent_indent="  ")
    return [*lines, f"{plan.scene}: --effects {','.join(plan.effects()) or 'none'}"]


def _row(d: Decision) -> tuple[str, ...]:
    measured = NOTHING if math.isnan(d.value) or not d.unit else _with_unit(d.value, d.unit)
    side = "up to" if d.unit == "photos" else "from"
    limit = f"{side} {_with_unit(d.threshold, d.unit)}" if d.unit else NOTHING
    gain = NOTHING if d.gain_db is None else f"{d.gain_db:+.2f} ± {d.error_db:.2f} dB"
    cost = NOTHING if d.cost_ms is None else f"{d.cost_ms:+.2f}"
    return d.effect, d.decision, measured, limit, gain, cost


def _with_unit(value: float, unit: str) -> str:
    return f"{100 * value:.3g} %" if unit.startswith("of ") else f"{value:.3g} {unit}"
