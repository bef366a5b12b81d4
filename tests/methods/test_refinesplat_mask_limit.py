"""Later masks cover no more of a photo than its first look allows, in a crowd no other pixels."""

import dataclasses

import pytest
import torch

from ambiguous_wild.methods.refinesplat.pixels import GAPS
from tests.methods.on_device import capture
from tests.methods.test_refinesplat_policy import FAST, HEIGHT, WIDTH, fresh, step_of


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return capture(tmp_path_factory.mktemp("limit"))


def test_a_mask_is_limited_by_the_photos_first_look(scene):
    mask, shares = dataclasses.replace(FAST.mask, ceiling_least=0.0), []
    for limit in (0.0, 1.0):
        look = dataclasses.replace(FAST.first_look, most=limit, most_least=0.01)
        policy = fresh(scene, dataclasses.replace(FAST, mask=mask, first_look=look))
        shares.append(
            (policy.keep(step_of(scene.data, 1, torch.zeros(HEIGHT, WIDTH, 3))) == 0).float().mean()
        )
    assert shares[1] <= GAPS * policy.looks[1].most < shares[0], shares


def test_in_a_crowd_nothing_is_masked_that_the_first_look_keeps(scene):
    mask, outside = dataclasses.replace(FAST.mask, ceiling_least=0.0), []
    for crowd in (0.0, 1.0):  # the share from which there is one
        look = dataclasses.replace(FAST.first_look, crowd=crowd, least=0.0, most=0.0)
        policy = fresh(scene, dataclasses.replace(FAST, mask=mask, first_look=look))
        masked = policy.keep(step_of(scene.data, 1, torch.zeros(HEIGHT, WIDTH, 3))) == 0
        assert masked.any()
        outside.append(bool((masked & (policy.first[1] > 0.5)).any()))
    assert outside == [False, True]
