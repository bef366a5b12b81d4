"""Give every reader damaged files; anything but a result or an AwError is a crash.

    python -m tests.faults.fuzzing.run [--inputs 10000] [--only NAME ...] [--keep FOLDER]

Each reader (see `readers`) gets valid files with seeded damage (see `mutate`); the number of an input
reproduces it. Readers run in a forked child with limits on memory (1 GB above the imports) and processor
time (60 s per input), so that native crashes end only the child. A crash is any exception but AwError, a
signal, or an exceeded limit. --keep writes the inputs that crash. Exits with 1 if any did.
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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError
from tests.faults.fuzzing.readers import READERS, Reader

MEMORY = 1 << 30  # bytes above what is there before
CPU_S = 60.0  # a slow machine zeroes a large picture in seconds; a loop without end takes more
HUNG_S = 600


@dataclass
class Tally:
    """Results of one reader."""

    inputs: int = 0
    refused: int = 0
    crashes: dict[str, list[int]] = field(default_factory=dict)  # what happens -> input numbers

    def crash(self, what: str, number: int) -> None:
        self.crashes.setdefault(what, []).append(number)


def make_input(reader: Reader, number: int) -> bytes:
    """Input `number` of a reader."""
    dice = random.Random(f"{reader.name} {number}")
    samples = reader.samples()
    return reader.mutate(dice.choice(samples), dice, dice.choice(samples))


def run(reader: Reader, wanted: int, keep: Path | None = None) -> Tally:
    """Feed the first `wanted` inputs; crashes do not stop it."""
    tally, at = Tally(), 0
    while at < wanted:
        at = _child(reader, range(at, wanted), tally)
    if keep is not None:
        for what, numbers in tally.crashes.items():
            folder = keep / reader.name
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{numbers[0]}{reader.suffix}").write_bytes(make_input(reader, numbers[0]))
            (folder / f"{numbers[0]}.txt").write_text(what + "\n")
    return tally


def _child(reader: Reader, numbers: range, tally: Tally) -> int:
    """Run inputs in a child until it crashes; returns the next number."""
    reader.samples()  # made once, here, for every child
    back, front = os.pipe()
    scratch = Path(tempfile.mkdtemp(prefix="aw-fuzz-"))
    process = os.fork()
    if not process:
        os.close(back)
        _feed(reader, numbers, scratch, os.fdopen(front, "w", buffering=1))
    os.close(front)
    last = numbers.start - 1
    with os.fdopen(back) as lines:
        for line in lines:
            verdict, number, *what = line.rstrip("\n").split("\t")
            if verdict == "start":
                last = int(number)
                tally.inputs += 1
            elif verdict == "refused":
                tally.refused += 1
            else:
                tally.crash(what[0], int(number))
    _, status = os.waitpid(process, 0)
    shutil.rmtree(scratch, ignore_errors=True)
    code = os.waitstatus_to_exitcode(status)
    if code and last < numbers.start:
        raise RuntimeError(f"input {numbers.start} of {reader.name} cannot be made")
    if code == 0:
        return numbers.stop
    if code < 0:
        name = signal.Signals(-code).name
        late = {"SIGPROF": f"more than {CPU_S:g} s of processor time", "SIGALRM": f"more than {HUNG_S} s"}
        tally.crash(late.get(name, name), last)
    else:
        tally.crash(f"the process ended with code {code}", last)
    return last + 1


def _feed(reader: Reader, numbers: range, scratch: Path, report: Any) -> None:
    code = 1
    try:
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        pages = int(Path("/proc/self/statm").read_text().split()[0]) if os.path.exists("/proc") else 0
        if pages:
            limit = pages * resource.getpagesize() + MEMORY
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for name in ("SIGPROF", "SIGALRM"):
            signal.signal(getattr(signal, name), signal.SIG_DFL)
        path = scratch / f"input{reader.suffix}"
        for number in numbers:
            data = make_input(reader, number)
            path.write_bytes(data)
            report.write(f"start\t{number}\n")
            signal.setitimer(signal.ITIMER_PROF, CPU_S)
            signal.alarm(HUNG_S)
            try:
                reader.read(path)
            except AwError as error:
                verdict = _line_of(error)
                report.write(
                    f"{verdict}\t{number}\n" if verdict == "refused" else f"crash\t{number}\t{verdict}\n"
                )
            except BaseException as error:
                report.write(f"crash\t{number}\t{_where(error)}\n")
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
        code = 0
    finally:
        os._exit(code)


def _line_of(error: AwError) -> str:
    """ "refused", or what is wrong with the message itself: it must be printable and say something."""
    text = str(error)
    try:
        " ".join(text.split()).encode("utf-8", errors="surrogateescape")
    except UnicodeEncodeError:
        return "a message that cannot be printed"
    if not text.strip():
        return "an error without a message"
    return "refused" if len(text) < 3000 else "a message of more than 3000 characters"


def _where(error: BaseException) -> str:
    """Type of the error and the innermost line of our code."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "ambiguous_wild" in f.filename]
    frame = (ours or frames)[-1]
    name = frame.filename.rpartition("ambiguous_wild/")[2]
    first = " ".join(str(error).split())[:80]
    return f"{type(error).__name__} in {name}:{frame.name}: {first}"


def main() -> int:
    """Fuzz and print; exit code 1 if anything crashed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--only", nargs="+", choices=list(READERS), default=list(READERS), metavar="NAME")
    parser.add_argument("--keep", type=Path, help="folder for inputs that crash")
    args = parser.parse_args()
    tallies = {}
    for name in args.only:
        tally = tallies[name] = run(READERS[name], args.inputs, args.keep)
        crashed = sum(map(len, tally.crashes.values()))
        print(f"{name}: {tally.inputs} inputs, {tally.refused} refused, {crashed} crashes", flush=True)
        for what, numbers in tally.crashes.items():
            print(f"    {len(numbers)} x {what} (input {numbers[0]})", flush=True)
    print(
        f"all {len(tallies)} readers: {sum(t.inputs for t in tallies.values())} inputs, "
        f"{sum(t.refused for t in tallies.values())} refused"
    )
    return int(any(tally.crashes for tally in tallies.values()))


if __name__ == "__main__":
    sys.exit(main())
