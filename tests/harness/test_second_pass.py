"""METHOD+2passes: the second training has the final masks of the first, and both are paid for."""

import json

import numpy as np
import pytest
import torch

from ambiguous_wild import bench
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.harness import training as passes
from ambiguous_wild.harness.run_cost import two_pass_cost
from ambiguous_wild.io.images import read_keep_map
from ambiguous_wild.methods import get_method
from ambiguous_wild.methods.mask_policies import FixedMasks
from ambiguous_wild.methods.registry import knows_truth
from tests.methods.baselines import data_of, step_of
from tests.tiny_scene import TRAIN

ITERATIONS = 60


def run(scene, output, **more):
    settings = ["dronesplat.min_mask_start=10"]
    known = {"iterations": ITERATIONS, "passes": 2, "pictures": False, "settings": settings, "device": "cpu"}
    return bench("dronesplat", scene, output=output, **{**known, **more})


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    report = run(scene, tmp_path_factory.mktemp("runs"))
    assert report.outcomes == {"trained": 1}
    return report.runs[0]


def test_the_second_pass_has_the_masks_of_the_first_and_its_cost(whole):
    assert whole.method == "dronesplat+2passes" and whole.folder.parent.name == "dronesplat+2passes"
    cost, first = whole.result["cost"], json.loads((whole.folder / "first-pass" / "cost.json").read_text())
    assert cost["passes"] == 2 and cost["iterations"] == 2 * ITERATIONS == 2 * first["iterations"]
    assert cost["first_pass_s"] == first["train_s"] < cost["train_s"]
    assert cost["setup_s"] > first["setup_s"]
    masked = []
    for name in TRAIN:
        one, other = (read_keep_map(whole.folder / place / "masks" / name) for place in ("first-pass", "."))
        assert np.array_equal(one, other)
        masked.append(1 - one.mean())
    assert 0 < np.mean(masked) == pytest.approx(whole.result["facts"]["masked_share"], abs=1e-6)
    rows = (whole.folder / "timeline.csv").read_text().splitlines()
    assert float(rows[1].split(",")[0]) >= first["train_s"] - 1e-3


def test_the_second_pass_is_not_the_first(scene, whole, tmp_path):
    once = run(scene, tmp_path, passes=1).runs[0]
    assert once.method == "dronesplat" and "passes" not in once.result["cost"]
    plys = [(r.folder / "point_cloud.ply").read_bytes() for r in (once, whole)]
    assert plys[0] != plys[1]


class Stop(Exception):
    pass


@pytest.mark.parametrize(("at", "swapped"), [(25, False), (ITERATIONS + 25, False), (ITERATIONS + 25, True)])
def test_it_goes_on_in_either_pass_with_the_same_bits(scene, whole, tmp_path, monkeypatch, at, swapped):
    from ambiguous_wild.splat.trainer import Trainer

    steps, true_step = [0], Trainer.step

    def step(self):
        steps[0] += 1
        if steps[0] == at:
            self.save()
            raise Stop
        return true_step(self)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", step)
        assert run(scene, tmp_path).outcomes == {"failed": 1}
    if swapped:  # masks that are not those of the first pass are made again
        one, other = (next(tmp_path.rglob(f"first-pass/masks/{name}")) for name in (TRAIN[0], TRAIN[-1]))
        first = one.read_bytes()
        one.write_bytes(other.read_bytes())
        assert one.read_bytes() != first
    counted = [0]

    def counting(self):
        counted[0] += 1
        return true_step(self)

    monkeypatch.setattr(Trainer, "step", counting)
    again = run(scene, tmp_path).runs[0]
    assert again.outcome == "trained" and counted[0] == 2 * ITERATIONS - at + 1
    name = "point_cloud.ply"
    assert (again.folder / name).read_bytes() == (whole.folder / name).read_bytes()


def test_half_of_a_budget_is_each_passes():
    from types import SimpleNamespace

    from ambiguous_wild.splat.train_config import TrainConfig

    cell = SimpleNamespace(method=get_method("dronesplat+2passes"), train=TrainConfig(budget_s=30.0))
    assert passes.config_of_one_pass(cell).budget_s == 15.0
    once = SimpleNamespace(method=get_method("dronesplat"), train=TrainConfig(budget_s=30.0))
    assert passes.config_of_one_pass(once).budget_s == 30.0


def test_costs_of_both_by_hand():
    one = {
        "train_s": 10.0, "setup_s": 1.0, "iterations": 100, "ms_per_iteration": 100.0, "gaussians": 7,
        "ms_parts": {"mask": 8.0}, "peak_rss_mb": 500.0, "device": "cpu", "threads": 1,
    }  # fmt: skip
    other = one | {
        "train_s": 15.0, "iterations": 300, "ms_per_iteration": 50.0, "ms_parts": {"loss": 4.0},
        "peak_rss_mb": 400.0, "gaussians": 9,
    }  # fmt: skip
    found = two_pass_cost(one, other)
    assert found["train_s"] == 25.0 and found["setup_s"] == 2.0 and found["iterations"] == 400
    assert found["ms_per_iteration"] == pytest.approx(62.5)
    assert found["ms_parts"] == pytest.approx({"mask": 2.0, "loss": 3.0})
    assert found["peak_rss_mb"] == 500.0 and found["gaussians"] == 9


@pytest.mark.parametrize("method", ["3dgs", "absgs", "dronesplat@mask=none", "splatfacto-w@mask=none"])
def test_a_method_without_masks_is_refused_in_one_line(scene, tmp_path, method):
    with pytest.raises(AwError, match=f"final masks, and {method} has none.*--mask METHOD"):
        bench(method, scene, output=tmp_path / "runs", iterations=5, passes=2, device="cpu")
    assert not (tmp_path / "runs").exists() or not list((tmp_path / "runs").rglob("metrics.json"))


def test_names():
    assert get_method("3dgs@mask=dronesplat+2passes").name == "3dgs@mask=dronesplat+2passes"
    assert get_method("dronesplat+2passes").option_keys("dronesplat", "t_local") == ["t_local"]
    assert knows_truth("3dgs+truth+2passes") and not knows_truth("dronesplat+2passes")
    with pytest.raises(AwError, match="did you mean"):
        get_method("dronesplot+2passes")


def test_fixed_masks_are_the_same_in_every_step(scene, tmp_path):
    data = data_of(scene, tmp_path)
    keeps = [torch.ones(48, 64) for _ in TRAIN]
    keeps[1][10:20, 10:20] = 0.0
    policy = FixedMasks(keeps)
    policy.setup(data)
    assert torch.equal(policy.keep(step_of(data, 1, data.photos[1] * 0)), keeps[1])
    small = policy.keep(step_of(data, 1, data.photos[1][::2, ::2] * 0))
    assert small.shape == (24, 32) and not small[5:10, 5:10].any()
    assert policy.facts()["masked_share"] == pytest.approx(100 / (48 * 64) / len(TRAIN))
