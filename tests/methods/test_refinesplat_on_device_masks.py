"""Components, thresholds and masks of one photo on an accelerator: every function against the host's."""

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.methods.refinesplat import evidence, masking
from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.methods.refinesplat.on_device import (
    components,
    masks,
    threshold,
)
from ambiguous_wild.methods.refinesplat.threshold import LearntWeight, robust_floor, t_ent
from tests.methods.on_device import (
    noise,
    number,
    tensor,
)


def serpentine(h: int, w: int) -> np.ndarray:
    mask = np.zeros((h, w), bool)
    mask[::2] = True
    mask[1::4, -1] = mask[3::4, 0] = True
    return mask


def spiral(h: int, w: int) -> np.ndarray:
    """One path of width 1 from a corner inwards, walls of width 1."""
    mask = np.zeros((h, w), bool)
    y, x, dy, dx = 0, 0, 0, 1
    mask[0, 0] = True

    def free(a: int, b: int) -> bool:
        return 0 <= a < h and 0 <= b < w and not mask[a, b]

    turned = 0
    while turned < 2:
        ahead = y + dy, x + dx
        beyond = ahead[0] + dy, ahead[1] + dx
        blocked = 0 <= beyond[0] < h and 0 <= beyond[1] < w and mask[beyond]
        if free(*ahead) and not blocked:
            y, x = ahead
            mask[y, x] = True
            turned = 0
        else:
            dy, dx = dx, -dy
            turned += 1
    return mask


def maze(seed: int, h: int, w: int) -> np.ndarray:
    """A random tree of corridors of width 1 that reaches every second pixel."""
    rng = np.random.default_rng(seed)
    mask = np.zeros((h, w), bool)
    mask[0, 0] = True
    stack = [(0, 0)]
    moves = rng.integers(0, 24, h * w)
    orders = [np.random.default_rng(i).permutation(4) for i in range(24)]
    step = 0
    while stack:
        y, x = stack[-1]
        step += 1
        for k in orders[moves[step % len(moves)]]:
            dy, dx = ((1, 0), (-1, 0), (0, 1), (0, -1))[k]
            a, b = y + 2 * dy, x + 2 * dx
            if 0 <= a < h and 0 <= b < w and not mask[a, b]:
                mask[a, b] = mask[y + dy, x + dx] = True
                stack.append((a, b))
                break
        else:
            stack.pop()
    return mask


def comb(h: int, w: int) -> np.ndarray:
    mask = np.zeros((h, w), bool)
    mask[:, ::2] = mask[-1] = True
    return mask


def stairs(h: int, w: int) -> np.ndarray:
    """Diagonals joined at their ends in turn, one path for 8 neighbours."""
    y, x = np.mgrid[:h, :w]
    k = (x + y) // 3
    ends = np.where(k % 2 == 0, (y == 0) | (x == w - 1), (x == 0) | (y == h - 1))
    return ((x + y) % 3 == 0) | ends


SHAPES = {
    "serpentine": lambda h, w: serpentine(h, w),
    "upright serpentine": lambda h, w: serpentine(w, h).T,
    "spiral": spiral,
    "maze": lambda h, w: maze(2, h, w),
    "mirrored maze": lambda h, w: maze(0, h, w)[::-1, ::-1],
    "comb": comb,
    "hanging comb": lambda h, w: comb(h, w)[::-1, ::-1],
    "stairs": stairs,
    "blobs": lambda h, w: cv2.GaussianBlur(noise(0, h, w), (0, 0), 2) > 0.5,
    "8 neighbours percolate": lambda h, w: noise(1, h, w) < 0.407,
    "4 neighbours percolate": lambda h, w: noise(2, h, w) < 0.593,
    "chessboard": lambda h, w: np.add.outer(np.arange(h), np.arange(w)) % 2 == 0,
    "full": lambda h, w: np.ones((h, w), bool),
    "empty": lambda h, w: np.zeros((h, w), bool),
}


def same_parts(found: np.ndarray, expected: np.ndarray) -> bool:
    """Whether two labellings divide a picture alike: as many pairs of labels as there are of each."""
    pairs = np.unique(found.ravel().astype(np.int64) * expected.size + expected.ravel())
    return len(pairs) == len(np.unique(found)) == len(np.unique(expected))


@pytest.mark.parametrize("shape", SHAPES)
def test_components_are_opencvs_at_the_size_of_a_photo(shape):
    mask = np.ascontiguousarray(SHAPES[shape](378, 504))
    for connectivity in (4, 8):
        found = components.components(tensor(mask)[None], connectivity).numpy().reshape(mask.shape)
        _, expected = cv2.connectedComponents(mask.astype(np.uint8), connectivity=connectivity)
        assert same_parts(found, expected)
        assert np.array_equal(found > 0, mask)


def test_too_few_rounds_leave_a_maze_in_parts(monkeypatch):
    mask = maze(2, 378, 504)
    monkeypatch.setattr(components, "rounds_for", lambda pixels: 4)
    found = components.components(tensor(mask)[None], 4).numpy()
    assert len(np.unique(found)) > 2
    assert components.rounds_for(10**9) == 4


def test_larger_photos_get_more_rounds_and_small_ones_no_fewer():
    assert [components.rounds_for(n) for n in (1, 504 * 378, 4 * 504 * 378, 17 * 504 * 378)] == [8, 8, 9, 11]


@pytest.mark.parametrize("seed", range(2))
def test_hysteresis_and_filled_gaps_are_the_hosts(seed):
    values = cv2.GaussianBlur(noise(seed, 60, 83), (0, 0), 1.0 + seed).astype(np.float64)
    low, high = np.quantile(values, [0.5, 0.97])
    both = np.stack([values, values[::-1]])
    found = components.hysteresis(tensor(both), torch.tensor(low), torch.tensor(high))
    assert np.array_equal(found[0], masking.hysteresis(values, low, high))
    assert np.array_equal(found[1], masking.hysteresis(values[::-1], low, high))
    mask = masking.hysteresis(values, low, high)
    assert 0 < mask.mean() < 1
    nothing = components.hysteresis(tensor(both), torch.tensor(torch.inf), torch.tensor(torch.inf))
    assert not nothing.any()
    for share in (0.0, 0.003, 0.05, 1.0):
        for m in (mask, ~mask, np.zeros_like(mask), np.ones_like(mask)):
            assert np.array_equal(components.fill_holes(tensor(m), share), masking.fill_holes(m, share))
    for size in (1, 3, 5):
        assert np.array_equal(components.dilate(tensor(mask), size), masking.dilate(mask, size))


VALUES = {
    "spread": np.random.default_rng(0).gamma(2.0, 1.0, 60),
    "two groups": np.r_[
        np.random.default_rng(1).normal(1, 0.1, 40), np.random.default_rng(2).normal(9, 1, 7)
    ],
    "ties": np.repeat([1.0, 2.0, 7.0, 8.0], 5),
    "equal": np.full(9, 0.3),
    "all but equal": 0.3 + 1e-11 * np.arange(9),
    "zeros": np.zeros(5),
    "mostly zeros": np.r_[np.zeros(30), 3.0, 4.0],
    "one": np.array([4.0]),
    "none": np.zeros(0),
}


def padded(values: np.ndarray) -> torch.Tensor:
    """With gaps, as the stack of all photos has them."""
    return tensor(np.r_[np.nan, values, np.nan, np.nan])


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize(
    "settings",
    [
        {}, {"gate": 0.0}, {"gate": 0.0, "least": 0.0}, {"threshold": "hard"}, {"threshold": "statistics"},
        {"threshold": "statistics", "gate": 0.0, "least": 0.0}, {"threshold": "literal"},
        {"threshold": "literal", "gate": 0.0, "least": 0.0},
    ],
)  # fmt: skip
def test_t_ent_and_the_learnt_weight_are_the_hosts(name, settings):
    values, config = VALUES[name], MaskConfig(**{"least": 1.5, "hard": 2.0, **settings})
    for w2 in (0.2, 0.5, 0.8):
        expected = t_ent(values, w2, config.threshold, config.gate, config.floor, config.hard)
        pool = threshold.pool_of(padded(values))
        cut = threshold.t_ent(pool, torch.tensor(w2, dtype=torch.float64), config)
        assert float(cut.threshold) == pytest.approx(expected.threshold, rel=1e-12)
        if len(values) and np.isfinite(expected.floor):
            assert float(cut.floor) == pytest.approx(expected.floor, rel=1e-12)
        low = cut.below(torch.tensor(1.7, dtype=torch.float64))
        assert float(low.threshold) == pytest.approx(min(expected.threshold, 1.7))
        host = LearntWeight(theta=float(np.log(w2 / (1 - w2))))
        before, areas = host.theta, 1 + np.arange(len(values)) * 10.0
        price = max(robust_floor(values, max(config.disagree, 1.0)), 1e-12)
        if len(values) > 1:
            host.learn(values, values / price, areas, float(low.floor), config.threshold)
        theta = torch.tensor(before, dtype=torch.float64)
        found = threshold.learnt(theta, pool, padded(areas), low.floor, config)
        # T is rounded to 1e-16, and divided by a spread of 2.5e-10 at least
        assert float(found) == pytest.approx(host.theta, abs=1e-6)
        moved = host.theta != before
        if not settings:
            assert moved == (name in ("spread", "two groups", "ties", "mostly zeros"))


LABELS = np.random.default_rng(3).integers(-1, 7, (8, 11)).repeat(6, 0).repeat(7, 1).astype(np.int32)


@pytest.mark.parametrize(
    "settings",
    [
        {}, {"combine": "union"}, {"use_global": False}, {"use_local": False}, {"dilation": 5},
        {"most": 0.05}, {"scope": "photo"}, {"threshold": "hard", "hard": 8.0}, {"fill": 0.0},
        {"threshold": "literal"}, {"threshold": "statistics"},
        {"gate": 0.0, "least": 3.0},
    ],
)  # fmt: skip
@pytest.mark.parametrize("ceiling", [np.inf, 6.0])
@pytest.mark.parametrize("vouched", [False, True])
def test_masks_of_one_photo_are_the_hosts(settings, ceiling, vouched):
    labels = LABELS.copy()
    labels[(labels == 3) | (labels == 5)] = 2  # label 3 has no pixels
    labels[10:30, 20:60], labels[34:46, 20:60] = 6, 5
    values = cv2.GaussianBlur(noise(11, *labels.shape), (0, 0), 3) * 4
    values[10:30, 4:60] += 15.0
    values[34:46, 20:60] += 14.0
    values[14:16, 30:32] = 0.0
    values = values.astype(np.float32)
    static = np.zeros(6, bool)
    static[4] = vouched
    unseen = np.zeros(labels.shape, bool)
    unseen[:, :9] = True
    config = MaskConfig(**settings)
    others = [
        evidence.Judged(v, v, np.full(len(v), 9.0))
        for v in (noise(1, 5).astype(np.float64) + 1.0, noise(2, 4).astype(np.float64) * 9)
    ]
    maps = evidence.Maps(values, values)
    expected = evidence.make_masks(maps, labels, static, others, 0.4, config, ceiling, unseen)
    of_labels = masks.Labels([labels] * 3, [static] * 3, [unseen] * 3, "cpu")
    pool = np.full((3, of_labels.most), np.nan)
    pool[0, :5], pool[2, :4] = others[0].values, others[1].values
    found = masks.make_masks(
        1, tensor(values), of_labels, tensor(pool), number(0.4), config,
        None if np.isinf(ceiling) else number(ceiling), tensor(~unseen),
    )  # fmt: skip
    assert np.allclose(found.means[of_labels.known[1]], expected.judged.values, rtol=1e-12)
    assert float(found.cut.threshold) == pytest.approx(expected.cut.threshold, rel=1e-12)
    for name in ("local", "global_", "keep"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name
    shares = [
        1 - expected.keep.mean(),
        expected.local.mean(),
        expected.global_.mean(),
        expected.cut.threshold,
    ]
    assert np.allclose(found.shares(), shares, atol=1e-6)
    if not settings:
        assert 0 < shares[0] < 0.7
