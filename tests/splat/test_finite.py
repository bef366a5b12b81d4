"""Any value that is not finite is found wherever it lies; nothing else is taken for one."""

import math

import pytest
import torch

from ambiguous_wild.splat.cpu.finite import all_finite


@pytest.mark.parametrize("value", [math.nan, -math.nan, math.inf, -math.inf, 3.4e38, -1e-45, -0.0])
@pytest.mark.parametrize("at", [0, 17, 2999])
def test_one_value_among_many(value, at):
    sound, tensor = torch.randn(7), torch.randn(1000, 3)
    tensor.view(-1)[at] = value
    assert all_finite([sound, tensor]) == math.isfinite(value)
    assert all_finite([tensor, sound]) == math.isfinite(value)


def test_many_large_values_are_sound():
    assert all_finite([torch.full((100,), 3e38)])  # their sum overflows


def test_nothing_is_finite():
    assert all_finite([torch.zeros(0, 3), torch.zeros(2)])
