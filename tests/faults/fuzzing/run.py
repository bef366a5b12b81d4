"""Give every reader damaged files; anything but a result or an AwError is a crash.

    python -m tests.faults.fuzzing.run [--inputs 10000] [--only NAME ...]

Each reader (see `readers`) gets valid files with seeded damage (see `mutate`); the number of an input
reproduces it (`make_input`). Readers run in a forked child with limits on memory (1 GB above the imports) and
processor time (60 s per input), so that native crashes end only the child. A crash is any exception but
AwError, a message that cannot be read, a signal, or an exceeded limit. Exits with 1 if there was one.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError
from tests.faults.fuzzing.readers import READERS, Reader

MEMORY = 1 << 30  # bytes above what is there before
CPU_S = 60.0  # a slow machine zeroes a large picture in seconds; a loop without end takes more
HUNG_S = 600


def make_input(reader: Reader, number: int) -> bytes:
    """Input `number` of a reader."""
    dice = random.Random(f"{reader.name} {number}")
    samples = reader.samples()
    return reader.mutate(dice.choice(samples), dice, dice.choice(samples))


def run(reader: Reader, wanted: int) -> tuple[int, list[str]]:
    """Feed the first `wanted` inputs; returns how many were refused, and a line for each crash."""
    verdicts: list[str] = []
    while len(verdicts) < wanted:  # a child ends at a native crash, and the next one goes on
        verdicts += _child(reader, range(len(verdicts), wanted))
    crashes = [f"input {k}: {v}" for k, v in enumerate(verdicts) if v not in ("read", "refused")]
    return verdicts.count("refused"), crashes


def _child(reader: Reader, numbers: range) -> list[str]:
    """The verdicts on inputs, in order, up to the first that ends the child."""
    reader.samples()  # made once, here, for every child
    back, front = os.pipe()
    scratch = Path(tempfile.mkdtemp(prefix="aw-fuzz-"))
    process = os.fork()
    if not process:
        os.close(back)
        _feed(reader, numbers, scratch, os.fdopen(front, "w", buffering=1))
    os.close(front)
    with os.fdopen(back) as lines:
        verdicts = [line.rstrip("\n") for line in lines]
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    shutil.rmtree(scratch, ignore_errors=True)
    if code < 0:
        name = signal.Signals(-code).name
        late = {"SIGPROF": f"more than {CPU_S:g} s of processor time", "SIGALRM": f"more than {HUNG_S} s"}
        verdicts.append(late.get(name, name))
    elif code:
        verdicts.append(f"the process ended with code {code}")
    return verdicts


def _feed(reader: Reader, numbers: range, scratch: Path, report: Any) -> None:
    """In the child: a line for each input, then the end of the process."""
    code = 1
    try:
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        if os.path.exists("/proc/self/statm"):
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            limit = pages * resource.getpagesize() + MEMORY
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for name in ("SIGPROF", "SIGALRM"):
            signal.signal(getattr(signal, name), signal.SIG_DFL)
        path = scratch / f"input{reader.suffix}"
        for number in numbers:
            path.write_bytes(make_input(reader, number))
            signal.setitimer(signal.ITIMER_PROF, CPU_S)
            signal.alarm(HUNG_S)
            report.write(_verdict(reader, path) + "\n")
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
        code = 0
    finally:
        os._exit(code)


def _verdict(reader: Reader, path: Path) -> str:
    """ "read", "refused", or what is wrong: with the reader, or with its message."""
    try:
        reader.read(path)
    except AwError as error:
        text = str(error)
        try:
            text.encode("utf-8", errors="surrogateescape")
        except UnicodeEncodeError:
            return "a message that cannot be printed"
        if not text.strip():
            return "an error without a message"
        return "refused" if len(text) < 3000 else "a message of more than 3000 characters"
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        frame = [f for f in frames if "ambiguous_wild" in f.filename or f is frames[0]][-1]
        name = frame.filename.rpartition("ambiguous_wild/")[2]
        return f"{type(error).__name__} in {name}:{frame.name}: {' '.join(str(error).split())[:80]!a}"
    return "read"


def main() -> int:
    """Fuzz and print; exit code 1 if anything crashed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--only", nargs="+", choices=list(READERS), default=list(READERS), metavar="NAME")
    args = parser.parse_args()
    crashed = 0
    for name in args.only:
        refused, crashes = run(READERS[name], args.inputs)
        print(f"{name}: {args.inputs} inputs, {refused} refused, {len(crashes)} crashes", flush=True)
        for line in crashes:
            print(f"    {line}", flush=True)
        crashed += len(crashes)
    print(f"all {len(args.only)} readers: {crashed} crashes")
    return int(crashed > 0)


if __name__ == "__main__":
    sys.exit(main())
