"""Rehearse a kit as on a machine without a network; the kit is the one that `gpu.sh --pack DIR` made.

    python benchmarks/gpu_rehearse.py DIR/kit --python VENV/bin/python [--kill TEXT ...] [-o LOG]

The kit is copied to an empty folder, and `python -I run.py --rehearse` runs there without network, with an
empty environment and home, and with this checkout hidden. At the first line that has the first TEXT the
process and its children get SIGKILL, and the same command runs again; then the next TEXT. The log has the
lines that say what was run, without times. Linux, with unprivileged user namespaces.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KEPT = re.compile(r"^(call |stage |unpacked |error|usage|\w+: \d+ s$)| needs | failed|finished before|rror: ")
HIDE = 'for f in {folders}; do mount -t tmpfs none "$f"; done; cd "$HOME"; exec "$@"'


def shortened(line: str, place: Path) -> str | None:
    """The line as the log has it, or None: without times and without the folder."""
    line = line.rstrip().replace(str(place), ".")
    return re.sub(r": \d+ s$", ": done", line) if KEPT.search(line) else None


def run(words: list[str], place: Path, hidden: list[Path], kill: str | None) -> tuple[int, bool, list[str]]:
    """One run; returns its exit code, whether it was killed, and the lines of the log."""
    folders = " ".join(f"'{folder}'" for folder in hidden)
    inside = ["unshare", "-rnm", "sh", "-c", HIDE.format(folders=folders), "sh", *words]
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(place / "home")}
    lines = [f"$ {' '.join(words).replace(str(place), '.')}"]
    with subprocess.Popen(
        inside,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            short = shortened(line, place)
            if short is not None:
                lines.append(short)
            if kill is not None and kill in line:
                os.killpg(process.pid, signal.SIGKILL)
                lines.append(f"kill -9 after {kill!r}")
                return -9, True, lines
    return process.returncode, False, lines


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("kit", type=Path)
    p.add_argument("--python", required=True, help="an interpreter with torch and numpy")
    p.add_argument("--kill", nargs="*", default=[], metavar="TEXT")
    p.add_argument("--hide", type=Path, nargs="*", default=[ROOT])
    p.add_argument("-o", "--output", type=Path, metavar="LOG", help="lines are added")
    a, more = p.parse_known_args()
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        (place / "home").mkdir()
        shutil.copytree(a.kit, place / "kit")
        words = [str(Path(a.python).absolute()), "-I", str(place / "kit" / "run.py"), "--rehearse", *more]
        words += ["--results", str(place / "results")]
        lines: list[str] = []
        for kill in [*a.kill, None]:
            code, killed, said = run(words, place, a.hide, kill)
            lines += said
            if not killed:
                break
        made = sorted(path.name for path in (place / "results").glob("gpu*"))
        lines += [f"exit code {code}; results: {', '.join(made)}", ""]
    text = "\n".join(lines).replace(words[0], "python") + "\n"
    print(text)
    if a.output is not None:
        with a.output.open("a", encoding="utf-8") as log:
            log.write(text)
    return code


if __name__ == "__main__":
    sys.exit(main())
