"""benchmarks/paper_features.py and entropy_auc.py: what is planned and how figures are made, by hand."""

import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def modules():
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import entropy_auc
        import paper_features

        yield paper_features, entropy_auc
    finally:
        sys.path.remove(str(BENCHMARKS))


def test_a_back_end_sets_features_and_instances_where_a_method_uses_them(modules):
    paper, _ = modules
    assert paper.settings_of("refinesplat-paper", "vgg16") == {"features": "vgg16", "instances": "vgg16"}
    assert paper.settings_of("refinesplat-paper", "labhog") == {"features": "labhog", "instances": "graph"}
    assert paper.settings_of("robustsplat", "sceneconv") == {"features": "sceneconv"}
    assert paper.settings_of("robustsplat", "default") == {}
    backends = ["labhog", "sceneconv", "vgg16"]
    assert paper.backends_of("dronesplat", backends) == ["labhog", "vgg16"]  # both of them: graph segments
    assert paper.backends_of("robustsplat", backends) == backends
    assert paper.backends_of("3dgs", backends) == [""]


def run(method, psnr, seed=0, iou=None, cpu=20.0, backend="", scene="a"):
    return {
        "scene": scene, "method": method, "backend": backend, "seed": seed, "psnr": psnr, "iou": iou,
        "cpu_ms": cpu, "setup_s": 1.0, "gaussians": 10, "timing": "contended",
    }  # fmt: skip


def test_gains_are_seed_by_seed_and_collapses_are_marked(modules):
    paper, _ = modules
    rows = [
        run("3dgs", 20.0), run("3dgs", 24.0, seed=1), run("3dgs", 9.0, scene="b"),
        run("robustsplat", 19.0, backend="labhog", iou=0.25, cpu=40.0),
        run("robustsplat", 22.0, seed=1, backend="labhog", iou=0.75, cpu=20.0),
        run("robustsplat", 20.0, seed=1, backend="vgg16", scene="b"),
    ]  # fmt: skip
    found = {(r["scene"], r["method"], r["backend"]): r for r in paper.summary(rows)}
    own = found["a", "robustsplat", "labhog"]
    assert (own["seeds"], own["psnr"], own["gain_db"], own["iou"]) == (2, 20.5, -1.5, 0.5)
    assert own["cpu_ratio"] == 1.5 and own["sd"] == pytest.approx(3 / 2**0.5)
    assert found["b", "robustsplat", "vgg16"]["gain_db"] is None  # 3dgs has no run of that seed
    data = {
        "iterations": 7, "max_gaussians": 9, "seeds": [0, 1], "contended": 6, "runs": rows,
        "rows": paper.summary(rows), "missing": ["dronesplat vgg16 on b, seed 0"],
    }  # fmt: skip
    page = paper.to_markdown(data)
    assert "| robustsplat | labhog | 20.50 / 0.50 ! |  | -1.50 (1) | 1.50 (1) |" in page
    assert "Not run yet: dronesplat vgg16 on b, seed 0." in page
    assert "during 6 of 6 runs" in page


def test_the_area_under_the_curve_by_counting_pairs(modules):
    _, auc = modules
    generator = np.random.default_rng(0)
    values = generator.integers(0, 6, 60).astype(float)
    positive = generator.random(60) < 0.3
    above = values[positive][:, None] - values[~positive][None, :]
    by_pairs = float(np.mean((above > 0) + 0.5 * (above == 0)))
    assert auc.auc(values, positive) == pytest.approx(by_pairs, abs=1e-12)
    assert auc.auc(values, np.zeros(60, bool)) is None
