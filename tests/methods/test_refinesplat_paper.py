"""`refinesplat-paper` and `refinesplat-printed`: the paper's parts, against a second way of writing them."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core.config import flatten, from_plain, to_plain, with_options
from ambiguous_wild.methods import get_method
from ambiguous_wild.methods.refinesplat.hyperparameters import RefineSplatConfig
from ambiguous_wild.methods.refinesplat.identity import PsiConfig
from ambiguous_wild.methods.refinesplat.inputs import untracked_instances
from ambiguous_wild.methods.refinesplat.paper import PaperConfig, PrintedConfig
from ambiguous_wild.methods.refinesplat.recipe import (
    RefineSplatMask,
    build,
    consistency_loss,
    identity_loss,
    instance_matrix,
)
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.vision import backends
from tests.methods.test_refinesplat_policy import (
    HEIGHT,
    VIEWS,
    WIDTH,
    background,
    blurred,
    distracted,
    fresh,
    make_data,
    step_of,
)

PSI = PsiConfig(hidden=16, steps=100, batch=512)
PAPER = PaperConfig(
    features="labhog", instances="graph", psi=PSI, min_mask_start=1, mask_every=1, entropy_every=1
)
PRINTED = PrintedConfig(features="labhog", instances="graph", psi=PSI, min_mask_start=1)
BOTH = pytest.mark.parametrize("config", [PAPER, PRINTED], ids=["paper", "printed"])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    clean = [background(12 * v) for v in range(VIEWS)]
    photos, truths = zip(*[distracted(image, 40 + v) for v, image in enumerate(clean)])
    return SimpleNamespace(
        clean=clean, data=make_data(tmp_path_factory.mktemp("scene"), list(photos), list(truths))
    )


def cells_of(grid: np.ndarray) -> np.ndarray:
    """[H, W]: the cell that each pixel lies in, by a loop."""
    h, w = grid.shape
    return np.array([[grid[y * h // HEIGHT, x * w // WIDTH] for x in range(WIDTH)] for y in range(HEIGHT)])


def by_the_formulas(policy: RefineSplatMask, view: int, image: torch.Tensor, w2: float, printed: bool):
    """M_local, M_global and M_final [H, W] bool, equation by equation, with loops."""
    found = policy.inputs.semantics
    phi = policy.features(image)
    e = found.psi(phi).double().numpy()
    sigma = 1.0 / (1.0 + np.exp(-e))
    h = -(sigma * np.log(sigma)).sum(2) * math.e / sigma.shape[2]  # Eq. 3, over its largest value
    pixels, labels = cells_of(h), policy.inputs.labels[view]
    mean = {j: pixels[labels == j].mean() for j in np.unique(labels[labels > 0])}
    values = np.array(sorted(mean.values()))

    def ent(x: np.ndarray) -> float:
        x = x if printed else x / x.sum()
        return float(-(x * np.log(x)).sum())

    best, t_ent = -math.inf, math.inf  # Eq. 4
    for t in values if printed else values[1:]:
        score = (1 - w2) * ent(values[values >= t]) + w2 * ent(values[values < t])
        if score > best + 1e-12:
            # Kapur's subsets are divided between two values, the printed mask is above t itself
            best, t_ent = score, t if printed else (t + values[values < t].max()) / 2
    local = np.isin(labels, [j for j, value in mean.items() if value > t_ent])  # Eq. 5
    a, b = found.phi[view].double().numpy(), phi.double().numpy()
    cosine = (a * b).sum(2) / np.linalg.norm(a, axis=2) / np.linalg.norm(b, axis=2)
    u = 2.0 / (np.clip(cosine, -0.999, 1.0) + 1.0)  # Eq. 6
    r = u / (h + 1e-6) if printed else u / np.maximum(h, h.mean() / 10)
    edge = np.pad(r, 1, mode="edge")
    smooth = sum(edge[i : i + r.shape[0], j : j + r.shape[1]] for i in range(3) for j in range(3)) / 9
    global_ = cells_of(smooth > r.mean() + (r.var() if printed else r.std()))
    final = local | global_  # Eq. 7
    grown = np.pad(final, 2)
    final = np.any([grown[i : i + HEIGHT, j : j + WIDTH] for i in range(5) for j in range(5)], axis=0)
    return local, global_, final


@BOTH
@pytest.mark.parametrize("w2", [0.3, 0.8])
def test_masks_equal_the_formulas(scene, config, w2):
    config = dataclasses.replace(config, mask=dataclasses.replace(config.mask, w2=w2, most=1.0))
    policy = fresh(scene, config)
    image = blurred(scene.clean[1], 1)
    local, global_, final = by_the_formulas(policy, 1, image, w2, isinstance(config, PrintedConfig))
    _, masks = policy.masks.examine(step_of(scene.data, 1, image))
    assert np.array_equal(masks.local, local)
    assert np.array_equal(masks.global_, global_)
    assert np.array_equal(masks.keep < 0.5, final)


def test_printed_masks_everything_but_one_instance_or_no_instance(scene):
    policy = fresh(scene, PRINTED)
    _, first = policy.masks.examine(step_of(scene.data, 0, blurred(scene.clean[0], 0)))
    flagged = np.unique(policy.inputs.labels[0][first.local])
    assert len(flagged) == policy.inputs.counts[0] - 1  # w2 starts at 1/2: the first of equal objectives
    high = dataclasses.replace(PRINTED, mask=dataclasses.replace(PRINTED.mask, w2=0.6))
    _, last = fresh(scene, high).masks.examine(step_of(scene.data, 0, blurred(scene.clean[0], 0)))
    assert not last.local.any()


@BOTH
def test_the_entropy_terms_weigh_cells_as_they_are_defined(scene, config):
    policy = fresh(scene, config)
    image = blurred(scene.clean[0], 0)
    step = step_of(scene.data, 0, image)
    keep = torch.ones(HEIGHT, WIDTH)
    keep[:, : WIDTH // 2] = 0.0
    found = policy.inputs.semantics
    logits = found.psi(policy.features(image))
    h, w, channels = logits.shape
    kept = torch.ones(h, w)
    kept[:, : w // 2] = 0.0
    id_weights = kept if config.weigh_id else torch.ones(h, w)
    flat = logits.reshape(-1, channels)
    expected = identity_loss(flat, found.identities[0].reshape(-1), id_weights.reshape(-1))
    member = instance_matrix(found.grid[0].reshape(-1), policy.inputs.counts[0])
    expected = expected + 0.2 * consistency_loss(flat, member)
    assert float(policy._entropy_terms(image, step, keep)) == pytest.approx(float(expected), rel=1e-6)
    assert isinstance(config, PrintedConfig) == (not config.weigh_id)
    assert not config.weigh_cr


def test_the_entropy_terms_are_no_longer_than_their_limit(scene):
    """By hand: the same direction, at most the limit times the gradient of L_GS under the same keep map."""
    step = step_of(scene.data, 0, blurred(scene.clean[0], 0), iteration=102)
    keep = torch.ones(HEIGHT, WIDTH)
    keep[:, : WIDTH // 2] = 0.0
    config = dataclasses.replace(PAPER, entropy_every=3)
    free = fresh(scene, dataclasses.replace(config, entropy_limit=0.0)).cotangent(step, keep)
    length = float(photometric(step.rendered.image, step.photo, keep).d_image.norm())
    assert float(free.norm()) / 3 > 0.1 * length  # the limit below does something
    short = fresh(scene, dataclasses.replace(config, entropy_limit=0.1)).cotangent(step, keep)
    assert float(short.norm()) / 3 == pytest.approx(0.1 * length, rel=1e-5)
    assert torch.allclose(short / short.norm(), free / free.norm(), atol=1e-6)
    wide = fresh(scene, dataclasses.replace(config, entropy_limit=1e9)).cotangent(step, keep)
    assert torch.equal(wide, free)  # never lengthened


def test_unweighted_losses_leave_out_what_the_capture_masks(scene):
    own = torch.ones(HEIGHT, WIDTH)
    own[:, : WIDTH // 2] = 0.0
    data = dataclasses.replace(scene.data, user_keep=[own] * VIEWS)
    policy = fresh(SimpleNamespace(data=data), PRINTED)
    step = step_of(data, 0, blurred(scene.clean[0], 0))
    gradient = policy.cotangent(step, torch.zeros(HEIGHT, WIDTH))
    assert float(gradient[:, WIDTH // 2 + 8 :].abs().sum()) > 0
    assert float(gradient[:, : WIDTH // 2 - 12].abs().sum()) == 0


def test_the_printed_factor_trains_on_what_is_masked(scene):
    mask = dataclasses.replace(PAPER.mask, w2=0.5)
    step = step_of(scene.data, 0, blurred(scene.clean[0], 0))
    keep = fresh(scene, dataclasses.replace(PAPER, mask=mask)).keep(step)
    other = fresh(scene, dataclasses.replace(PAPER, mask=mask, factor="transient")).keep(step)
    assert 0.0 < float(keep.mean()) < 1.0
    assert torch.equal(keep + other, torch.ones(HEIGHT, WIDTH))


def test_options_reach_the_trainer(scene):
    parts = build(PRINTED)
    assert parts.schedule.lr_opacity == 0.025 and parts.weighting == "map" and parts.effects == ()
    assert build(PAPER).schedule.lr_opacity == build(RefineSplatConfig()).schedule.lr_opacity == 0.05
    parts = build(dataclasses.replace(PAPER, ssim="images", appearance=True))
    assert parts.weighting == "images"
    (effect,) = parts.effects
    leaves = effect.leaves(scene.data, np.random.default_rng(0))
    shapes = {name: tuple(leaf.values.shape) for name, leaf in leaves.items()}
    assert shapes["photo"] == (VIEWS, 32)  # the printed size of an embedding
    hidden = [shape for name, shape in shapes.items() if name != "photo" and 128 in shape and len(shape) == 2]
    assert sorted(hidden) == [(3 + 24 + 32, 128), (128, 6), (128, 128)]  # two layers of 128


def test_ssim_by_map_and_by_images_differ_next_to_a_mask():
    """By hand: weighing the map counts the window's masked neighbours, weighing the pictures does not."""
    photo = torch.full((24, 24, 3), 0.5)
    render = photo.clone()
    render[:, :12] = 1.0  # wrong where it is masked
    keep = torch.ones(24, 24)
    keep[:, :12] = 0.0
    by_map = photometric(render, photo, keep, lambda_dssim=1.0, weighting="map")
    by_images = photometric(render, photo, keep, lambda_dssim=1.0, weighting="images")
    assert float(by_images.dssim) == pytest.approx(0.0, abs=1e-6) and float(by_map.dssim) > 0.01


def test_the_papers_parts_are_on_and_ours_are_off():
    plain, own, printed = RefineSplatConfig(), PaperConfig(), PrintedConfig()
    assert (plain.lambda_id, plain.lambda_cr, plain.mask.statistic) == (0.0, 0.0, "structure")
    for config in (own, printed):
        assert (config.lambda_id, config.lambda_cr) == (1.0, 0.2)
        assert (config.mask.statistic, config.mask.combine, config.mask.box) == ("entropy", "union", 3)
        assert config.mask.w2 is None and config.mask.dilation == 5 and config.mask.use_local
        assert config.density.decides == "total" and config.density.merge_every > 0
        assert not config.first_look.on and config.density.support.least_share == 0
    assert (own.entropy_limit, printed.entropy_limit) == (0.1, 0.0)
    assert (own.mask.threshold, own.mask.spread, own.density.merge.form) == ("kapur", "std", "normalised")
    assert (printed.mask.threshold, printed.mask.spread, printed.density.merge.form) == (
        "literal", "var", "literal",
    )  # fmt: skip
    assert (printed.mask.most, printed.mask_every, printed.entropy_every) == (1.0, 1, 1)
    for config in (own, printed):
        assert from_plain(type(config), to_plain(config)) == config
    other = with_options(
        get_method("refinesplat-paper").options(), {"features": "sceneconv", "mask.most": "1"}
    )
    assert other.features == "sceneconv" and other.mask.threshold == "kapur"


def test_what_is_not_stated_is_as_in_refinesplat():
    """-paper and -printed differ in nothing that docs/fidelity.md does not list."""
    plain, own, printed = (
        flatten(to_plain(c)) for c in (RefineSplatConfig(), PaperConfig(), PrintedConfig())
    )
    assert plain.keys() == own.keys() == printed.keys()
    page = (Path(__file__).parents[2] / "docs" / "fidelity.md").read_text()
    for key in plain:
        if not plain[key] == own[key] == printed[key]:
            assert f"`{key}`" in page, f"{key} differs and docs/fidelity.md does not say so"


def test_the_papers_networks_are_the_default_where_their_weights_are(tmp_path, monkeypatch):
    monkeypatch.setenv("AW_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda name: object())
    found = [(PaperConfig().features, PaperConfig().instances)]
    for name in ("efficientnet-lite0", "dinov2-small", "sam2.1-hiera-tiny"):
        (tmp_path / name).mkdir()
        for file in ("efficientnet-lite0.safetensors", "config.json", "model.safetensors"):
            (tmp_path / name / file).write_bytes(b"{}")
        found.append((PaperConfig().features, PaperConfig().instances))
    lite = "efficientnet-lite0"
    assert found == [("labhog", "graph"), (lite, lite), ("dinov2-small", lite), ("dinov2-small", "sam2")]
    assert PrintedConfig().features == "dinov2-small@504"
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda name: None)  # no transformers
    assert (PaperConfig().features, PaperConfig().instances) == (lite, lite)


# -- instances beyond those that a tracker follows ----------------------------------------------------


def test_what_a_tracker_leaves_out_has_labels_above_its_own():
    tracked = np.zeros((4, 8), np.int32)
    tracked[:, :4] = 1
    found = np.zeros((4, 8), np.int32)
    found[:, :3], found[:, 3:5], found[:2, 6:], found[2:, 6:] = 4, 1, 2, 3
    added = untracked_instances(tracked, found)
    # 4 is known, half of 1 is covered (known), 2 and 3 are new
    assert not added[:, :6].any()
    assert sorted(np.unique(added[:, 6:])) == [2, 3]
    assert len(np.unique(added[:2, 6:])) == 1


class Tracker:
    """Follows the left third of every photo as object 9; by themselves photos have three instances."""

    name = "tracker"

    class _Single:
        name = "thirds"

        def labels(self, photo):
            return np.repeat(np.array([[1, 2, 3]], np.int32), 40, 1).repeat(HEIGHT, 0)[:, :WIDTH].copy()

    def __init__(self):
        self.single = self._Single()

    def labels(self, photo):
        return self.single.labels(photo)

    def identities(self, photos, names, folder=None, bar=None):
        maps = [np.zeros(tuple(p.shape[:2]), np.int32) for p in photos]
        for label in maps:
            label[:, :40] = 9
        return maps


@pytest.mark.parametrize(("mode", "instances"), [("drop", 1), ("add", 3)])
def test_instances_that_are_not_tracked_are_judged_and_associated(scene, mode, instances):
    config = dataclasses.replace(PAPER, untracked=mode)
    policy = RefineSplatMask(config, instances=Tracker())
    data = dataclasses.replace(scene.data, photos=[p[:, :120] for p in scene.data.photos])
    policy.setup(data)
    assert policy.inputs.counts == [instances] * VIEWS
    found = policy.inputs.semantics.association
    assert all(row[1] == 1 for row in found.of_instance)  # the tracked object is the first identity
    assert all(len(row) == instances + 1 for row in found.of_instance)
    if mode == "add":
        rest = [set(row[2:].tolist()) for row in found.of_instance]
        assert all(ids and 1 not in ids and 0 not in ids for ids in rest)
        assert found.count >= 3 and len(found.photos_of) == found.count
