"""`aw`: parse, call, print. A command's module is imported only when that command runs."""

from __future__ import annotations

import contextlib
import errno
import importlib
import io
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import click

from ambiguous_wild import __version__
from ambiguous_wild.core.errors import AwError, disk_line, logged_to, unknown
from ambiguous_wild.io.terminal import say

# Heading of `aw --help` -> command -> (module, one line of help), in the order of the work. Help is here so that
# `aw --help` imports no command.
SECTIONS = {
    "In one go": {
        "try": ("try_all", "Try it on your photos or video: scene, splat without distractors, masks, page."),
        "masks": (
            "photo_masks",
            "Masks of your photos, or of a run, in the names of COLMAP, RealityScan, ...",
        ),
    },
    "Photos": {
        "simulate": (
            "simulate",
            "Simulate a capture with exact truth: poses, distractor masks, clean photos.",
        ),
        "composite": (
            "simulate",
            "Add distractors with exact masks to a scene of real photos, or to plain photos.",
        ),
        "capture": ("capture", "Select sharp, evenly spaced photos from a video, a folder or a camera."),
        "screen": ("capture", "Check a capture: exposure, white balance, focus, blur, overlap; with advice."),
        "build-scene": (
            "build_scene",
            "Build a scene from a folder of photos: check, COLMAP, downsample, split.",
        ),
        "import": ("datasets", "Import a scene of a public dataset: On-the-go, RobustNeRF, COLMAP, ..."),
        "fetch": ("datasets", "Download a public dataset, resumed and checked by its hash."),
        "export-scene": ("datasets", "Write a scene for nerfstudio, NerfBaselines, COLMAP, or as On-the-go."),
        "ambiguity-report": ("ambiguity_report", "Measure how similar the distractors are to the scene."),
    },
    "Train": {
        "plan": ("plan", "Recommend optional effects for a scene, with their cost."),
        "bench": ("bench", "Train methods on scenes and evaluate them."),
        "ablate": ("ablate", "Measure the gain and cost of each part of a method."),
        "methods": ("methods", "List the methods; with a name, show one in full."),
        "weights": ("weights", "Pretrained networks: list, download, check."),
        "doctor": ("doctor", "Check this machine: missing dependencies and the commands that install them."),
    },
    "Compare": {
        "table": ("table", "Compare runs in tables: terminal, Markdown, CSV, LaTeX, HTML."),
        "figure": ("figure", "Renders side by side with zooms, for a paper: PDF, PNG, SVG."),
        "statement": ("statement", "Write the paragraph on reproducibility of a paper, with its commands."),
        "cost": ("cost", "Accuracy against training time: tables and plots."),
        "study": ("study", "Blind user study: which distractor is hard to see, which render is better."),
    },
    "Look": {
        "view": ("view", "Write a page to fly through models and compare them; or watch a training."),
        "video": ("view", "Film models side by side along one camera path: mp4, GIF."),
        "explain": ("explain", "Say why a pixel of a train photo is masked or kept."),
        "export": ("view", "Write models as compressed PLY, SPZ, SOG and glTF, with the loss in dB."),
    },
    "Publish": {
        "leaderboard": ("leaderboard", "Check runs, collect them in CSV files and publish them as a page."),
        "package": ("datasets", "Pack scenes for release: archives, checksums, Croissant, data card."),
    },
    "For maintainers": {
        "stress": ("stress", "Numerical stress tests against float64; replay of a training that met a NaN."),
        "rescore": ("table", "Add metrics that were missing when runs ended, from their saved renders."),
        "audit": ("table", "Find errors in tables of results."),
        "verify": ("datasets", "Check a package, its archives and their scenes."),
    },
}
COMMANDS = {name: about for commands in SECTIONS.values() for name, about in commands.items()}
_LITTLE = "too little memory; close other programs, raise ulimit -v, or use fewer or smaller photos"
_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class _LazyGroup(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        module = importlib.import_module(f"ambiguous_wild.cli.{COMMANDS[name][0]}")
        # A module with several commands has a function NAME_command for each.
        return getattr(module, f"{name.replace('-', '_')}_command", None) or module.command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        end = args.index("--") if "--" in args else len(args)
        for_all = [word for word in args[:end] if word in ("--quiet", "-q", "--verbose", "-v")]
        return super().parse_args(ctx, [*for_all, *(w for w in args[:end] if w not in for_all), *args[end:]])

    def resolve_command(self, ctx: click.Context, args: list[str]):
        if args[:1] == ["help"]:  # as in git
            if not args[1:]:
                click.echo(ctx.get_help())
                ctx.exit()
            args = [*args[1:], "--help"]
        if args and args[0] not in COMMANDS:
            raise unknown("command", args[0], COMMANDS, "'aw --help' lists them")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for heading, commands in SECTIONS.items():
            with formatter.section(heading):
                formatter.write_dl([(name, text) for name, (_, text) in commands.items()])


@click.command(
    cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}
)
@click.version_option(__version__, prog_name="aw")
@click.option("--quiet", "-q", is_flag=True, help="Print results and errors only.")
@click.option("--verbose", "-v", is_flag=True, help="Also print what a run does, as in its log.txt.")
@click.pass_context
def cli(ctx: click.Context, quiet: bool, verbose: bool) -> None:
    """Distractor-free 3D Gaussian Splatting where the distractor looks like the scene.

    \b
    aw try photos/ -o out               all of this in one go
    aw masks photos/ -o masks           masks of the distractors, for other tools too
    aw simulate courtyard -o raw        a simulated capture; or use your own photos
    aw build-scene raw -o scene         check, COLMAP, downsample, split
    aw bench --method 3dgs,refinesplat --scene scene -o runs
    aw table runs                       compare the methods

    --quiet and --verbose may also stand behind a command.
    """
    if quiet and verbose:
        raise AwError("--quiet and --verbose exclude each other")
    if quiet:  # errors are printed when the command has ended
        ctx.with_resource(contextlib.redirect_stderr(io.StringIO()))
    if verbose:
        ctx.with_resource(logged_to(_printed()))


def _printed() -> logging.Handler:
    """Return a handler that prints records above a progress bar."""
    from ambiguous_wild.cli.run_progress import VERBOSE

    handler = logging.Handler()
    handler.set_name(VERBOSE)

    def emit(record: logging.LogRecord) -> None:
        say(f"  {record.getMessage()}")

    handler.emit = emit  # type: ignore[method-assign]
    return handler


def main() -> None:
    """Run the command line: one red line and exit code 2 for errors that the user can fix."""
    # Python sets a closed standard output (`>&-`) to None.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115 - until the process ends
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):  # Windows writes to files in code pages that lack some signs
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")
    try:
        _check_threads()
        with warnings.catch_warnings():
            warnings.showwarning = _one_line_each()
            cli.main(standalone_mode=False)
    except AwError as error:
        _fail(str(error))
    except click.exceptions.NoArgsIsHelpError as error:  # `aw` and `aw study` alone ask for help
        click.echo(error.format_message())
    except click.ClickException as error:
        _fail(_click_message(error))
    except (click.Abort, KeyboardInterrupt) as interrupt:
        # click wraps the exception that says what was kept.
        text = str(interrupt.__cause__ or interrupt) or "interrupted; run the same command again to continue"
        say(text, fg="yellow")
        sys.exit(130)
    except BrokenPipeError:
        # The reader closed our output (`aw table | head`); this is not an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        # Disk full, no permission, a file in place of a folder: the user can fix these.
        if error.errno == errno.ENOMEM:
            _fail(f"{error.filename or 'memory'}: {_LITTLE}")
        _fail(disk_line(error, "change its permissions" * isinstance(error, PermissionError)))
    except (MemoryError, ImportError) as error:
        if isinstance(error, ImportError) and not re.search("allocate memory|failed to map", str(error)):
            raise
        _fail(_LITTLE)
    except RuntimeError as error:
        if "start new thread" in str(error):
            _fail(_LITTLE)
        if "Symlink loop" in str(error):  # of Path.resolve in Python below 3.13
            _fail(f"{error}: a link that leads to itself; give another path")
        raise


def _one_line_each() -> Callable[..., None]:
    """Return a function that prints a warning as one line, once, without its place in the code."""
    printed: set[str] = set()

    def show(message: Warning | str, *_: object) -> None:
        line = "warning: " + " ".join(str(message).split())
        if line not in printed:
            say(line)
        printed.add(line)

    return show


def _check_threads() -> None:
    """Raise AwError if a variable that sets the libraries' threads is no number from 1 on."""
    for name in _THREADS:
        words = os.environ.get(name, "").strip()
        if words and not re.fullmatch(r"[0 ]*[1-9]\d{0,5}( *, *\d{1,6})*", words):
            raise AwError(f"{name} is {words!r}: set it to a number of threads from 1 on, or unset it")


def _click_message(error: click.ClickException) -> str:
    message = error.format_message()
    for name, words in {
        "integer range": "whole number",
        "integer": "whole number",
        "float range": "number",
    }.items():
        message = message.replace(f"is not a valid {name}.", f"is not a {words}.")
    if isinstance(error, click.UsageError) and error.ctx is not None:
        stray = re.fullmatch(r"Got unexpected extra arguments? \((.*)\)", message)
        flags = {flag for param in error.ctx.command.params for flag in param.opts}
        first = stray[1].split()[0] if stray else ""
        comma = next((a for a, b in pairwise(sys.argv) if a.endswith(",") and b == first), "")
        if stray and comma:
            message += f": write {comma}{stray[1].replace(' ', '')} without a space"
        elif stray and {"--method", "--scene"} <= flags:
            folder = Path(stray[1]).is_dir() or "/" in stray[1]
            message += f": did you mean {'--scene' if folder else '--method'} {stray[1]}?"
        message += f" (see '{error.ctx.command_path} --help')"
    return message


def _fail(message: str) -> None:
    # names may hold control characters, those of files need not be UTF-8
    say("error: " + " ".join(message.split()), fg="red")
    sys.exit(AwError.exit_code)


if __name__ == "__main__":
    main()
