"""What this process may use of its machine, within a container too: cores and memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

MEMORY_SHARE = 0.5  # of the usable memory, for photos that threads hold at a time
BYTES_A_PIXEL = 40  # of a photo that is read, turned and searched for features

CGROUP = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")
CPU_LIMITS = ("cpu.max", "cpu/cpu.cfs_quota_us")  # cgroup 2: quota and period; cgroup 1
MEMORY_LIMITS = ("memory.max", "memory/memory.limit_in_bytes")
V1_PERIOD_US = 100_000


def allowed_cores() -> set[int]:
    """Return the numbers of the processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return set(os.sched_getaffinity(0))
    return set(range(os.cpu_count() or 1))


def usable_cores() -> int:
    """Return the number of cores: those of the affinity, within the quota of a container."""
    cores = len(allowed_cores())
    for values in _limits(CPU_LIMITS):
        quota, period = values[0], values[1] if len(values) > 1 else V1_PERIOD_US
        if quota > 0 and period > 0:
            cores = min(cores, max(1, round(quota / period)))
    return cores


def usable_memory() -> int | None:
    """Return bytes of memory, within the limit of a container; None where the system does not tell."""
    if not hasattr(os, "sysconf"):  # Windows
        return None
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return None
    return min([memory, *(values[0] for values in _limits(MEMORY_LIMITS) if values[0] > 0)])


def photo_threads(largest_px: int, bytes_a_pixel: int = BYTES_A_PIXEL) -> int:
    """Return how many threads may work on photos of at most this many pixels at a time."""
    memory = usable_memory()
    if memory is None or largest_px < 1:
        return usable_cores()
    return max(1, min(usable_cores(), int(MEMORY_SHARE * memory / (bytes_a_pixel * largest_px))))


def in_order(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """Yield the result of each item in the order of the items, as `map` does, computed on several threads.

    Few results wait until they are taken, so that a long scene does not fill the memory.
    """
    if threads <= 1:
        yield from map(function, items)
        return
    begun: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for item in items:
            begun.append(pool.submit(function, item))
            if len(begun) > threads:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()


def _limits(names: tuple[str, ...]) -> list[list[int]]:
    """Return the whole numbers of these files, of the process's group and of the root of its container."""
    try:
        own = [line.rpartition(":")[2] for line in OWN_GROUPS.read_text().splitlines()]
    except OSError:
        own = []
    groups = [PurePosixPath(path.strip().lstrip("/")) for path in own]
    within = dict.fromkeys([".", *(str(p) for group in groups for p in (group, *group.parents))])
    # cgroup 2: GROUP/cpu.max; cgroup 1: the controller's folder comes first, cpu/GROUP/cpu.cfs_quota_us
    paths = [
        CGROUP / PurePosixPath(name).parent / group / PurePosixPath(name).name
        for group in within
        for name in names
    ]
    limits = []
    for path in dict.fromkeys(paths):
        try:
            words = path.read_text().split()
        except OSError:
            continue
        numbers = [int(word) for word in words if word.lstrip("-").isdigit()]
        if numbers and words[0] != "max":
            limits.append(numbers)
    return limits
