"""Processes of a shared run: how they end, which error is reported, and which runs are refused."""

import multiprocessing
import os
import signal
import time
from dataclasses import replace

import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.fields import Fields
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.multi_gpu import launch as launching
from ambiguous_wild.splat.multi_gpu import shards
from ambiguous_wild.splat.multi_gpu.launch import launch
from ambiguous_wild.splat.multi_gpu.refuse import refuse, refuse_more_than
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import MaskPolicy, Parts

# -- processes -----------------------------------------------------------------------------------


def dies(ranks, tell):
    if ranks.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    ranks.wait()
    time.sleep(60)


def test_a_rank_that_is_killed_ends_the_others_and_is_named():
    with pytest.raises(
        AwError, match=r"^GPU 2 of 2: its process was killed by signal 9, and the others were"
    ):
        launch(2, dies, backend="gloo")
    assert multiprocessing.active_children() == []


class Ended:
    """A worker's end of the pipe, and a process that ended with this code."""

    def __init__(self, rank, *said, code=1):
        self.rank, self.exitcode, self.process = rank, code, self
        self.connection, theirs = multiprocessing.Pipe()
        for message in said:
            theirs.send(message)
        theirs.close()

    def join(self, timeout):
        pass

    receive, _died = launching._Worker.receive, launching._Worker._died


def failed(rank, error, at):
    try:
        raise error
    except BaseException as caught:
        return "failed", replace(launching._failure(rank, caught), at=at)


LOST = RuntimeError("Connection closed by peer")


@pytest.mark.parametrize(
    ("workers", "expected"),
    [
        (
            lambda: [Ended(0, failed(0, LOST, 1.0)), Ended(1, code=-9)],
            "^GPU 2 of 2: its process was killed by",
        ),
        (lambda: [Ended(0, failed(0, LOST, 1.0)), Ended(1, failed(1, AwError("no disk"), 2.0))], "^no disk$"),
        (
            lambda: [Ended(0, failed(0, LOST, 2.0)), Ended(1, failed(1, ValueError("bad\nrow"), 1.0))],
            r"^GPU 2 of 2: ValueError: bad row; its traceback is in .*rank2of2.txt$",
        ),
        (
            lambda: [Ended(0, failed(0, ValueError("bad"), time.time() + 1)), Ended(1, code=-signal.SIGABRT)],
            "^GPU 1 of 2: ValueError: bad;",
        ),
        (
            lambda: [Ended(0, ("done", 1)), Ended(1, code=3)],
            "^GPU 2 of 2: its process ended with exit code 3",
        ),
    ],
)
def test_of_several_failures_the_first_is_told(workers, expected, tmp_path):
    with pytest.raises(AwError, match=expected):
        launching._results(workers(), lambda message: None, tmp_path)
    for path in tmp_path.iterdir():
        assert "ValueError: bad" in path.read_text()


def test_results_come_by_rank_and_what_is_told_is_heard():
    heard = []
    workers = [Ended(1, ("done", "b")), Ended(0, ("told", 5), ("done", "a"))]
    assert launching._results(workers, heard.append, None) == ["a", "b"]
    assert heard == [5]


# -- refused -------------------------------------------------------------------------------------


def parts_of(method, effects=()):
    entry = get_method(method)
    return with_effects(entry.build(entry.options()), effects)


@pytest.mark.parametrize(
    ("method", "effects", "config", "gpus", "expected"),
    [
        ("refinesplat", (), {}, 2, "masks of .* are learnt in the run"),
        ("robustsplat", (), {}, 2, "masks of .* are learnt in the run"),
        ("dronesplat", (), {}, 2, "masks of .* are learnt in the run"),
        ("3dgs@density=refinesplat", (), {}, 2, "EntropyAwareDensity compares|masks of"),
        ("3dgs", ("exposure",), {}, 2, r"effects \(exposure\)"),
        ("3dgs", (), {"budget_s": 60.0}, 2, "--budget stops by a clock"),
        ("3dgs", (), {"on_nonfinite": "rollback"}, 2, "rollback is for one GPU"),
        ("3dgs", (), {}, 1, "2 to 9 GPUs"),
        ("3dgs", (), {}, 10, "2 to 9 GPUs"),
    ],
)
def test_what_cannot_be_shared_is_refused_in_one_line(method, effects, config, gpus, expected):
    with pytest.raises(AwError, match=f"^--gpus {gpus}: .*({expected})") as caught:
        refuse(parts_of(method, effects), TrainConfig(**config), gpus)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("method", "effects"), [("3dgs", ("sh1",)), ("3dgs+truth", ()), ("3dgs-clean", ())])
def test_what_learns_nothing_of_its_own_is_shared(method, effects):
    refuse(parts_of(method, effects), TrainConfig(), 9)


class Pair(Fields):
    def setup(self, data, static, rates):
        return {}


class Absolute(DensityControl):
    needs = frozenset({"absolute"})


class Early(DensityControl):
    before_optimiser = True


class Slow(DensityControl):
    pass


class Extra(MaskPolicy):
    def gradients(self, step, keep):
        return None


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        (Parts(fields=Pair()), "Pair draws several fields into a picture"),
        (Parts(density=Absolute), r"Absolute needs statistics of the backward pass \(absolute\)"),
        (Parts(density=Early), "Early changes Gaussians before the optimiser"),
        (Parts(density=Slow), "Slow compares Gaussians that lie on different GPUs"),
        (Parts(mask=Extra()), "masks of Extra"),
    ],
)
def test_parts_that_cannot_be_shared_are_refused_in_one_line(parts, expected):
    with pytest.raises(AwError, match=f"^--gpus 2: {expected}.*; leave --gpus out") as caught:
        refuse(parts, TrainConfig(), 2)
    assert "\n" not in str(caught.value)


def test_a_start_and_a_filter_of_ones_own_are_shared():
    start = lambda data: Gaussians.from_points(data.scene.points.xyz, data.scene.points.rgb)  # noqa: E731
    refuse(Parts(start=start, blur=0.1), TrainConfig(), 2)


def test_more_gpus_than_there_are_and_no_gpus():
    refuse_more_than(4, 4)
    with pytest.raises(AwError, match="--gpus 4: torch sees 1 GPU here; give no more"):
        refuse_more_than(1, 4)
    if torch.cuda.device_count() < 9:
        with pytest.raises(AwError, match=r"--gpus 9: torch sees .* here"):
            launch(9, dies)


@pytest.mark.parametrize(
    ("name", "size", "expected"),
    [
        ("last-rank1of4.safetensors", 2, "run on 4 GPUs, not on 2: go on with it with --gpus 4, or"),
        ("next-rank1of4.safetensors", 2, "run on 4 GPUs"),
        ("last.safetensors", 2, "run on 1 GPU, not on 2: go on with it without --gpus, or"),
        ("last-rank1of2.safetensors", 2, None),
        ("whole.safetensors", 2, None),
    ],
)
def test_another_number_of_gpus_is_refused(tmp_path, name, size, expected):
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / name).touch()
    if expected is None:
        shards.refuse_other_number(tmp_path, size)
    else:
        with pytest.raises(AwError, match=expected):
            shards.refuse_other_number(tmp_path, size)


def test_shards_are_of_one_moment_or_not_used(tmp_path):
    assert shards.newest_common([[], []], tmp_path) is None
    assert shards.newest_common([[400, 500], [500, 600]], tmp_path) == 500
    assert shards.newest_common([[400, 500], [400, 500]], tmp_path) == 500
    with pytest.raises(AwError, match=r"not of one iteration \(rank 1: 400, 500; rank 2: none\): start anew"):
        shards.newest_common([[400, 500], []], tmp_path)
