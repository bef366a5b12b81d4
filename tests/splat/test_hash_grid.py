"""The hash encoding: kernel, torch and a third implementation written out here."""

import numpy as np
import pytest
import torch

from ambiguous_wild.methods.swag import hash_encoding, hash_encoding_torch
from ambiguous_wild.splat.cpu.compile import one_thread


def random(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def test_the_hash_encoding_by_a_second_implementation():
    grid, unit = random(3, 64, 2), random(7, 3, seed=1)
    found = hash_encoding(unit, grid, 4, 1.5).numpy()
    for n, point in enumerate(unit.double().numpy()):
        for level in range(3):
            cells = int(4 * 1.5**level)
            low, want = np.floor(point * cells).astype(int), np.zeros(2)
            for corner in np.ndindex(2, 2, 2):
                at = low + corner
                weight = np.prod(1 - np.abs(point * cells - at))
                key = int(at[0]) ^ int(at[1]) * 2654435761 ^ int(at[2]) * 805459861
                want += weight * grid[level, key % 64].double().numpy()
            assert found[n, 2 * level : 2 * level + 2] == pytest.approx(want, abs=1e-5)


def test_kernel_and_torch_agree_and_so_do_their_gradients():
    grid, unit, d = random(4, 128, 2) - 0.5, random(300, 3, seed=1), random(300, 8, seed=2) - 0.5
    unit[0], unit[1] = 0.0, 1.0  # both ends of the grid
    found = []
    for encode in (
        lambda g: hash_encoding(unit, g, 4, 1.5),
        lambda g: hash_encoding_torch(unit, g, [4.0, 6.0, 9.0, 13.0]),
    ):
        own = grid.clone().requires_grad_()
        values = encode(own)
        found.append((values.detach(), torch.autograd.grad(values, own, d)[0]))
    (kernel, d_kernel), (plain, d_plain) = found
    assert torch.equal(kernel, plain)
    torch.testing.assert_close(d_kernel, d_plain, rtol=1e-5, atol=1e-5)


def test_its_gradient_has_the_same_bits_on_one_thread():
    grid, unit, d = random(4, 128, 2), random(3000, 3, seed=1), random(3000, 8, seed=2) - 0.5

    def gradient():
        own = grid.clone().requires_grad_()
        return torch.autograd.grad(hash_encoding(unit, own, 4, 1.5), own, d)[0]

    many = gradient()
    with one_thread():
        assert torch.equal(gradient(), many)


def test_it_runs_without_numbers_on_the_meta_device():
    found = hash_encoding(torch.empty(5, 3, device="meta"), torch.empty(4, 128, 2, device="meta"), 4, 1.5)
    assert found.shape == (5, 8) and found.is_meta


def test_what_lies_outside_counts_as_the_end_and_nothing_is_no_error():
    grid, ends = random(3, 100, 2), torch.tensor([[0.0, 1.0, 0.5]])
    outside = torch.tensor([[-3.0, 7.0, 0.5]])
    assert torch.equal(hash_encoding(outside, grid, 4, 1.5), hash_encoding(ends, grid, 4, 1.5))
    assert hash_encoding(torch.zeros(0, 3), grid, 4, 1.5).shape == (0, 6)
    strange = hash_encoding(torch.tensor([[float("nan"), 0.1, float("inf")]]), grid, 4, 1.5)
    assert strange.shape == (1, 6)
