"""The mask policy and its state, on a scene made on the spot."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.core import Camera, Scene, SparsePoints, View
from ambiguous_wild.methods.refinesplat import masks as mask_module
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig, RefineSplatConfig
from ambiguous_wild.methods.refinesplat.identity import PsiConfig
from ambiguous_wild.methods.refinesplat.pixels import GAPS
from ambiguous_wild.methods.refinesplat.recipe import RefineSplatMask
from ambiguous_wild.splat.checkpoint import load, save
from ambiguous_wild.splat.step import Step, TrainData

HEIGHT, WIDTH, VIEWS = 72, 128, 4
PRINTED = {"lambda_id": 1.0, "lambda_cr": 0.2}  # the entropy terms are off by default
FAST = RefineSplatConfig(
    mask=MaskConfig(least=6.0),  # a blurred copy is no trained render: its normal residual is large
    psi=PsiConfig(hidden=16, steps=150, batch=512),
    min_mask_start=1,
    mask_every=2,
    **PRINTED,
)
# the paper's way: instances judged by identities on the feature grid, united with the global mask
FEATURES = dataclasses.replace(
    FAST,
    mask=MaskConfig(statistic="evidence", combine="union", threshold="kapur", static_tracks=0.35, dilation=5),
)
BOTH = pytest.mark.parametrize("config", [FAST, FEATURES], ids=["structure", "features"])


def background(shift: int) -> np.ndarray:
    """Coloured patches with texture, moved sideways from view to view as by a turning camera."""
    rng = np.random.default_rng(5)
    patches = cv2.resize(
        rng.random((5, 12, 3)).astype(np.float32), (240, HEIGHT), interpolation=cv2.INTER_NEAREST
    )
    texture = cv2.GaussianBlur(rng.random((HEIGHT, 240, 3)).astype(np.float32), (0, 0), 1.5)
    image = cv2.GaussianBlur(patches, (0, 0), 0.7) * 0.8 + 0.4 * (texture - 0.5) + 0.1
    return image[:, shift : shift + WIDTH].clip(0, 1)


def distracted(image: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The image with a plain box in a colour of its own, and where it is."""
    rng = np.random.default_rng(seed)
    y, x = rng.integers(8, HEIGHT - 34), rng.integers(8, WIDTH - 34)
    truth = np.zeros(image.shape[:2], bool)
    truth[y : y + 26, x : x + 26] = True
    out = image.copy()
    out[truth] = [0.9, 0.15, 0.75]
    return out, truth


def blurred(image: np.ndarray, seed: int) -> torch.Tensor:
    noise = np.random.default_rng(seed).normal(0, 0.02, image.shape)
    return torch.from_numpy((cv2.GaussianBlur(image, (0, 0), 1.2) + noise).clip(0, 1).astype(np.float32))


def make_data(tmp_path: Path, photos: list[np.ndarray], truths: list[np.ndarray] | None = None) -> TrainData:
    pose = np.eye(4)
    camera = Camera(WIDTH, HEIGHT, 100.0, 100.0, WIDTH / 2, HEIGHT / 2, pose)
    views = tuple(View(f"{i}.png", tmp_path / f"{i}.png", camera, "train") for i in range(VIEWS))
    rows, xy, offsets = [], [], [0]
    for x in range(60, 100, 3):  # points that every view sees, at their shifted places
        for y in range(3, HEIGHT, 4):
            for view in range(VIEWS):
                if truths is not None and truths[view][y, x - 12 * view]:
                    continue  # a point behind the distractor is not seen
                rows.append(view)
                xy.append((x - 12 * view + 0.5, y + 0.5))
            offsets.append(len(rows))
    n = len(offsets) - 1
    points = SparsePoints(
        xyz=np.random.default_rng(0).random((n, 3)),
        rgb=np.zeros((n, 3), np.uint8),
        error_px=np.zeros(n),
        track_offsets=np.array(offsets),
        track_views=np.array(rows, np.int32),
        track_xy=np.array(xy, np.float32),
    )
    scene = Scene(tmp_path, "made", views, points)
    tensors = [torch.from_numpy(p.astype(np.float32)) for p in photos]
    return TrainData(
        scene, tensors, [camera] * VIEWS, [None] * VIEWS, torch.device("cpu"), 3, tmp_path / "cache"
    )


def step_of(
    data: TrainData,
    view: int,
    image: torch.Tensor,
    iteration: int = 100,
    downsampling: int = 1,
    alpha: float = 1.0,
) -> Step:
    return Step(
        iteration=iteration,
        nominal=20.0 * iteration,
        view=view,
        downsampling=downsampling,
        growth_cap=1000,
        photo=data.photos[view],
        camera=data.cameras[view],
        rendered=SimpleNamespace(  # type: ignore[arg-type]
            image=image,
            alpha=torch.full(image.shape[:2], alpha),
            depth=torch.full(image.shape[:2], 4.0 * alpha),
        ),
        gaussians=None,  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    clean = [background(12 * v) for v in range(VIEWS)]
    photos, truths = zip(*[distracted(image, 40 + v) for v, image in enumerate(clean)])
    data = make_data(tmp_path_factory.mktemp("scene"), list(photos), list(truths))
    policy = RefineSplatMask(FAST)
    policy.setup(data)
    return SimpleNamespace(clean=clean, truths=truths, data=data, policy=policy)


def fresh(scene, config: RefineSplatConfig = FAST) -> RefineSplatMask:
    policy = RefineSplatMask(config)
    policy.setup(scene.data)
    return policy


@BOTH
def test_distractors_are_masked_and_the_rest_is_kept(scene, walled, config):
    policy = fresh(walled, config)
    for rounds in range(2):
        for view in range(VIEWS):
            keep = policy.keep(step_of(walled.data, view, blurred(scene.clean[view], view), 100 + rounds))
            assert keep.dtype == torch.float32
            assert set(np.unique(keep)) <= {0.0, 1.0}
            found = keep.numpy() < 0.5
            truth = scene.truths[view]
            assert (found & truth).sum() / truth.sum() > 0.8
            assert (found & ~cv2.dilate(truth.astype(np.uint8), np.ones((13, 13))).astype(bool)).mean() < 0.02
    facts = policy.facts()
    assert 0.05 < facts["masked_share"] < 0.3
    assert 0.0 < facts["w2"] < 1.0


@BOTH
def test_photos_without_distractors_stay_whole(tmp_path, config):
    clean = [background(12 * v) for v in range(VIEWS)]
    data = make_data(tmp_path, clean)
    policy = RefineSplatMask(config)
    policy.setup(data)
    for rounds in range(2):
        for view in range(VIEWS):
            keep = policy.keep(step_of(data, view, blurred(clean[view], 9 * rounds + view), 100))
            assert float((keep == 0).float().mean()) < 0.02


def test_nothing_before_the_warm_up_and_old_masks_during_a_pause(scene):
    policy = fresh(scene, RefineSplatConfig(psi=FAST.psi, mask_every=1, min_mask_start=300))
    good, bad = blurred(scene.clean[0], 0), torch.zeros(HEIGHT, WIDTH, 3)
    assert policy.keep(step_of(scene.data, 0, good, iteration=5)) is None
    assert policy.predict(step_of(scene.data, 0, good, iteration=5)) is None
    assert policy.cotangent(step_of(scene.data, 0, good, iteration=4), None) is None
    before = policy.keep(step_of(scene.data, 0, good, iteration=400))
    policy.on_opacity_reset(step_of(scene.data, 0, bad, iteration=401))
    assert torch.equal(policy.keep(step_of(scene.data, 0, bad, iteration=402)), before)
    after = policy.keep(step_of(scene.data, 0, bad, iteration=4000))
    assert not torch.equal(after, before)


def sparse_wall(scene) -> TrainData:
    """The scene with its points on a wall before all cameras, which stand side by side."""
    data = scene.data
    poses = [np.eye(4) for _ in data.cameras]
    for view, pose in enumerate(poses):
        pose[0, 3] = -0.48 * view  # 12 px at a depth of 4
    cameras = [dataclasses.replace(c, cam_from_world=p) for c, p in zip(data.cameras, poses)]
    x, y = np.meshgrid(np.linspace(-4, 6, 40), np.linspace(-2, 2, 16))
    points = SparsePoints(
        xyz=np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], 1),
        rgb=np.zeros((x.size, 3), np.uint8),
        error_px=np.zeros(x.size),
        track_offsets=np.zeros(x.size + 1, np.int64),
        track_views=np.zeros(0, np.int32),
        track_xy=np.zeros((0, 2), np.float32),
    )
    return dataclasses.replace(data, cameras=cameras, scene=dataclasses.replace(data.scene, points=points))


def test_the_first_look_the_ceiling_and_the_sparse_points_reach_the_masks(scene, monkeypatch):
    monkeypatch.setattr(mask_module, "WHOLE", 2.0)  # the rest of a masked instance is kept
    data = sparse_wall(scene)
    look = dataclasses.replace(FAST.first_look, least=0.0, threshold=0.1, normal=1.0, known_by=1)

    def examined(**changes):
        config = dataclasses.replace(FAST, first_look=look)
        policy = RefineSplatMask(dataclasses.replace(config, **changes))
        policy.setup(data)
        step = step_of(data, 1, blurred(scene.clean[1], 3))
        return policy, *policy.masks.examine(step, store=True)

    policy, maps, _ = examined()
    factor = policy.priors[1].factor((HEIGHT, WIDTH))
    assert factor.max() > 1.3 and factor.min() < 0.7
    _, alone, _ = examined(first_look=dataclasses.replace(look, weight=1.0))
    assert np.allclose(maps.statistic.numpy(), alone.statistic.numpy() * factor, rtol=1e-5)
    pixels = policy.masks.pixels
    assert pixels.other_views.sparse_depth[0] is not None and pixels.seen[0] is not None
    low = dataclasses.replace(FAST.mask, ceiling=1e-6, least=50.0)
    for least in (7.0, 9.0):
        _, _, masks = examined(mask=dataclasses.replace(low, ceiling_least=least))
        assert float(masks.cut.threshold) == pytest.approx(least)
    unseen = ~pixels.seen[0]
    step = step_of(data, 0, torch.zeros(HEIGHT, WIDTH, 3))  # nothing of what the photo shows
    keep = policy.masks.examine(step)[1].keep
    assert unseen.any() and (keep[unseen] == 1.0).all() and keep.min() == 0.0


@BOTH
def test_a_render_that_shows_nothing_masks_at_most_the_stated_share(scene, config):
    policy = fresh(scene, config)
    keep = policy.keep(step_of(scene.data, 1, torch.zeros(HEIGHT, WIDTH, 3)))
    assert float((keep == 0).float().mean()) <= FAST.mask.most + 1e-6


@BOTH
def test_what_is_not_learnt_yet_is_not_masked(scene, config):
    policy = fresh(scene, config)
    keep = policy.keep(step_of(scene.data, 1, torch.zeros(HEIGHT, WIDTH, 3), alpha=0.1))
    assert bool((keep == 1).all())


def test_smaller_steps_keep_a_pixel_only_if_all_it_covers_is_kept(scene):
    policy = fresh(scene)
    image = blurred(scene.clean[2], 2)
    full = policy.keep(step_of(scene.data, 2, image)).numpy()
    half = policy.keep(step_of(scene.data, 2, image, 101, downsampling=2)).numpy()
    assert half.shape == (HEIGHT // 2, WIDTH // 2)
    assert np.array_equal(half, full.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).min(axis=(1, 3)))
    small = torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], scale_factor=0.5, mode="area")[0]
    predicted = policy.predict(step_of(scene.data, 2, small.permute(1, 2, 0), 102, downsampling=2))
    assert predicted.shape == (HEIGHT // 2, WIDTH // 2)


@BOTH
def test_predict_changes_nothing(scene, config):
    policy = fresh(scene, config)
    image = blurred(scene.clean[0], 0)
    policy.keep(step_of(scene.data, 0, image))
    before = to_bytes(policy)
    policy.predict(step_of(scene.data, 1, blurred(scene.clean[1], 1)))
    assert to_bytes(policy) == before


def plain(value):
    if isinstance(value, torch.Tensor):
        return str(value.dtype), value.tolist()
    if isinstance(value, dict):
        return {key: plain(v) for key, v in sorted(value.items())}
    return value


def to_bytes(policy: RefineSplatMask) -> str:
    return repr(plain(policy.state_dict()))


@BOTH
def test_a_resumed_policy_goes_on_with_the_same_bits(scene, tmp_path, config):
    def walk(policy: RefineSplatMask, begin: int, end: int) -> list[torch.Tensor]:
        out = []
        for i in range(begin, end):
            view = i % VIEWS
            step = step_of(scene.data, view, blurred(scene.clean[view], i), 100 + 4 * i)
            keep = policy.keep(step)
            out += [keep, policy.cotangent(step, keep)]
        return out

    straight = walk(fresh(scene, config), 0, 16)
    first = fresh(scene, config)
    begun = walk(first, 0, 7)
    save(tmp_path / "state.safetensors", first.state_dict())
    second = fresh(scene, config)
    second.load_state_dict(load(tmp_path / "state.safetensors"))
    for a, b in zip(straight, begun + walk(second, 7, 16)):
        assert torch.equal(a, b)


def test_identities_are_not_made_where_nothing_reads_them(scene):
    policy = fresh(scene, RefineSplatConfig(min_mask_start=1))
    policy.keep(step_of(scene.data, 0, blurred(scene.clean[0], 0)))
    assert not policy.inputs.has_semantics
    assert policy.facts()["identities"] is None
    # a picture asks for the entropy map in the middle of a run
    maps = policy.compare(step_of(scene.data, 0, blurred(scene.clean[0], 0)))
    assert 0.0 <= maps.entropy.min() <= maps.entropy.max() <= 1.0


def test_identities_scale_the_evidence_of_pixels(scene):
    config = RefineSplatConfig(psi=FAST.psi, min_mask_start=1, mask=MaskConfig(entropy_weight=0.5))
    plain, scaled = fresh(scene, RefineSplatConfig(min_mask_start=1)), fresh(scene, config)
    step = step_of(scene.data, 0, blurred(scene.clean[0], 0))
    ratio = (
        scaled.masks.examine(step)[0].statistic / plain.masks.examine(step)[0].statistic.clamp(min=1e-6)
    ).numpy()
    truth = cv2.erode(scene.truths[0].astype(np.uint8), np.ones((9, 9))).astype(bool)
    assert ratio.min() > 0.49
    assert ratio.max() < 1.51
    assert np.median(ratio[truth]) > 1.0 > np.median(ratio[~scene.truths[0]])


def test_ids_of_a_whole_scene_are_identities(scene):
    class Follower:
        name = "follower"

        def labels(self, photo):
            raise AssertionError("one photo alone has no ids")

        def identities(self, photos, names, folder=None, bar=None):
            maps = [np.zeros((HEIGHT, WIDTH), np.int32) for _ in photos]
            for view, label in enumerate(maps):
                label[:, :40], label[:, 60:90] = 7, 30 + (view == 0)
            return maps

    policy = RefineSplatMask(FAST, instances=Follower())
    policy.setup(scene.data)
    found = policy.inputs.semantics.association
    assert found.count == 3
    assert found.photos_of.tolist() == [4, 3, 1]  # 7 in all photos, 30 in three, 31 in one
    assert [ids.tolist() for ids in found.of_instance] == [[0, 1, 3], [0, 1, 2], [0, 1, 2], [0, 1, 2]]


def test_cotangent_equals_finite_differences_in_float64(scene):
    policy = fresh(scene, RefineSplatConfig(psi=FAST.psi, min_mask_start=1, entropy_every=1, **PRINTED))
    image = blurred(scene.clean[0], 0).double() * 0.9 + 0.05
    psi = policy.inputs.semantics.psi
    psi.double()
    keep = torch.ones(HEIGHT, WIDTH, dtype=torch.float64)
    keep[:20] = 0.0
    step = step_of(scene.data, 0, image)
    gradient = policy.cotangent(step, keep)
    assert gradient.shape == image.shape
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        direction = torch.randn(image.shape, generator=generator).double()
        h = 1e-7
        with torch.no_grad():
            up = policy._entropy_terms(image + h * direction, step, keep)
            down = policy._entropy_terms(image - h * direction, step, keep)
        assert float((gradient * direction).sum()) == pytest.approx(
            float(up - down) / (2 * h), rel=5e-3, abs=1e-6
        )
    psi.float()


def test_cotangent_comes_every_kth_iteration_and_weighs_k_times(scene):
    every = {}
    for k in (1, 3):
        policy = fresh(scene, RefineSplatConfig(psi=FAST.psi, min_mask_start=1, entropy_every=k, **PRINTED))
        step = step_of(scene.data, 0, blurred(scene.clean[0], 0), iteration=102)
        every[k] = policy.cotangent(step, None)
        off = policy.cotangent(step_of(scene.data, 0, blurred(scene.clean[0], 0), iteration=103), None)
        assert (off is None) == (k == 3)
    assert torch.allclose(every[3], 3 * every[1])


def test_features_that_learn_from_the_scene_are_given_its_tracks(scene):
    config = dataclasses.replace(FEATURES, features="sceneconv,steps=4", lambda_id=0.0, lambda_cr=0.0)
    policy = RefineSplatMask(config)
    policy.setup(scene.data)
    found = policy.inputs.semantics
    assert found.phi[0].shape == (HEIGHT // 4, WIDTH // 4, policy.features.channels)
    assert policy.keep(step_of(scene.data, 0, blurred(scene.clean[0], 0))) is not None


# -- limits of a mask -----------------------------------------------------------------------------


@pytest.fixture
def walled(scene):
    """The scene with points that every photo's first look can be told by."""
    return SimpleNamespace(data=sparse_wall(scene))


def test_a_mask_is_limited_by_the_photos_first_look(walled):
    mask, shares = dataclasses.replace(FAST.mask, ceiling_least=0.0), []
    for limit in (0.0, 1.0):
        look = dataclasses.replace(FAST.first_look, most=limit, most_least=0.01)
        policy = fresh(walled, dataclasses.replace(FAST, mask=mask, first_look=look))
        shares.append(
            (policy.keep(step_of(walled.data, 1, torch.zeros(HEIGHT, WIDTH, 3))) == 0).float().mean()
        )
    assert shares[1] <= GAPS * policy.priors[1].most < shares[0], shares


def test_in_a_crowd_nothing_is_masked_that_the_first_look_keeps(walled, monkeypatch):
    monkeypatch.setattr(mask_module, "WHOLE", 2.0)
    mask, outside = dataclasses.replace(FAST.mask, ceiling_least=0.0), []
    for crowd in (0.0, 1.0):  # the share from which there is one
        look = dataclasses.replace(FAST.first_look, crowd=crowd, least=0.0, most=0.0)
        policy = fresh(walled, dataclasses.replace(FAST, mask=mask, first_look=look))
        masked = policy.keep(step_of(walled.data, 1, torch.zeros(HEIGHT, WIDTH, 3))) == 0
        assert masked.any()
        outside.append(bool((masked & (policy.first[1] > 0.5)).any()))
    assert outside == [False, True]
