"""AsymGS: the slow average, the two masks by hand, and what they do in a run."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.methods.asymgs import (
    AlternatingMask,
    AsymGsConfig,
    EmaDensity,
    ParameterEma,
    ema_attribute,
    ema_gaussians,
)
from ambiguous_wild.vision.mask_ops import drop_static_instances, keep_from_suspects
from tests.methods.baselines import data_of, parts_of, step_of, trained, trainer_of
from tests.splat.scenes import gaussians


@pytest.fixture(scope="module")
def seen(scene, tmp_path_factory):
    """The training side, and a mask policy that was shown it."""
    data = data_of(scene, tmp_path_factory.mktemp("cache"))
    mask = AlternatingMask(AsymGsConfig())
    mask.setup(data)
    return data, mask


def averaged(g):
    effect = ParameterEma(0.8)
    return effect, g.with_attributes({name: row.values for name, row in effect.rows(g).items()})


def test_the_average_by_hand():
    effect, g = averaged(gaussians(n=4, rest=3))
    first = g.means.clone()
    g.means += 1.0
    effect.after_step(None, g)
    assert torch.allclose(g.attributes[ema_attribute("means")], first + 0.2)
    effect.after_step(None, g)
    assert torch.allclose(g.attributes[ema_attribute("means")], first + 0.36)
    teacher = ema_gaussians(g)
    assert torch.equal(teacher.means, g.attributes["slow_means"]) and torch.equal(teacher.sh_rest, g.sh_rest)
    assert ema_gaussians(gaussians(n=4)) is None


def test_a_child_of_a_split_averages_from_where_it_lies():
    _, g = averaged(gaussians(n=4, rest=3))
    g.attributes[ema_attribute("quats")][:] = 7.0
    child = EmaDensity(AsymGsConfig().density, 1.0, 0)._split_half(g.select(torch.arange(4)))
    assert not torch.equal(child.means, g.means)
    assert torch.equal(child.attributes[ema_attribute("means")], child.means)
    assert torch.equal(child.attributes[ema_attribute("log_scales")], child.log_scales)
    assert torch.equal(child.attributes[ema_attribute("quats")], torch.full((4, 4), 7.0))


def test_instances_more_suspect_than_the_photo_go_by_hand():
    labels = torch.tensor([[0, 0, 1, 1], [2, 2, 1, 1], [2, 2, 3, 3]])
    suspect = torch.zeros(3, 4, dtype=torch.bool)
    suspect[0, 0] = suspect[0, 2] = suspect[0, 3] = suspect[2, 2] = True
    suspect[1, 0] = True  # shares: photo 5/12, label 1 2/4, label 2 1/4, label 3 1/2
    assert keep_from_suspects(labels, suspect).tolist() == [[1, 1, 0, 0], [1, 1, 0, 0], [1, 1, 0, 0]]


def test_instances_with_points_are_static():
    labels = np.array([[1, 1, 2, 2], [1, 1, 2, 2], [0, 0, 3, 3]])
    points = SimpleNamespace(
        track_offsets=np.array([0, 3, 6, 8]),
        track_views=np.array([0, 1, 1, 0, 1, 1, 1, 0]),
        track_xy=np.array(
            [[9, 9], [0.4, 0.6], [1.2, 1.9], [9, 9], [0.9, 0.1], [1.5, 0.5], [3.5, 2.5], [9, 9]], np.float32
        ),
    )
    scene = SimpleNamespace(points=points, views=[SimpleNamespace(name="a"), SimpleNamespace(name="b")])
    # four points in label 1; the one in label 3 has two observations and is not counted
    assert drop_static_instances(labels, scene, "b", 0.1).tolist() == [
        [0, 0, 2, 2],
        [0, 0, 2, 2],
        [0, 0, 3, 3],
    ]
    assert drop_static_instances(labels, scene, "b", 0.1, least_track=2).tolist() == [
        [0, 0, 2, 2],
        [0, 0, 2, 2],
        [0] * 4,
    ]
    # density of label 1 is three times that of the photo
    assert drop_static_instances(labels, scene, "b", 3.5)[0, 0] == 1


def test_the_soft_mask_starts_open_and_closes_where_features_differ(seen):
    data, mask = seen
    image = data.photos[0].clone()
    image[:, :32] = 0.5
    step = step_of(data, 0, image, iteration=1)
    before = mask.predict(step)
    assert before.flatten().tolist() == pytest.approx([1 / (1 + np.exp(-8))] * before.numel())
    for k in range(1, 60):
        kept = mask.keep(step_of(data, 0, image, iteration=2 * k + 1))
    distance = mask._distance(0, image)
    apart = (distance - distance.min()) / (distance.max() - distance.min())
    after = mask.predict(step)
    assert float((kept - after).abs().max()) < 0.5  # the map of before the last update
    assert float((after - (1 - apart)).abs().mean()) < 0.1
    assert float(after[apart > 0.5].mean()) < 0.5 < 0.9 < float(after[apart < 0.05].mean())


def test_soft_masks_do_not_learn_in_the_warm_up(seen):
    data, mask = seen
    before = mask.soft[1].values.clone()
    mask.keep(step_of(data, 1, torch.zeros_like(data.photos[1]), iteration=3, nominal=900.0))
    assert torch.equal(mask.soft[1].values, before)


def test_the_hard_mask_takes_a_segment_that_both_cues_suspect(seen):
    data, mask = seen
    clean = data.photos[2].clone()
    square = (slice(14, 26), slice(22, 34))  # where the photo has its red square
    clean[square] = data.photos[2][12, 22:34].mean(dim=0)
    keep = mask.keep(step_of(data, 2, clean, iteration=2))
    assert float(keep[square].mean()) < 0.4 < 0.8 < float(keep.mean())


def test_the_consistency_pulls_to_the_average(seen):
    data, mask = seen
    _, g = averaged(gaussians(n=4, rest=3))
    picture = torch.full_like(data.photos[0], 0.5)
    teacher = picture.clone()
    teacher[:, :32] += 0.1
    given = vars(step_of(data, 0, picture)) | {"gaussians": g}
    step = SimpleNamespace(**given, draw=lambda gaussians: SimpleNamespace(image=teacher))
    found = mask.cotangent(step, None)
    each = 0.1 / picture.numel()
    assert found.image[:, :32].unique().tolist() == pytest.approx([-each])
    assert found.image[:, 32:].unique().tolist() == [0.0]
    assert mask.cotangent(SimpleNamespace(**given | {"nominal": 500.0}), None) is None


def make():
    return parts_of(
        "asymgs", **{"density.every": "2000", "density.min_every": "10", "density.grow_scale": "0.001"}
    )


def test_growth_carries_the_average(scene, tmp_path):
    trainer = trained(scene, tmp_path, make())
    g = trainer.gaussians
    assert sum(r.split for r in trainer.density.log.rounds) > 0
    assert all(len(tensor) == len(g) for tensor in g.attributes.values())
    gap = (g.attributes[ema_attribute("means")] - g.means).norm(dim=1)
    assert 0 < float(gap.median()) < 0.01 * trainer.data.scene.extent


def test_the_average_is_not_that_of_postponed_harmonics(scene, tmp_path):
    """It equals the recursion over harmonics that were read after every step."""
    trainer = trainer_of(scene, tmp_path, parts_of("asymgs"))
    want = trainer.gaussians.sh_rest.clone()
    for _ in range(30):
        before = len(trainer.gaussians)
        trainer.step()
        if len(trainer.gaussians) != before:
            break
        trainer.optimiser.flush()
        want.lerp_(trainer.gaussians.sh_rest, 0.2)
        assert torch.equal(trainer.gaussians.attributes[ema_attribute("sh_rest")], want)
