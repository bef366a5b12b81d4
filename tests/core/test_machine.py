"""Machines as people have them: containers, no home, another code page, another OpenCV."""

import itertools
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import pytest

from ambiguous_wild.core import AwError, machine
from ambiguous_wild.core.weight_files import expanded
from ambiguous_wild.io.images import ximgproc


@pytest.fixture
def cgroup(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "CGROUP", tmp_path)
    monkeypatch.setattr(machine, "allowed_cores", lambda: set(range(8)))
    (tmp_path / "own").write_text("0::/job_1/task_0\n")
    monkeypatch.setattr(machine, "OWN_GROUPS", tmp_path / "own")
    return tmp_path


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 8),
        ({"cpu.max": "max 100000"}, 8),
        ({"cpu.max": "250000 100000"}, 2),
        ({"cpu.max": "50000 100000"}, 1),
        ({"cpu/cpu.cfs_quota_us": "400000"}, 4),
        ({"cpu/cpu.cfs_quota_us": "-1"}, 8),
        ({"job_1/cpu.max": "300000 100000", "job_1/task_0/cpu.max": "max 100000"}, 3),
    ],
)
def test_cores_are_those_of_the_quota(cgroup, files, cores):
    for name, text in files.items():
        (cgroup / name).parent.mkdir(parents=True, exist_ok=True)
        (cgroup / name).write_text(text)
    assert machine.usable_cores() == cores


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_order_and_few_are_begun_before_they_are_taken(threads):
    begun, caller = [], threading.get_ident()

    def squared(k):
        begun.append(threading.get_ident() == caller)
        if k == 12:
            raise ValueError("twelve")
        time.sleep(0.002 * (k % 3))  # the third is ready before the second
        return k * k

    results = machine.in_order(squared, itertools.count(), threads)
    for k in range(8):
        assert next(results) == k * k and len(begun) <= k + 1 + threads
    assert set(begun) == {threads == 1}
    with pytest.raises(ValueError, match="twelve"):
        list(results)


def test_memory_limits_how_many_large_photos_are_read_at_once(cgroup):
    assert machine.photo_threads(12_000_000) > 1
    (cgroup / "memory.max").write_text("1000000000")
    assert machine.usable_memory() == 10**9
    assert machine.photo_threads(100_000) == 8
    assert machine.photo_threads(27_000_000) == 1
    assert machine.photo_threads(4_000_000) == 3
    (cgroup / "memory.max").write_text("max")
    assert machine.usable_memory() != 10**9


def test_a_user_without_a_home_has_a_cache(monkeypatch):
    def unknown(path):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", unknown)
    assert expanded("~/.cache/ambiguous_wild/weights", "AW_WEIGHTS").is_absolute()
    with pytest.raises(AwError, match="no home folder is known"):
        expanded("~/mine", "AW_WEIGHTS")


def test_signs_that_a_code_page_lacks_are_replaced():
    done = subprocess.run(
        [sys.executable, "-m", "ambiguous_wild.cli.main", "doctor"],
        env=os.environ | {"PYTHONIOENCODING": "cp1252"}, capture_output=True, timeout=120, check=False,
    )  # fmt: skip
    assert b"? python" in done.stdout and b"Traceback" not in done.stderr  # for a check mark


def test_an_opencv_without_contrib_names_the_package(monkeypatch):
    assert ximgproc().guidedFilter
    monkeypatch.delattr(cv2, "ximgproc")
    with pytest.raises(AwError, match="--force-reinstall --no-deps opencv-contrib-python-headless"):
        ximgproc()
