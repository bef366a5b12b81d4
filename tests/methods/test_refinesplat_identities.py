"""Identities: which instances are one thing, who vouches for them, and what psi learns."""

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.methods.refinesplat.identity import PsiConfig, associate, train_psi
from ambiguous_wild.methods.refinesplat.inputs import static_instances


def test_tracks_join_instances_and_one_photo_keeps_them_apart():
    labels = np.repeat(np.repeat(np.array([[1, 2], [3, 4]], np.int32), 10, 0), 10, 1)
    other = np.array([0, 4, 1, 2, 3], np.int32)[labels]  # the same quadrants under other names
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 20, (200, 2))
    point = np.tile(np.arange(200), 2)
    photo = np.repeat([0, 1], 200)
    zeros = [np.zeros((4, 2))] * 2
    found = associate([labels, other], zeros, (point, photo, np.concatenate([xy, xy])))
    assert found.count == 4
    assert np.array_equal(found.of_instance[0][labels], found.of_instance[1][other])
    assert (found.photos_of == 2).all()
    for ids in found.of_instance:
        assert len(set(ids[1:])) == 4


def test_features_join_what_no_track_does_and_the_number_is_bounded():
    labels = [
        np.array([[1, 2, 2]], np.int32),
        np.array([[2, 1, 0]], np.int32),
        np.array([[-1, 5, 0]], np.int32),
    ]
    a, b = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    means = [np.stack([a, b]), np.stack([b, a]), np.stack([a * 0, a * 0, a * 0, a * 0, a])]
    nothing = (np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros((0, 2)))
    found = associate(labels, means, nothing)
    assert found.of_instance[0][1] == found.of_instance[1][2] == found.of_instance[2][5] == 1
    assert found.of_instance[0][2] == found.of_instance[1][1] == 2
    assert found.count == 2
    assert associate(labels, means, nothing, most=1).count == 1
    empty = associate([np.zeros((2, 2), np.int32)], [np.zeros((0, 2))], nothing)
    assert empty.count == 0


def test_sfm_vouches_for_what_it_saw_often():
    labels = [np.repeat(np.array([[1, 2]], np.int32), 10, axis=1).repeat(10, axis=0)]
    rng = np.random.default_rng(0)
    left = np.stack([rng.uniform(0, 10, 190), rng.uniform(0, 10, 190)], 1)
    right = left[:6] + np.array([10.0, 0.0])  # a few wrong matches
    xy = np.concatenate([left, right])
    point = np.arange(len(xy))
    # each point is seen in three views, of which only photo 0 is asked about
    tracks = (np.tile(point, 3), np.repeat([0, 1, 2], len(xy)), np.tile(xy, (3, 1)))
    blank = [np.zeros((10, 20), np.int32)] * 2
    found = static_instances(labels + blank, [2, 0, 0], tracks, share=0.35)
    assert found[0].tolist() == [True, False]
    assert not static_instances(labels, [2], tracks, share=0.0)[0].any()
    pairs = (np.tile(point, 2), np.repeat([0, 1], len(xy)), np.tile(xy, (2, 1)))
    assert not static_instances(labels, [2], pairs, share=0.35)[0].any()  # two views are no evidence


def test_psi_learns_and_repeats():
    generator = torch.Generator().manual_seed(0)
    ids = torch.randint(0, 4, (800,), generator=generator)
    features = torch.nn.functional.one_hot(ids, 4) + 0.1 * torch.randn(800, 4, generator=generator)
    for variant in ("sigmoid", "softmax"):
        config = PsiConfig(hidden=16, steps=200, batch=256)
        psi = train_psi(features, ids, 3, config, variant, 1)
        again = train_psi(features, ids, 3, config, variant, 1)
        assert torch.equal(psi(features), again(features))
        some = ids > 0
        assert float((psi(features)[some].argmax(1) + 1 == ids[some]).float().mean()) > 0.97
        assert not any(p.requires_grad for p in psi.parameters())
    with pytest.raises(AwError, match="identities"):
        train_psi(features, torch.zeros(800, dtype=torch.long), 3, PsiConfig(), "sigmoid", 1)
