"""An accelerator's path against the CPU's, with numbers: both are the same but for a few kernels."""

import dataclasses
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from ambiguous_wild.methods.masking_common import resized
from ambiguous_wild.methods.refinesplat import maps, merging, pixels, structure
from ambiguous_wild.methods.refinesplat.density_control import (
    EntropyAwareDensity,
    EntropyDensityConfig,
    Support,
    SupportConfig,
)
from ambiguous_wild.methods.refinesplat.multiview import MultiViewConfig
from ambiguous_wild.splat import gpu_kernels
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam
from tests.methods.on_device import LOOK, MOST, PLAIN, capture, differing, noise, on, tensor, visit
from tests.methods.test_refinesplat_pixels import asked, others_of, store
from tests.methods.test_refinesplat_pixels import camera as side_camera
from tests.methods.test_refinesplat_policy import FAST, HEIGHT, VIEWS, WIDTH, fresh, plain
from tests.splat import scenes


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return capture(tmp_path_factory.mktemp("scene"))


@pytest.fixture(params=[False, True], ids=["cpu", "accelerator"])
def both(monkeypatch, request):
    on(monkeypatch, request.param)


@pytest.fixture
def accelerated(monkeypatch):
    on(monkeypatch, True)


# -- filters --------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(40, 51), (9, 3), (1, 7)])
@pytest.mark.parametrize("size", [3, 7])
def test_boxes_are_opencvs(shape, size, both):
    x = noise(0, *shape)
    expected = cv2.blur(x, (size, size), borderType=cv2.BORDER_REPLICATE)
    # sums of `size` float32 in [0, 1], twice: at most 2 * size roundings of 2^-24
    assert np.allclose(structure.box_filter(tensor(x)[None], size)[0], expected, atol=2 * size * 2**-24)


@pytest.mark.parametrize("shape", [(40, 50), (41, 51), (7, 3)])  # halves are whole, or not
def test_blurred_halves_and_sizes_are_opencvs(shape):
    x = noise(1, *shape)
    h, w = shape[0] // 2, shape[1] // 2
    wide = cv2.blur(x, (9, 9), borderType=cv2.BORDER_REPLICATE)
    expected = cv2.resize(wide, (w, h), interpolation=cv2.INTER_AREA)
    rows, columns = (structure.blur_and_shrink(n, n // 2, 9) for n in shape)
    assert np.allclose(rows @ x @ columns.T, expected, atol=2e-6)  # some 30 products of float32 a sum
    small = cv2.resize(x, (w, h), interpolation=cv2.INTER_NEAREST)
    assert np.array_equal(structure.nearest(tensor(x), (h, w)), small)
    large = cv2.resize(small, shape[::-1], interpolation=cv2.INTER_LINEAR)
    # places to 2^-24 of the width, times differences of up to 1 from pixel to pixel
    assert np.allclose(resized(tensor(small), *shape), large, atol=shape[1] * 2**-22)


def pictures(kind: str) -> tuple[np.ndarray, np.ndarray]:
    a, b = noise(2, 40, 51, 3), noise(3, 40, 51, 3)
    return {
        "noise": (a, b),
        "same": (a, a.copy()),
        "plain": (np.full_like(a, 0.97), np.full_like(a, 0.95)),
        "almost plain": (0.9 + 0.01 * a, 0.9 + 0.01 * b),
        "black": (np.zeros_like(a), b),
    }[kind]


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8])
def test_medians_and_quantiles_are_numpys(count, both):
    x = noise(count, 8).astype(np.float64)
    x[count:] = np.nan
    expected = np.median(x[:count]) if count else np.nan
    assert np.allclose(maps.median(tensor(x)), expected, equal_nan=True, rtol=1e-15)
    there = np.zeros((6, 9), bool)
    there.ravel()[np.random.default_rng(count).permutation(54)[:count]] = True
    image = noise(9, 6, 9)
    found, number = maps.low_quantile(tensor(image), tensor(~there), 0.25)
    assert int(number) == count
    assert float(found) == pytest.approx(float(np.quantile(image[there], 0.25)) if count else 0.0, rel=1e-6)
    if count:
        middle, spread = maps.spread_of(tensor(x))
        mad = 1.4826 * np.median(np.abs(x[:count] - expected))
        assert float(middle) == pytest.approx(expected)
        assert float(spread) == pytest.approx(max(mad, 0.05 * expected), rel=1e-12)


@pytest.mark.parametrize("setting", [{}, {"agree": 0.0}, {"sparse": False}, {"quantile": 0.3, "known_by": 5}])
@pytest.mark.parametrize("sizes", ["one", "many"])
def test_other_views_say_what_they_say_on_the_cpu(setting, sizes, monkeypatch):
    """Six views of a wall, one of them with nothing to say yet; half of the depths are wrong."""
    rng = np.random.default_rng(0)
    h, w, plane = 40, 64, 5.0
    cameras, photos, surfaces = [], [], []
    for view in range(6):
        cam = side_camera(0.15 * view)
        if sizes == "many" and view % 2:
            cam = cam.resized(w - 9, h - 6)
        cameras.append(cam)
        photos.append(noise(view // 3, cam.height, cam.width, 3))
        known = np.full((cam.height // 3, cam.width // 3), 1 / plane, np.float32)
        known[:4] = np.nan
        surfaces.append(None if view == 5 else known)
    others = others_of(cameras, photos, MultiViewConfig(**setting), surfaces)
    for view in [0, 1, 2, 3, 5]:
        shape = photos[view].shape[:2]
        said = rng.random(shape).astype(np.float32)
        depth = np.where(rng.random(shape) < 0.5, plane, 2.5 * plane).astype(np.float32)
        depth[:, :3] = 0.0
        store(others, view, said, depth)
        wide = cv2.blur(said, (9, 9), borderType=cv2.BORDER_REPLICATE)
        small = cv2.resize(wide, (shape[1] // 2, shape[0] // 2), interpolation=cv2.INTER_AREA)
        assert np.allclose(others.evidence.of(view)[0], small, atol=2e-6)
        found = []
        for there in (False, True):  # kernels, or tensors
            on(monkeypatch, there)
            found.append(asked(others, view))
        # rounding decides at the borders between two pixels, or two colours
        for of_cpu, of_gpu in zip(dataclasses.astuple(found[0]), dataclasses.astuple(found[1])):
            assert np.isclose(of_cpu, of_gpu, atol=1e-4, equal_nan=True).mean() > 0.995
    assert np.isfinite(found[0].evidence).mean() > 0.3  # or there was nothing to compare


# -- regions --------------------------------------------------------------------------------------


def serpentine(h: int, w: int) -> np.ndarray:
    mask = np.zeros((h, w), bool)
    mask[::2] = True
    mask[1::4, -1] = mask[3::4, 0] = True
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


SHAPES = {
    "serpentine": lambda h, w: serpentine(h, w),
    "upright serpentine": lambda h, w: serpentine(w, h).T,
    "maze": lambda h, w: maze(2, h, w),
    "mirrored maze": lambda h, w: maze(0, h, w)[::-1, ::-1],
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
def test_components_are_opencvs_at_the_size_of_a_photo(shape, accelerated):
    mask = np.ascontiguousarray(SHAPES[shape](378, 504))
    for connectivity in (4, 8):
        found = pixels.components(tensor(mask)[None], connectivity).numpy().reshape(mask.shape)
        _, expected = cv2.connectedComponents(mask.astype(np.uint8), connectivity=connectivity)
        assert same_parts(found, expected)
        assert np.array_equal(found > 0, mask)


def test_too_few_rounds_leave_a_maze_in_parts(monkeypatch, accelerated):
    mask = maze(2, 378, 504)
    monkeypatch.setattr(pixels, "rounds_for", lambda pixels: 4)
    found = pixels.components(tensor(mask)[None], 4).numpy()
    assert len(np.unique(found)) > 2
    assert pixels.rounds_for(10**9) == 4


def test_larger_photos_get_more_rounds_and_small_ones_no_fewer():
    assert [pixels.rounds_for(n) for n in (1, 504 * 378, 4 * 504 * 378, 17 * 504 * 378)] == [8, 8, 9, 11]


@pytest.mark.parametrize("seed", range(2))
def test_hysteresis_and_filled_gaps_are_the_cpus(seed, monkeypatch):
    values = cv2.GaussianBlur(noise(seed, 60, 83), (0, 0), 1.0 + seed).astype(np.float64)
    low, high = torch.tensor(np.quantile(values, [0.5, 0.97]))
    results = []
    for there in (False, True):
        on(monkeypatch, there)
        found = pixels.hysteresis(tensor(np.stack([values, values[::-1]])), low, high)
        holes = [pixels.fill_holes(m, share) for share in (0.003, 0.05, 1.0) for m in (found[0], ~found[0])]
        results.append(torch.stack([*found, *holes]))
    assert torch.equal(*results)
    assert 0 < results[0][0].float().mean() < 1


# -- whole masks ----------------------------------------------------------------------------------

NO_OTHERS = dataclasses.replace(PLAIN.mask, multiview=MultiViewConfig(strength=0.0))


@pytest.mark.parametrize(
    "config",
    [
        PLAIN,
        dataclasses.replace(PLAIN, mask=dataclasses.replace(PLAIN.mask, memory=0.0, w2=0.4, ceiling=0.0)),
        dataclasses.replace(PLAIN, mask=NO_OTHERS, first_look=dataclasses.replace(LOOK, on=False)),
    ],
    ids=["default", "no memory", "nobody asked"],
)
def test_masks_over_visits_are_the_cpus(scene, monkeypatch, config):
    cpu, there = fresh(scene, config), fresh(scene, config)
    changed = 0
    for number in range(3 * VIEWS):
        step = visit(scene, number)
        on(monkeypatch, False)
        expected, predicted = cpu.keep(step), cpu.predict(step)
        on(monkeypatch, True)
        found = there.keep(step)
        assert differing(expected, found) <= MOST and differing(predicted, there.predict(step)) <= MOST
        changed += int((expected == 0).sum())
        assert np.allclose(there.masks.shares[step.view], cpu.masks.shares[step.view], rtol=1e-3, atol=MOST)
    assert changed > 0.02 * 3 * sum(t.size for t in scene.truths)
    assert there.masks.w2 == pytest.approx(cpu.masks.w2, abs=1e-3)
    assert cpu.masks.w2 == config.mask.w2 if config.mask.w2 is not None else cpu.masks.w2 != 0.5
    for name, value in cpu.facts().items():
        assert there.facts()[name] == (value if value is None else pytest.approx(value, rel=1e-2)), name
    for view, judged in cpu.masks.judged.items():
        assert np.allclose(there.masks.judged[view].values, judged.values, rtol=1e-3, atol=1e-3)
        assert np.array_equal(there.masks.judged[view].areas, judged.areas)


@pytest.mark.parametrize("begins_there", [True, False])
def test_a_run_goes_on_on_the_other_machine(scene, monkeypatch, begins_there):
    begun, resumed = fresh(scene, PLAIN), fresh(scene, PLAIN)
    on(monkeypatch, begins_there)
    for number in range(VIEWS + 2):
        begun.keep(visit(scene, number))
    state = begun.state_dict()
    on(monkeypatch, not begins_there)
    resumed.load_state_dict(state)
    again = resumed.state_dict()
    assert repr(plain(state)) == repr(plain(again))
    for number in range(VIEWS + 2, 2 * VIEWS + 2):
        step = visit(scene, number)
        on(monkeypatch, begins_there)
        expected = begun.keep(step)
        on(monkeypatch, not begins_there)
        assert differing(expected, resumed.keep(step)) <= MOST


@pytest.mark.parametrize(("statistic", "shown"), [("structure", "evidence"), ("entropy", "entropy")])
def test_pictures_are_drawn_of_what_the_device_holds(scene, accelerated, tmp_path, statistic, shown):
    policy = fresh(
        scene,
        dataclasses.replace(PLAIN, psi=FAST.psi, mask=dataclasses.replace(PLAIN.mask, statistic=statistic)),
    )
    for number in range(VIEWS):
        policy.keep(visit(scene, number))
    panels = policy.panels(visit(scene, 0))
    assert all(p.shape == (HEIGHT, WIDTH, 3) for p in panels.values())
    assert shown in {name.partition(",")[0] for name in panels}
    assert policy.inputs.has_semantics == (statistic == "entropy")  # what decides nothing is not computed
    assert [path.exists() for path in policy.draw(tmp_path)] == [True]


# -- density --------------------------------------------------------------------------------------


@pytest.mark.parametrize("masked", [True, False])
def test_looks_at_all_rows_count_what_looks_at_some_do(monkeypatch, masked):
    cam = scenes.camera()
    keep = tensor(cv2.resize(noise(3, 4, 5), (cam.width, cam.height)) > 0.6).float() if masked else None
    counts = []
    for accelerated in (False, True):
        on(monkeypatch, accelerated)
        support = Support(SupportConfig())
        support.match(300, torch.device("cpu"))
        for seed in range(4):
            gaussians = scenes.gaussians(seed, 300)
            gaussians.means[0] = torch.nan  # until the next round of density control
            support.observe(gaussians, tensor(noise(seed, 300) < 0.8), cam, keep)
        counts.append(support)
    host, device = counts
    assert torch.equal(host.looked, device.looked) and torch.equal(host.kept, device.kept)
    assert host.kept.sum() > 0 and bool((host.kept < host.looked).any()) == masked


def cloud(count, seed=0, spread=1.0, size=-2.0):
    rng = np.random.default_rng(seed)
    g = Gaussians.from_points(rng.normal(size=(count, 3)) * spread, np.full((count, 3), 120, np.uint8))
    g.quats[:] = torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32))
    g.log_scales[:] = torch.from_numpy((size + 0.6 * rng.normal(size=(count, 3))).astype(np.float32))
    g.opacity_logits[:] = torch.from_numpy(rng.normal(size=count).astype(np.float32))
    g.sh0 += torch.from_numpy(0.1 * rng.normal(size=(count, 3)).astype(np.float32))
    g.sh_rest[:] = torch.from_numpy(rng.normal(size=tuple(g.sh_rest.shape)).astype(np.float32))
    return g


@pytest.mark.parametrize("kind", ["even", "clustered", "line", "plane", "outlier", "few"])
def test_neighbours_are_those_of_a_tree(kind, monkeypatch):
    rng = np.random.default_rng(1)
    count = 7 if kind == "few" else 3000
    xyz = rng.normal(size=(count, 3)).astype(np.float32)
    if kind == "clustered":
        xyz = (xyz * 0.01 + rng.integers(0, 9, (count, 1)) * np.array([10.0, 3.0, 0.0])).astype(np.float32)
    if kind == "line":
        xyz[:, 1:] = 2.0
    if kind == "plane":
        xyz[:, 2] = 0.5
    if kind == "outlier":
        xyz[count // 3] = 1e5
    monkeypatch.setattr(gpu_kernels, "BOX", 32)  # many boxes, so that the first look is not enough for all
    found = gpu_kernels.nearest(torch.from_numpy(xyz), min(9, count)).numpy()
    distances = np.linalg.norm(xyz[:, None].astype(float) - xyz[found], axis=2)
    expected = cKDTree(xyz.astype(float)).query(xyz.astype(float), k=min(9, count))[0]
    np.testing.assert_allclose(distances, expected, rtol=1e-4, atol=1e-6 * np.abs(xyz).max())
    assert all(len(set(row)) == len(row) for row in found.tolist())


def test_coincident_points_have_neighbours(monkeypatch):
    monkeypatch.setattr(gpu_kernels, "BOX", 16)
    points = torch.zeros(100, 3)
    points[50:] = torch.rand(50, 3) + 5
    found = gpu_kernels.nearest(points, 9)
    assert int(found.min()) >= 0 and int(found.max()) < 100
    assert (found[:50] < 50).all()


@pytest.mark.parametrize("seed", range(5))
def test_couples_are_those_that_one_after_the_other_gives(seed):
    rng = np.random.default_rng(seed)
    pairs = np.unique(np.sort(rng.integers(0, 60, (200, 2)), 1), axis=0)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    rng.shuffle(pairs)
    cluster = merging.clusters(60, tensor(pairs), 2)
    taken = merging.greedy_matching(60, tensor(pairs)).numpy()
    assert taken.sum() > 10
    assert taken.tolist() == [bool(cluster[i] == cluster[j]) for i, j in pairs.tolist()]


@pytest.mark.parametrize("most", [0, 2, 3])
def test_a_round_on_an_accelerator_merges_what_the_cpu_merges(monkeypatch, most):
    results = []
    for there in (False, True):
        on(monkeypatch, there)
        g = cloud(300, 6)
        rates = dict.fromkeys(("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest"), 1e-3)
        density = EntropyAwareDensity(EntropyDensityConfig(merge=merging.MergeConfig(most=most)), 1.0, 0)
        density._match(g)
        density.views_seen += 1
        density.log.begin(5000)
        step = SimpleNamespace(nominal=5000.0, iteration=5000, gaussians=g)
        on(monkeypatch, False)
        optimiser = SplatAdam(g, rates)
        on(monkeypatch, there)
        found = merging.merge_gaussians(g, density.views_seen > 0, density.config.merge)
        on(monkeypatch, False)
        results.append((density.after_growth(step, g, optimiser), density, found[1]))
    (host, one, a), (device, two, b) = results
    assert one.merged == two.merged > 20 and len(host) == len(device) == 300 - one.merged
    for name, tensor_ in a.items():
        torch.testing.assert_close(getattr(b, name), tensor_, rtol=1e-5, atol=1e-6)
    assert len(two.grad_sum) == len(device)
