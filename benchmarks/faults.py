"""Kill commands at random times, run them again and compare with uninterrupted runs.

    python benchmarks/faults.py [--kills bench=60 build-scene=30 simulate=10 add=10 publish=20] [--seed 0]
        [--json PATH]

In each round a command starts in an empty folder and is killed (SIGKILL, the whole process group) at a random
time within its normal duration, KILLS_A_ROUND times; then it runs to its end. After every kill all files with
final names must be complete. After the last run the folder must equal that of an uninterrupted run byte by
byte, except for times (see `fault_compare`), with no extra files.

The counts are totals: kills in the results file are not repeated, so the script can be stopped and resumed.
Processes are forked after the heavy imports, so that kills hit the work and not the imports. Linux and macOS.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from fault_compare import half_written, state  # noqa: E402

RESULTS = Path(__file__).parent / "results" / "faults.json"
KILLS_A_ROUND = 4
COMMANDS = {"add": "aw leaderboard add", "publish": "aw leaderboard publish"}  # where it is not aw NAME
DEFAULT = {"bench": 60, "build-scene": 30, "simulate": 10, "add": 10, "publish": 20}


@dataclass(frozen=True)
class Victim:
    """A command to kill.

    prepare: makes the inputs in a folder, once.
    argv: the command's words from the folder of the inputs and the folder to write into.
    """

    prepare: Callable[[Path], None]
    argv: Callable[[Path, Path], list[str]]


@dataclass
class Tally:
    """Results of the kills of one command."""

    kills: int = 0
    rounds: int = 0
    half_written: int = 0
    lost_or_different: int = 0
    left_behind: int = 0
    failed_reruns: int = 0
    moments: list[float] = field(default_factory=list)  # share of the undisturbed duration
    details: list[str] = field(default_factory=list)

    @property
    def bad(self) -> int:
        return self.half_written + self.lost_or_different + self.left_behind + self.failed_reruns


def _tiny_scene(inputs: Path) -> None:
    from tests.tiny_scene import write_tiny_scene

    write_tiny_scene(inputs / "scene")


def _tiny_capture(inputs: Path) -> None:
    from tests.builder.capture_maker import write_capture

    write_capture(inputs / "raw", 4)


def _bench(inputs: Path, out: Path) -> list[str]:
    words = ["bench", "--method", "3dgs", "--scene", str(inputs / "scene"), "--iterations", "150"]
    words += ["--threads", "1", "--checkpoint-every", "0.1", "--cache", str(inputs / "cache")]
    return [*words, "-o", str(out / "runs")]


def _build(inputs: Path, out: Path) -> list[str]:
    words = ["build-scene", str(inputs / "raw"), "-o", str(out / "scene"), "--factor", "2"]
    return [*words, "--max-features", "500", "--jobs", "1", "--name", "walls"]


def _simulate(inputs: Path, out: Path) -> list[str]:
    return ["simulate", "tiny", "-o", str(out / "raw"), "--views", "6", "--width", "96"]


def _runs(inputs: Path) -> None:
    """Two finished runs."""
    _tiny_scene(inputs)
    for seed in ("0", "1"):
        words = ["bench", "--method", "3dgs", "--scene", str(inputs / "scene"), "--iterations", "20"]
        words += ["--threads", "1", "--seed", seed, "--cache", str(inputs / "cache")]
        finish([*words, "-o", str(inputs / "runs")], inputs / "runs.log")


def _board(inputs: Path) -> None:
    _runs(inputs)
    finish(_add(inputs, inputs), inputs / "add.log")


def _add(inputs: Path, out: Path) -> list[str]:
    return ["leaderboard", "add", str(inputs / "runs"), "--board", str(out / "board"), "--dataset", "tiny"]


def _publish(inputs: Path, out: Path) -> list[str]:
    return ["leaderboard", "publish", "--board", str(inputs / "board"), "-o", str(out / "site")]


# To add a command, add a line here.
VICTIMS = {
    "bench": Victim(_tiny_scene, _bench),
    "build-scene": Victim(_tiny_capture, _build),
    "simulate": Victim(lambda inputs: None, _simulate),
    "add": Victim(_runs, _add),
    "publish": Victim(_board, _publish),
}


def preload() -> None:
    """Import what the commands need before forking."""
    import ambiguous_wild.builder.pipeline
    import ambiguous_wild.builder.undistort
    import ambiguous_wild.harness.leaderboard.add
    import ambiguous_wild.harness.leaderboard.publish
    import ambiguous_wild.harness.running.grid
    import ambiguous_wild.simulate.capture
    import ambiguous_wild.splat.trainer  # noqa: F401


def start(argv: Sequence[str], log: Path) -> int:
    """Fork a process with its own process group that runs `aw ARGV`; returns its id."""
    child = os.fork()
    if child:
        return child
    os.setsid()
    with open(log, "ab") as sink:
        os.dup2(sink.fileno(), 1)
        os.dup2(sink.fileno(), 2)
    code = 1
    try:
        from ambiguous_wild.cli import main

        sys.argv = ["aw", *argv]
        main.main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def finish(argv: Sequence[str], log: Path) -> float:
    """Run to the end; returns seconds.

    Raises:
        RuntimeError: it ended with an error.
    """
    begun = time.monotonic()
    _, status = os.waitpid(start(argv, log), 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise RuntimeError(log.read_text(errors="replace")[-400:])
    return time.monotonic() - begun


def kill_after(argv: Sequence[str], log: Path, seconds: float) -> bool:
    """Kill the process and its group after `seconds`; False if it had already ended."""
    process = start(argv, log)
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        done, _ = os.waitpid(process, os.WNOHANG)
        if done:
            return False
        time.sleep(0.005)
    os.killpg(process, signal.SIGKILL)
    _, status = os.waitpid(process, 0)
    return os.waitstatus_to_exitcode(status) == -signal.SIGKILL


def kill_round(
    victim: Victim, inputs: Path, out: Path, expected: dict[str, str], kills: int, usual_s: float, dice: Any
) -> Tally:
    """Kill `kills` times in one folder, run to the end, compare."""
    tally, log = Tally(rounds=1), out.with_suffix(".log")
    out.mkdir()
    argv = victim.argv(inputs, out)
    while tally.kills < kills:
        share = dice.random()
        if not kill_after(argv, log, share * usual_s):
            break  # it came to its end before: nothing was killed, and nothing is left to kill
        tally.kills += 1
        tally.moments.append(round(share, 3))
        wrong = half_written(out)
        tally.half_written += len(wrong)
        tally.details += [f"after kill {tally.kills}: {w}" for w in wrong]
    try:
        finish(argv, log)
    except RuntimeError as error:
        tally.failed_reruns += 1
        tally.details.append(f"run again: {error}")
        return tally
    found = state(out)
    differ = [n for n in expected if found.get(n) != expected[n]]
    left = [n for n in found if n not in expected]
    tally.lost_or_different += len(differ)
    tally.left_behind += len(left)
    tally.details += [f"differs: {n}" for n in differ] + [f"left behind: {n}" for n in left]
    return tally


def measure(name: str, wanted: int, tally: Tally, seed: int, save: Callable[[Tally], None]) -> None:
    """Run rounds until the tally has `wanted` kills; calls `save` after each."""
    victim = VICTIMS[name]
    with tempfile.TemporaryDirectory(prefix="aw-faults-") as folder:
        inputs = Path(folder) / "inputs"
        inputs.mkdir()
        victim.prepare(inputs)
        undisturbed = Path(folder) / "undisturbed"
        undisturbed.mkdir()
        argv = victim.argv(inputs, undisturbed)
        finish(argv, undisturbed.with_suffix(".log"))  # fills caches, so that the second says how long
        expected = state(undisturbed)
        twin = Path(folder) / "twin"
        twin.mkdir()
        usual_s = finish(victim.argv(inputs, twin), twin.with_suffix(".log"))
        if state(twin) != expected:
            raise RuntimeError(f"{name}: two undisturbed runs differ: {_differing(expected, state(twin))}")
        while tally.kills < wanted:
            dice = random.Random(f"{seed} {name} {tally.rounds}")
            out = Path(folder) / f"round{tally.rounds}"
            kills = min(KILLS_A_ROUND, wanted - tally.kills)
            done = kill_round(victim, inputs, out, expected, kills, usual_s, dice)
            for key, value in asdict(done).items():
                setattr(tally, key, getattr(tally, key) + value)
            save(tally)
            print(
                f"{name}: {tally.kills} of {wanted} kills, {tally.bad} bad; {usual_s:.1f} s a run", flush=True
            )


def _differing(a: dict[str, str], b: dict[str, str]) -> list[str]:
    return sorted(n for n in a.keys() | b.keys() if a.get(n) != b.get(n))


def table(results: dict[str, Any]) -> str:
    """The Markdown table of docs/robustness.md."""
    lines = [
        "| command | kills | runs to the end | half-written | lost or different | left behind | failed |"
    ]
    lines += ["|---|---|---|---|---|---|---|"]
    keys = ("kills", "rounds", "half_written", "lost_or_different", "left_behind", "failed_reruns")
    for name, row in results.items():
        lines.append(
            f"| `{COMMANDS.get(name, f'aw {name}')}` | " + " | ".join(str(row[k]) for k in keys) + " |"
        )
    total = [sum(row[k] for row in results.values()) for k in keys]
    return "\n".join([*lines, "| all | " + " | ".join(map(str, total)) + " |"])


def parse_kills(words: Sequence[str]) -> dict[str, int]:
    """ "bench=60" as {"bench": 60}."""
    wanted = {}
    for word in words:
        name, _, count = word.partition("=")
        if name not in VICTIMS or not count.isdecimal():
            sys.exit(f"--kills {word}: write COMMAND=NUMBER, COMMAND one of {', '.join(VICTIMS)}")
        wanted[name] = int(count)
    return wanted


def main() -> int:
    """Kill, compare, write the results; exit code 1 if anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", nargs="+", default=[f"{k}={v}" for k, v in DEFAULT.items()])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=RESULTS)
    args = parser.parse_args()
    from ambiguous_wild.io.atomic import write_json

    wanted = parse_kills(args.kills)
    results = json.loads(args.json.read_text()) if args.json.is_file() else {}
    preload()

    def save(name: str, tally: Tally) -> None:
        results[name] = asdict(tally)
        write_json(args.json, results)

    for name, count in wanted.items():
        tally = Tally(**results.get(name, {}))
        if tally.kills < count:
            measure(name, count, tally, args.seed, lambda t, name=name: save(name, t))  # type: ignore[misc]
    print(table(results))
    return 1 if any(Tally(**row).bad for row in results.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
