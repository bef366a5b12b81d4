"""The two back ends answer alike, and only they ask where tensors lie."""

import math

import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.splat import backend as backends
from ambiguous_wild.splat.backend import Backend, GpuBackend, backend_of
from ambiguous_wild.splat.rendered import check_needs
from tests.host_reads import no_transfers

CPU, GPU = Backend(), GpuBackend()


def test_a_tensor_has_the_back_end_of_its_device(monkeypatch):
    assert type(backend_of("cpu")) is Backend
    assert {type(backend_of(there)) for there in ("cuda:1", torch.device("meta"))} == {GpuBackend}
    monkeypatch.setattr(backends, "accelerated", lambda _: True)  # as tests run the GPU's calls on the CPU
    assert type(backend_of("cpu")) is GpuBackend


@pytest.mark.parametrize("labels", [[0, 2, 2, 5], [], [7] * 200])
def test_sums_by_label(labels):
    labels, values = torch.tensor(labels, dtype=torch.int64), torch.rand(len(labels), dtype=torch.float64)
    expected = [float(values[labels == label].sum()) for label in range(8)]
    counts = [int((labels == label).sum()) for label in range(8)]
    for backend in (CPU, GPU):
        assert backend.label_sums(labels, 8, values).tolist() == pytest.approx(expected)
        found = backend.label_sums(labels, 8)
        assert found.dtype == torch.float64 and found.tolist() == counts


@pytest.mark.parametrize("shape", [(50,), (50, 3)])
def test_the_mean_is_of_visible_rows(shape):
    values = torch.rand(shape)
    seen = torch.rand(50) > 0.6
    means = [b.mean_of_rows(values[b.visible_rows(lambda: seen)], lambda: seen) for b in (CPU, GPU)]
    for mean in means:
        torch.testing.assert_close(mean, values[seen].mean())
    nothing = torch.zeros(50, dtype=torch.bool)
    assert float(GPU.mean_of_rows(values, lambda: nothing)) == 0.0


@pytest.mark.parametrize(("points", "count"), [(5, 1), (5, 5), (700, 4)])
def test_the_nearest_points(points, count):
    xyz = torch.rand(points, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = torch.cdist(xyz, xyz).argsort(dim=1)[:, :count]
    for backend in (CPU, GPU):
        assert torch.equal(backend.neighbours(xyz, count), expected)


def test_a_number_for_later_is_the_number():
    value = torch.tensor(0.1, requires_grad=True)
    kept = GPU.number(value * 1)
    assert CPU.number(value) == float(value.detach()) == float(kept)
    assert isinstance(kept, torch.Tensor) and not kept.requires_grad


@pytest.mark.parametrize("value", [math.nan, -math.nan, math.inf, -math.inf, 3.4e38, -1e-45, -0.0])
@pytest.mark.parametrize("at", [0, 17, 2999])
def test_values_that_are_not_finite_are_found(value, at):
    sound, tensor = torch.ones(7), torch.zeros(1000, 3)
    tensor.view(-1)[at] = value
    for backend in (CPU, GPU):
        assert backend.all_finite([sound, tensor]) == backend.all_finite([tensor, sound])
        assert backend.all_finite([tensor, sound]) == math.isfinite(value)
    assert CPU.all_finite([torch.full((100,), 3e38), torch.zeros(0, 3)])  # their sum overflows


def test_a_gpu_reads_nothing_on_the_host():
    labels, values = torch.zeros(6, dtype=torch.int64, device="meta"), torch.ones(6, device="meta").double()
    with no_transfers():
        GPU.label_sums(labels, 3, values)
        GPU.mean_of_rows(values, lambda: values > 0)
        GPU.number(values.sum())
        assert GPU.visible_rows(lambda: pytest.fail("looked")) == slice(None)


def test_each_says_which_sums_it_offers():
    check_needs(frozenset({"absolute", "squared", "count"}), CPU.statistics)
    check_needs(frozenset({"absolute"}), GPU.statistics)
    with pytest.raises(AwError, match=r"'squared' .* --device cpu"):
        check_needs(frozenset({"squared"}), GPU.statistics)
    for backend in (CPU, GPU):
        with pytest.raises(AwError, match=r"statistic 'sqared'.*squared"):
            check_needs(frozenset({"sqared"}), backend.statistics)
