"""Tests that need a GPU are skipped elsewhere, and slow ones without AW_SLOW_TESTS=1.

Parallel test processes use one kernel thread each. Runs are short in tests: the calibration of the machine is
a small one, and frames a second are counted for an instant. Weights that lie on the machine are not seen, for
methods choose their features by them; `machine_weights` shows them.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress

import pytest

with suppress(ImportError):  # torch.utils.cpp_extension wants it, and it refuses to come after distutils
    import setuptools  # noqa: F401

NO_WEIGHTS = os.path.join(os.path.dirname(__file__), "no-weights")
if os.environ.get("AW_WEIGHTS") != NO_WEIGHTS:  # parallel test processes inherit it
    os.environ["AW_TEST_WEIGHTS"] = os.environ.get("AW_WEIGHTS", "")
    os.environ["AW_WEIGHTS"] = os.environ["HF_HUB_CACHE"] = NO_WEIGHTS


@pytest.fixture
def machine_weights(monkeypatch):
    """Weights that lie on the machine, for tests that compare published networks."""
    monkeypatch.setenv("AW_WEIGHTS", os.environ["AW_TEST_WEIGHTS"])


@pytest.fixture(autouse=True)
def registered_methods(monkeypatch):
    """Methods that a test registers are gone after it."""
    from ambiguous_wild.methods import registry

    monkeypatch.setattr(registry, "registered", dict(registry.registered))


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """The folder of a tiny scene that is trained on within seconds; nobody changes it."""
    from tests.faults.compare import state
    from tests.shared import made_once
    from tests.tiny_scene import write_tiny_scene

    folder = made_once(tmp_path_factory, "tiny", lambda root: write_tiny_scene(root / "scene")) / "scene"
    before = state(folder)
    yield folder
    assert state(folder) == before, "a test changed the scene that all share"


@pytest.fixture(scope="session")
def finished(scene, tmp_path_factory):
    """The runs folder of a short run of 3dgs on the tiny scene; nobody changes it."""
    from ambiguous_wild.harness.grid import plan_cells, run_cells
    from ambiguous_wild.splat.train_config import TrainConfig
    from tests.shared import made_once

    def make(root):
        cells = plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=20, probes=0))
        (report,) = run_cells(cells, root / "runs")
        assert report.outcome == "trained", report.error

    return made_once(tmp_path_factory, "finished", make) / "runs"


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """A folder with a capture of two walls, `raw`, its `scene`, and the finished stages of the build.

    Built once; whoever changes something works on a copy of `scene` and of `.scene.build` beside it.
    """
    from ambiguous_wild.builder.pipeline import build_scene
    from tests.builder.capture_maker import SETTINGS, write_split_capture
    from tests.shared import made_once

    def make(root):
        build_scene(write_split_capture(root / "raw"), root / "scene", SETTINGS, jobs=2, keep_work=True)

    return made_once(tmp_path_factory, "built", make)


def pytest_collection_modifyitems(config, items):
    if not config.option.markexpr and not os.environ.get("AW_SLOW_TESTS"):
        skip = pytest.mark.skip(reason="slow: set AW_SLOW_TESTS=1, or select it with -m slow")
        for item in items:
            if item.get_closest_marker("slow"):
                item.add_marker(skip)
    wanted = [item for item in items if item.get_closest_marker("gpu")]
    if not wanted:
        return
    from ambiguous_wild.splat.readiness import gpu_facts, missing_dependency

    lack = missing_dependency(gpu_facts())
    if lack is not None:
        skip = pytest.mark.skip(reason=f"no GPU to test on: {lack.what}")
        for item in wanted:
            item.add_marker(skip)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Scenes of tests are tiny: a second thread doubles the work and takes a core from another process.

    Kernels give the same bits for any number of threads; tests of that set the number themselves.
    """
    calibration = sys.modules.get("ambiguous_wild.splat.calibration")
    if calibration is not None:
        calibration.KERNELS["cpu"] = calibration.KernelSize("cpu-3", 0.0625, 300, 32, 32, 1)
    evaluate = sys.modules.get("ambiguous_wild.harness.evaluate")
    if evaluate is not None:
        evaluate.FPS_SECONDS = 0.05  # two seconds a run, which say nothing here
    numba = sys.modules.get("numba")
    if numba is not None and "PYTEST_XDIST_WORKER" in os.environ:
        numba.set_num_threads(1)
