"""Types and options that several commands share, and the choice of the device."""

from __future__ import annotations

import contextlib
import functools
import math
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from ambiguous_wild.core.errors import AwError, similar_path
from ambiguous_wild.core.names import name_from
from ambiguous_wild.io.terminal import say

# Heading -> options, of every command that has them.
OPTION_SECTIONS: dict[str, tuple[str, ...]] = {
    "Most used": ("-o", "--method", "--scene", "--group", "--budget", "--iterations", "--seed", "--effects",
                  "--mask", "--jobs", "--overwrite", "--name", "--test-list", "--keep-masks"),
    "Structure from motion": ("--sfm", "--matcher", "--mapper", "--camera", "--max-features", "--part"),
    "Training": ("--set", "--sweep", "--resolution", "--factor", "--max-gaussians", "--start", "--suite", "--poses",
                 "--protocol", "--plugin", "--metric-file"),
    "Ray": ("--engine", "--address"),
}  # fmt: skip

PHOTO_FOLDERS = ("images", "photos", "input", "rgb")  # name no scene: the folder above does


class PathName(click.Path):
    """A path; an empty name is an error (an unset variable in a script), not the current folder."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(path_type=Path, **kwargs)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("the name is empty; write . for the current folder", param, ctx)
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter as error:
            hint = similar_path(value) if "does not exist" in error.message else ""
            if not hint:
                raise
            self.fail(error.message.rstrip(".") + hint, param, ctx)


class PathOrAlone(PathName):
    """The path after an option that may also stand alone, which gives True."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if value is True else super().convert(value, param, ctx)


class FiniteFloat(click.FloatRange):
    """A finite number; click lets NaN pass every range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number

    def _describe_range(self) -> str:
        return "" if self.min is None and self.max is None else super()._describe_range()


class Count(click.IntRange):
    """A whole number, also as 10k."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        thousands = re.fullmatch(r"(\d{1,6}(?:\.\d{1,3})?)k", value) if isinstance(value, str) else None
        return super().convert(round(float(thousands[1]) * 1000) if thousands else value, param, ctx)


class Format(click.Choice[str]):
    """A format by its name, or by another name that people use for it."""

    def __init__(
        self, names: Sequence[str], also: Mapping[str, str] = {}, unsupported: Mapping[str, str] = {}
    ) -> None:
        super().__init__(names)
        self.also, self.unsupported = also, unsupported

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value in self.unsupported:
            self.fail(f"{value!r} is not supported: {self.unsupported[value]}", param, ctx)
        return super().convert(self.also.get(value, value), param, ctx)


class SectionedCommand(click.Command):
    """A command of many options: its help shows them under headings, the most used ones first."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        left = [param for param in self.get_params(ctx) if isinstance(param, click.Option)]
        for heading, flags in OPTION_SECTIONS.items():
            under = sorted(
                (option for option in left if option.opts[0] in flags),
                key=lambda option: flags.index(option.opts[0]),
            )
            left = [option for option in left if option not in under]
            _write_section(ctx, formatter, heading, under)
        _write_section(ctx, formatter, "Other options", left)


class CommandGroup(click.Group):
    """A group whose help shows the first sentence of each command whole."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            rows = [(name, self.commands[name].get_short_help_str(limit=1000)) for name in self.commands]
            formatter.write_dl(rows)


def _write_section(
    ctx: click.Context, formatter: click.HelpFormatter, heading: str, options: Sequence[click.Option]
) -> None:
    rows = [row for option in options if (row := option.get_help_record(ctx))]
    if rows:
        with formatter.section(heading):
            formatter.write_dl(rows)


def _load_plugins(_: click.Context, __: click.Parameter, paths: tuple[Path, ...]) -> None:
    """Register the methods of the files, before the command runs."""
    if paths:
        from ambiguous_wild.methods.registry import load_plugin

        for path in paths:
            load_plugin(path)


_plugins = functools.partial(
    click.option, "--plugin", "plugins", multiple=True, type=PathName(),
    help="FILE.py:RECIPE, or a Python file that registers your methods; repeatable.",
)  # fmt: skip
plugin_option = _plugins(callback=_load_plugins, expose_value=False)
metric_file_option = click.option("--metric-file", "metrics", multiple=True, type=PathName(),
    help="A Python file with a metric of your own (docs/metrics.md); repeatable.")  # fmt: skip
scene_folder_option = click.option(
    "--scene",
    "scene_folder",
    type=PathName(file_okay=False),
    help="The scene folder, if it was moved.  [default: as the runs say]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
name_option = click.option("--name", help="Name of the scene.  [default: the output folder's]")
license_option = click.option("--license", default="", help="Licence of the photos, recorded in scene.json.")
threads_option = click.option(
    "--threads", type=click.IntRange(1), help="CPU threads; they do not change the result."
)
only_option = click.option(
    "--only",
    "scenes",
    multiple=True,
    metavar="NAME",
    help="Only the scene of this name; repeatable.  [default: all]",
)
label_option = click.option(
    "--label", "labels", multiple=True, metavar="METHOD[=NAME]",
    help="Show METHOD as NAME; repeatable. Methods follow in the order of their labels, after those without "
    "one.",
)  # fmt: skip


def device_option(help: str) -> Callable[..., Any]:
    """Return the option --device."""
    choices = click.Choice(["auto", "cpu", "cuda"])
    return click.option("--device", type=choices, default="auto", show_default=True, help=help)


def seed_option(help: str) -> Callable[..., Any]:
    """Return the option --seed for one seed."""
    return click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help=help)


def title_option(default: str) -> Callable[..., Any]:
    """Return the option --title of a page."""
    return click.option("--title", default=default, show_default=True, help="Title of the page.")


def reported_option(default: str) -> Callable[..., Any]:
    """Return the option --reported: None, True where it stands alone, or the path after it."""
    return click.option(
        "--reported", is_flag=False, flag_value=True, type=PathOrAlone(), metavar="[PATH]",
        help="Also show numbers from papers, in rows of their own; PATH: CSV files of yours instead of "
        f"{default}.",
    )  # fmt: skip


def _all(*options: Callable[..., Any]) -> Callable[..., Any]:
    """Return a decorator that adds these options to a click command."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


training_options = _all(
    click.option(
        "--seed",
        "seeds",
        multiple=True,
        type=click.IntRange(0),
        default=(0,),
        show_default=True,
        help="Random seed; repeatable.",
    ),
    click.option(
        "--iterations",
        type=Count(1),
        help="Training iterations, also as 10k.  [default: 200 per train photo, 7000 to 30000]",
    ),
    device_option("auto: the GPU if torch and gsplat can use one, else the CPU."),
    threads_option,
    click.option(
        "--factor",
        type=click.IntRange(1),
        help="Train on the photos in images_N, 1/N of their size.  [default: as the scene was built]",
    ),
    click.option(
        "--max-gaussians",
        type=click.IntRange(4),
        help="Growth stops at this number of Gaussians.  [default: the method's]",
    ),
    _plugins(),  # a run in another process needs the files too
    click.option(
        "--overwrite",
        type=click.Choice(["never", "missing", "longer", "changed", "always"]),
        is_flag=False,
        flag_value="always",
        default="missing",
        show_default=True,
        help="missing: train unfinished runs; longer: also continue shorter ones; changed: also train again where "
        "the method's file has changed; never: skip existing folders; always, or no word: train all again.",
    ),
    click.option(
        "--cache",
        type=PathName(),
        help="Folder for features and instance masks.  [default: OUTPUT/.cache]",
    ),
)


engine_options = _all(  # fields of `Engine`
    click.option("--engine", type=click.Choice(["local", "ray"]), default="local", show_default=True,
                 help="local: this machine; ray: Ray, also on a cluster (docs/cluster.md)."),
    click.option("--jobs", type=click.IntRange(1),
                 help="Runs at a time on this machine; they share cores.  [default: 1; on cuda one per GPU]"),
    click.option("--address",
                 help="Ray: auto, HOST:PORT, ray://HOST:10001.  [default: $RAY_ADDRESS, else this machine]"),
)  # fmt: skip


def choose_device(device: str) -> str:
    """Choose the device for "cpu", "cuda" or "auto": auto is the GPU if torch and gsplat can use one.

    Compiles gsplat's kernels if needed; reports a GPU that cannot be used on stderr.

    Raises:
        AwError: cuda was requested but cannot be used; the message names what is missing.
    """
    if device == "cpu":
        return "cpu"
    from ambiguous_wild.splat.readiness import choose_device

    return choose_device(device, say)


def prepare_cpu(threads: int | None) -> None:
    """Set the number of threads and compile the CPU kernels, once per machine."""
    from ambiguous_wild.splat import calibration

    calibration.prepare_cpu(threads, say)


def threads_words(threads: int | None) -> list[str]:
    """Return the option --threads for a command of ours, if it was given."""
    return ["--threads", str(threads)] if threads else []


def print_command(*words: str | Path) -> None:
    """Print a command of ours as one line to copy."""
    with contextlib.suppress(BrokenPipeError):  # as `say` does
        click.echo(f"\n$ aw {shlex.join(map(str, words))}", err=True)


def own_step(ctx: click.Context, *words: str | Path) -> None:
    """Print a command of ours and run it, for commands that consist of others.

    Raises:
        AwError: the command's.
    """
    print_command(*words)
    try:
        root, text = ctx.find_root().command, list(map(str, words))
        root.main(text, prog_name="aw", standalone_mode=False, obj=ctx.info_name)
    except AwError as error:
        if "--overwrite" not in str(error):
            raise
        raise AwError(
            f"{error} ('aw {ctx.info_name}' has no such option: give it to the step printed above)"
        ) from None


def is_own_step() -> bool:
    """Whether another command of ours runs the present one by `own_step`, and says itself what comes next."""
    return click.get_current_context().obj is not None


def scene_name(photos: Path) -> str:
    """Return the name of a scene of these photos: that of their folder, or of the one above images/.

    No option of `aw try` and `aw masks` names it, so a folder of any name gives a valid one.
    """
    named = photos.resolve()
    if named.name.lower() in PHOTO_FOLDERS and named.parent.name:
        named = named.parent
    return name_from(named.stem)


def style_of(output: Path | None, suffixes: Mapping[str, str], otherwise: str = "") -> str:
    """Return the format that the ending of the name of -o says.

    Raises:
        AwError: no format has this ending; the message ends with `otherwise`, another way to choose one.
    """
    suffix = output.suffix.lower() if output is not None else ""
    if suffix not in suffixes:
        known = ", ".join(s for s in suffixes if s)
        why = f"no format is known for {suffix}: " if suffix else ""
        raise AwError(f"-o {output}: {why}end the name in {known}{otherwise}")
    return suffixes[suffix]


def command_line(**values: Any) -> str:
    """Return the present command, as it makes the same result again: with all options that are not at their default.

    Args:
        values: values to write in place of those that were given; None, False or () leaves an option out.
    """
    context = click.get_current_context()
    words = ["aw", str(context.info_name)]
    for param in context.command.params:
        value = (context.params | values).get(str(param.name))
        if value is None or value is False or value in ((), param.default):
            continue
        for one in value if isinstance(value, tuple) else [value]:
            words += param.opts[:1] if isinstance(param, click.Option) else []
            words += [] if one is True else [f"{one:g}" if isinstance(one, float) else str(one)]
    return shlex.join(words)
