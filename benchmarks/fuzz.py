"""Give every reader damaged files; anything but a result or an AwError is a crash.

    python benchmarks/fuzz.py [--inputs 10000] [--only NAME ...] [--json PATH] [--keep FOLDER]

Each reader (see `fuzz_readers`) gets valid files with seeded damage (see `fuzz_mutate`); the number of an
input reproduces it. Readers run in a forked child with limits on memory (1 GB above the imports) and
processor time (60 s per input), so that native crashes end only the child. A crash is any exception but
AwError, a signal, or an exceeded limit. --keep writes the inputs that crash.

The count is a total: the script resumes from the results file. Inputs that crashed before are tested first;
those that no longer crash count as fixed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from fuzz_readers import READERS, Reader  # noqa: E402

from ambiguous_wild.core.errors import AwError  # noqa: E402

RESULTS = Path(__file__).parent / "results" / "fuzz.json"
MEMORY = 1 << 30  # bytes above what is there before
CPU_S = 60.0  # a slow machine zeroes a large picture in seconds; a loop without end takes more
HUNG_S = 600
_RECORD = 8  # bytes of an input's number


@dataclass
class Tally:
    """Results of one reader."""

    inputs: int = 0
    refused: int = 0
    crashes: dict[str, list[int]] = field(default_factory=dict)  # what happens -> input numbers
    fixed: dict[str, list[int]] = field(default_factory=dict)  # what happened once, and no longer does

    def crash(self, what: str, number: int) -> None:
        self.crashes.setdefault(what, []).append(number)


def make_input(reader: Reader, number: int) -> bytes:
    """Input `number` of a reader."""
    dice = random.Random(f"{reader.name} {number}")
    samples = reader.samples()
    return reader.mutate(dice.choice(samples), dice, dice.choice(samples))


def run(reader: Reader, wanted: int, tally: Tally, keep: Path | None = None) -> None:
    """Test earlier crashes again, then inputs up to `wanted`; crashes do not stop it."""
    known, tally.crashes = tally.crashes, {}
    for what, numbers in known.items():
        for number in numbers:
            again = Tally()
            _child(reader, range(number, number + 1), again)
            if again.crashes:
                tally.crash(next(iter(again.crashes)), number)
            else:
                tally.fixed.setdefault(what, []).append(number)
    at = tally.inputs
    while at < wanted:
        at = _child(reader, range(at, wanted), tally)
    if keep is not None:
        for what, found in tally.crashes.items():
            folder = keep / reader.name
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{found[0]}{reader.suffix}").write_bytes(make_input(reader, found[0]))
            (folder / f"{found[0]}.txt").write_text(what + "\n")


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


def table(results: dict[str, Any]) -> str:
    """The Markdown table of docs/robustness.md."""
    lines = [
        "| reader | inputs | refused | crashes found | places | fixed | remaining |",
        "|---|" + "---|" * 6,
    ]
    total = [0] * 6
    for name, row in results.items():
        fixed, left = (sum(map(len, row[key].values())) for key in ("fixed", "crashes"))
        cells = [row["inputs"], row["refused"], fixed + left, _places(row), fixed, left]
        total = [a + b for a, b in zip(total, cells)]
        lines.append(f"| {name} | " + " | ".join(map(str, cells)) + " |")
    return "\n".join([*lines, "| all | " + " | ".join(map(str, total)) + " |"])


def _places(row: dict[str, Any]) -> int:
    """Different types of crash, ignoring messages."""
    return len({":".join(what.split(":")[:2]) for key in ("fixed", "crashes") for what in row[key]})


def main() -> int:
    """Fuzz, print and write the results; exit code 1 if anything crashed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--only", nargs="+", choices=list(READERS), default=list(READERS), metavar="NAME")
    parser.add_argument("--json", type=Path, default=RESULTS)
    parser.add_argument("--keep", type=Path, help="folder for inputs that crash")
    args = parser.parse_args()
    from ambiguous_wild.io.atomic import write_json

    results = json.loads(args.json.read_text()) if args.json.is_file() else {}
    bad = 0
    for name in args.only:
        tally = Tally(**results.get(name, {}))
        run(READERS[name], args.inputs, tally, args.keep)
        results[name] = asdict(tally)
        bad += len(tally.crashes)
        write_json(args.json, results)
        crashed = sum(len(v) for v in tally.crashes.values())
        print(f"{name}: {tally.inputs} inputs, {tally.refused} refused, {crashed} crashes", flush=True)
        for what, numbers in tally.crashes.items():
            print(f"    {len(numbers)} x {what} (input {numbers[0]})", flush=True)
    print(table(results))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
