"""Every module can be imported where a system has neither `fcntl` nor `resource`, as Windows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
# gsplat, Ray, viser and transformers are extras; a module of ours that needs one imports it late.
CODE = """
import importlib, json, os, pkgutil, sys
absent = json.loads(sys.argv[1])
for name in absent:
    sys.modules[name] = None  # `import` of it raises ImportError
import filelock  # asks for fcntl itself, and works without
import ambiguous_wild
names, failed = [], {}
for module in pkgutil.walk_packages(ambiguous_wild.__path__, "ambiguous_wild."):
    names.append(module.name)
    if module.name.endswith("__main__"):
        continue
    try:
        importlib.import_module(module.name)
    except Exception as error:
        failed[module.name] = repr(error)
print(json.dumps({"count": len(names), "failed": failed}), flush=True)
os._exit(0)  # some C++ libraries crash when Python takes them down without what was absent
"""


def imported(*absent: str) -> dict[str, object]:
    import json

    done = subprocess.run(
        [sys.executable, "-c", CODE, json.dumps(absent)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_every_module_is_imported_without_posix_modules() -> None:
    found = imported("fcntl", "resource", "termios", "pwd", "grp")
    assert found["failed"] == {}
    assert found["count"] == sum(
        p.name != "__init__.py" for p in (ROOT / "ambiguous_wild").rglob("*.py")
    ) + sum(1 for p in (ROOT / "ambiguous_wild").rglob("__init__.py") if p.parent != ROOT / "ambiguous_wild")


def test_the_check_sees_a_module_that_needs_what_is_absent() -> None:
    failed = imported("csv")["failed"]
    assert isinstance(failed, dict) and "ambiguous_wild.report.audit_numbers" in failed


def test_locks_and_peak_memory_work_without_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ambiguous_wild.harness import run_cost as memory

    monkeypatch.setitem(sys.modules, "resource", None)
    monkeypatch.setattr(memory, "_PROC", tmp_path / "absent")
    assert memory.peak_memory() == {}
