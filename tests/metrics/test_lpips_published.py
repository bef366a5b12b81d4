"""With the published networks LPIPS is that of the package `lpips`: skipped where they are not installed."""

import pytest

from ambiguous_wild.metrics import lpips
from tests.metrics.lpips_published import PUBLISHED, published_pairs


@pytest.mark.usefixtures("machine_weights")
@pytest.mark.parametrize("name", PUBLISHED)
def test_ten_pairs_give_the_values_of_the_reference_package(name: str) -> None:
    reason = lpips.available()[name]
    if reason is not None:
        pytest.skip(reason)
    metric = lpips.load(name)
    found = [metric(a, b) for a, b in published_pairs()]
    assert found == pytest.approx(PUBLISHED[name], abs=1e-4)


def test_the_pairs_differ_from_faint_to_strong() -> None:
    """Values near each other could not tell one variant from another."""
    assert len(published_pairs()) == 10
    for values in PUBLISHED.values():
        assert len(values) == 10 and min(values) < 0.01 and max(values) > 0.4
    for a, b in (("lpips_alex", "lpips_vgg"), ("lpips_vgg", "lpips_vgg_01")):
        assert all(abs(x - y) > 5e-4 for x, y in zip(PUBLISHED[a], PUBLISHED[b])) or a == "lpips_alex"
