"""Remove the safeguards one at a time and list the stress tests that fail.

    python benchmarks/mutations.py [--kernels] [--only NAME] [--json PATH]

Each mutation replaces one piece of source in memory, in its own child process; no file is changed. Mutations
of compiled kernels are compiled again, a minute each, and run only with --kernels. Prints each safeguard and
the cases that fail without it; writes benchmarks/results/mutations.json. Exits with 1 if no case fails for a
mutation, or if a case fails on the unchanged source.
"""

from __future__ import annotations

import argparse
import importlib.machinery
import importlib.util
import json
import os
import sys
import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Heavy packages once, before the children are forked; nothing of ours, which each child reads for itself.
import cv2  # noqa: F401
import numba  # noqa: F401
import numpy as np  # noqa: F401
import scipy.sparse.csgraph  # noqa: F401
import torch

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "mutations.json"


@dataclass(frozen=True)
class Mutation:
    """A safeguard and the source without it."""

    name: str
    module: str  # below ambiguous_wild
    old: str  # occurs in the source exactly once
    new: str
    rows: tuple[int, ...]  # of the cases that are run
    kernel: bool = False


_M = "methods.refinesplat"
MUTATIONS = (
    Mutation(
        "entropy through log-sigmoid", f"{_M}.entropy",
        'if variant == "sigmoid":\n        log_p = F.logsigmoid(logits)',
        'if variant == "sigmoid":\n        log_p = torch.log(torch.sigmoid(logits))', (11,),
    ),
    Mutation(
        "consistency through log-sigmoid", f"{_M}.losses",
        "(torch.sigmoid(logits), F.logsigmoid(logits))",
        "(torch.sigmoid(logits), torch.log(torch.sigmoid(logits)))", (17,),
    ),
    Mutation(
        "sign of the merged covariance", f"{_M}.merging",
        "away[:, :, None] * away[:, None, :]", "away[:, :, None] * -away[:, None, :]", (20,),
    ),
    Mutation(
        "overlap without a unit", f"{_M}.merging",
        "-0.5 * squared + log_parts - 0.5 * log_total", "-0.5 * squared - 0.5 * log_total", (19, 21),
    ),
    Mutation(
        "right-handed eigenvectors", f"{_M}.merging",
        "vectors[left, :, 0] *= -1.0", "vectors[left, :, 0] *= 1.0", (19, 20),
    ),
    Mutation("w2 kept inside (0, 1)", f"{_M}.threshold", "_THETA_LIMIT = 8.0", "_THETA_LIMIT = 800.0", (18,)),
    Mutation("cosine kept above -1", f"{_M}.masking", "-1.0 + 1e-3", "-1.0", (15,)),
    Mutation(
        "eps of U / H from H's own scale", f"{_M}.masking",
        "max(eps_share * float(h.mean()), 1e-6)", "1e-6", (15,),
    ),
    Mutation(
        "a cosine that is none counts as 1", f"{_M}.masking",
        "np.nan_to_num(np.asarray(cosine, dtype=np.float64), nan=1.0, posinf=1.0, neginf=1.0)",
        "np.asarray(cosine, dtype=np.float64)", (15,),
    ),
    Mutation(
        "values of one group are not cut", f"{_M}.threshold",
        "floor = max(robust_floor(values, gate) if gate > 0 else -math.inf,", "floor = max(-math.inf,",
        (13, 14),
    ),
    Mutation(
        "rows of NaN are pruned", "splat.density",
        "drop |= ~torch.isfinite(gaussians.means).all(dim=1)", "pass", (9,),
    ),
    Mutation(
        "a round never removes all", "splat.density",
        "if not bool(drop.any()) or bool(drop.all()):", "if not bool(drop.any()):", (9,),
    ),
    Mutation(
        "growth stops at the cap", "splat.density",
        "if int(chosen.sum()) > room:", "if False:", (9,),
    ),
    Mutation(
        "the judge stops at exactly 1e-4", "splat.reference", "1e-4 * (1 + 1e-12)", "1e-4", (7,)
    ),
    Mutation(
        "identical pictures stay infinite", "metrics.image",
        "return math.inf if mse == 0.0", "return 100.0 if mse == 0.0", (22,),
    ),
    Mutation(
        "SSIM refuses what is below its window", "metrics.image",
        "if min(height, width) < WINDOW:", "if min(height, width) < 1:", (22,),
    ),
    Mutation(
        "missing stays missing in intervals", "metrics.stats",
        "    if np.isnan(array).any():\n        return Interval(math.nan, math.nan, math.nan, len(array))",
        "    array = array[~np.isnan(array)]", (24,),
    ),
    Mutation(
        "no share of nothing", "metrics.ambiguity",
        "self.close / self.known if self.known else math.nan",
        "self.close / self.known if self.known else 0.0", (23,),
    ),
    Mutation("near-plane cull", "splat.cpu.project", "(z >= NEAR) & (z < _HUGE)", "z < _HUGE", (1,), True),
    Mutation("quaternions are normalised", "splat.cpu.project", "inv = 1.0 / norm", "inv = 1.0", (3,), True),
    Mutation(
        "alpha kept at 0.99", "splat.cpu.blend",
        "MAX_ALPHA = np.float32(0.99)", "MAX_ALPHA = np.float32(1.0)", (3, 4), True,
    ),
    Mutation(
        "alpha below 1/255 is cut", "splat.cpu.blend",
        "LOG2_MIN_ALPHA = np.float32(-math.log2(255.0))", "LOG2_MIN_ALPHA = np.float32(-7.0)", (2,), True,
    ),
)  # fmt: skip


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads one module with a piece of its source replaced."""

    mutation: Mutation

    def get_code(self, fullname: str) -> Any:
        source = Path(self.path).read_text(encoding="utf-8")
        if source.count(self.mutation.old) != 1:
            raise LookupError(
                f"{self.mutation.name}: found {source.count(self.mutation.old)} times in {self.path}"
            )
        return compile(source.replace(self.mutation.old, self.mutation.new), self.path, "exec")


class _Finder:
    def __init__(self, mutation: Mutation) -> None:
        self.mutation, self.name = mutation, f"ambiguous_wild.{mutation.module}"

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        if name != self.name:
            return None
        file = ROOT.joinpath(*name.split(".")).with_suffix(".py")
        loader = _Loader(name, str(file))
        loader.mutation = self.mutation
        return importlib.util.spec_from_file_location(name, file, loader=loader)


def failures(rows: tuple[int, ...], mutation: Mutation | None) -> list[str]:
    """Keys of the cases of these rows that fail, in a child process; "crashed: ..." where it died."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        try:
            found = _in_child(rows, mutation)
        except BaseException as error:  # a mutation may break the import itself
            traceback.print_exc()
            found = (
                [f"crashed: {type(error).__name__}"] if not isinstance(error, LookupError) else ["not found"]
            )
        with os.fdopen(writer, "w") as pipe:
            json.dump(found, pipe)
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    return json.loads(text) if text else ["crashed"]


def _in_child(rows: tuple[int, ...], mutation: Mutation | None) -> list[str]:
    with tempfile.TemporaryDirectory(prefix="aw-mutation-") as cache:
        if mutation is not None:
            sys.meta_path.insert(0, _Finder(mutation))
            if mutation.kernel:  # the compiled original must not be found
                os.environ["NUMBA_CACHE_DIR"] = cache
        from ambiguous_wild.stress.case import run
        from ambiguous_wild.stress.table import CASES

        outcomes = [run(case, "cpu") for case in CASES if case.row in rows]
    return [o.key for o in outcomes if not o.passed]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kernels", action="store_true", help="the compiled ones too")
    parser.add_argument("--only", action="append", help="part of a name; repeatable")
    parser.add_argument("--json", type=Path, default=RESULTS, help="where the table goes")
    args = parser.parse_args()
    torch.set_num_threads(1)
    sys.path.insert(0, str(ROOT))
    chosen = [
        m
        for m in MUTATIONS
        if (any(part in m.name for part in args.only) if args.only else args.kernels or not m.kernel)
    ]
    # a case that fails anyway shows nothing
    sound = failures(tuple({row for m in chosen for row in m.rows}), None)
    print(f"as it is: {', '.join(sound) or 'no case fails'}", flush=True)
    rows = []
    for m in chosen:
        caught = [key for key in failures(m.rows, m) if key not in sound]
        killed = bool(caught) and "not found" not in caught
        rows.append(
            {"safeguard": m.name, "module": m.module, "instead": m.new, "caught_by": caught, "killed": killed}
        )
        print(f"{'caught  ' if killed else 'SURVIVED'}  {m.name}: {', '.join(caught) or '-'}", flush=True)
    done = sum(row["killed"] for row in rows)
    print(f"{done} of {len(rows)} caught")
    if not args.only:
        args.json.write_text(json.dumps({"mutations": rows}, indent=1) + "\n", encoding="utf-8")
    return 0 if done == len(rows) and not sound else 1


if __name__ == "__main__":
    sys.exit(main())
