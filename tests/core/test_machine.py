"""What a container may use."""

import pytest

from ambiguous_wild.core import machine


@pytest.fixture
def cgroup(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "CGROUP", tmp_path)
    monkeypatch.setattr(machine, "allowed_cores", lambda: set(range(8)))
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
    ],
)
def test_cores_are_those_of_the_quota(cgroup, files, cores):
    for name, text in files.items():
        (cgroup / name).parent.mkdir(exist_ok=True)
        (cgroup / name).write_text(text)
    assert machine.usable_cores() == cores


def test_memory_limits_how_many_large_photos_are_read_at_once(cgroup):
    assert machine.photo_threads(12_000_000) > 1
    (cgroup / "memory.max").write_text("1000000000")
    assert machine.usable_memory() == 10**9
    assert machine.photo_threads(100_000) == 8
    assert machine.photo_threads(27_000_000) == 1
    assert machine.photo_threads(4_000_000) == 3
    (cgroup / "memory.max").write_text("max")
    assert machine.usable_memory() != 10**9
