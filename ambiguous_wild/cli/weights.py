"""`aw weights`: list, download and check pretrained networks."""

from __future__ import annotations

import dataclasses
import json

import click

from ambiguous_wild.cli.options import CommandGroup, json_option
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.io.terminal import say


@click.group("weights", cls=CommandGroup)
def command() -> None:
    """Pretrained networks for LPIPS, features and instance masks. No method needs them by default.

    \b
    aw weights list                           all networks, their size, licence and source
    aw weights get lpips efficientnet-lite0   download
    aw weights check                          load downloaded networks and compare hashes
    """


@command.command(name="list")
@json_option
def list_command(as_json: bool) -> None:
    """List every network: size, licence, source, use, and whether it is on this machine."""
    from ambiguous_wild.core.weight_files import folder_fault, weights_folder
    from ambiguous_wild.vision import weight_registry

    every = weight_registry.KNOWN + weight_registry.OTHER_SIZES
    rows = list(zip(every, weight_registry.status(every)))
    if as_json:
        facts = [
            {
                "name": w.name, "present": line.present, "where": line.where, "size_mb": w.size_mb,
                "licence": w.licence, "source": w.source, "used_for": w.used_for,
                "archive_sha256": w.package.sha256 if w.package else None,
                "tensors_sha256": w.tensors or None,
            }
            for w, line in rows
        ]  # fmt: skip
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
        return
    width, source = (
        max(len(text) for text in texts) for texts in zip(*((w.name, w.source) for w, _ in rows))
    )
    for w, line in rows:
        mark, colour = ("✓", "green") if line.present else ("·", "")
        size = f"{w.size_mb:.0f} MB" if w.size_mb >= 1 else f"{w.size_mb * 1000:.0f} kB"
        text = (
            f"{mark} {w.name.ljust(width)}  {size.rjust(7)}  {w.source.ljust(source)}  {w.licence.ljust(18)}"
        )
        say(f"{text}  {w.used_for}", out=True, fg=colour, only=mark)
    for name, members in weight_registry.GROUPS.items():
        click.echo()
        say(f"{name} = {', '.join(members)}", out=True)
    present = sum(line.present for _, line in rows)
    how = folder_fault() or f"'aw weights get NAME' downloads into {weights_folder()}"
    say(f"{present} of {len(rows)} on this machine; {how}", out=True)


@command.command(name="get")
@click.argument("names", nargs=-1, required=True)
@click.option("--overwrite", "again", is_flag=True, help="Download networks again that seem complete.")
@json_option
def get_command(names: tuple[str, ...], again: bool, as_json: bool) -> None:
    """Download networks into AW_WEIGHTS (by default ~/.cache/ambiguous_wild/weights).

    A network that is already there is checked, and downloaded again only if it is damaged. Hashes are checked;
    pickles are converted to safetensors, and only arrays are read from them.
    """
    from ambiguous_wild.vision import weight_download, weight_registry

    wanted = weight_registry.select_weights(names)
    places = weight_download.download_weights(wanted, say, again)
    if as_json:
        rows = [{"name": w.name, "where": str(place)} for w, place in zip(wanted, places)]
        click.echo(json.dumps(rows, indent=2))


@command.command(name="check")
@click.argument("names", nargs=-1)
@json_option
def check_command(names: tuple[str, ...], as_json: bool) -> None:
    """Load networks completely and compare hashes; without NAMES all that are on this machine.

    Exit code 2 if one is missing, damaged, or not the network that its name says.
    """
    from ambiguous_wild.core.weight_files import folder_fault
    from ambiguous_wild.vision import weight_registry
    from ambiguous_wild.vision.weight_check import verify

    every = weight_registry.KNOWN + weight_registry.OTHER_SIZES
    wanted = (
        weight_registry.select_weights(names)
        if names
        else [w for w in every if weight_registry.weight_path(w) is not None]
    )
    verdicts = []
    for weight in wanted:
        verdicts.append(verify(weight))
        if not as_json:
            mark, colour = ("✓", "green") if verdicts[-1].ok else ("✗", "red")
            say(f"{mark} {weight.name}: {verdicts[-1].detail}", out=True, fg=colour, only=mark)
    if as_json:
        click.echo(json.dumps([dataclasses.asdict(v) for v in verdicts], indent=2, ensure_ascii=False))
    elif not wanted:
        how = folder_fault() or "'aw weights list' lists what can be downloaded"
        say(f"no weights on this machine; {how}", out=True)
    wrong = [v for v in verdicts if not v.ok]
    if wrong:
        raise AwError(
            f"{counted(len(wrong), 'network')} of {len(verdicts)} cannot be used: {wrong[0].name}: {wrong[0].detail}"
        )
