"""What all back ends of features have in common."""

import pytest
import torch
import torch.nn.functional as F

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.protocols import blurred_noisy_copy, evenly_spaced_indices

IN_FLOAT64 = ("labhog", "sceneconv", "dinov2", "registers", "dinov1")
each = pytest.mark.parametrize("kind", (*IN_FLOAT64, "vgg16", "efficientnet-lite0"))


@each
def test_the_unit_is_the_distance_that_blur_and_noise_make_and_state_goes_round(backend, photo, kind):
    features, photos = backend(kind), [photo(k, 45, 64) for k in range(3)]
    features.fit(photos)
    pairs = [(features(p), features(blurred_noisy_copy(p, k))) for k, p in enumerate(photos)]
    distance = torch.stack([1 - F.cosine_similarity(one, two, dim=2) for one, two in pairs]).mean()
    assert features.unit == pytest.approx(float(distance), rel=0.05 if kind == "labhog" else 1e-3)
    other = backend(kind)
    other.load_state_dict(features.state_dict())
    assert other.unit == features.unit and torch.equal(other(photo(9)), features(photo(9)))
    with pytest.raises(AwError, match="without training photos"):
        features.fit([])
    with pytest.raises(AwError, match="at least 8x8"):
        features(torch.zeros(4, 40, 3))


def test_photos_to_fit_are_spread_evenly():
    assert evenly_spaced_indices(5, 2) == [0, 4] and evenly_spaced_indices(3, 8) == [0, 1, 2]


@each
def test_the_gradient_is_finite_on_flat_and_out_of_range_images(backend, kind):
    features = backend(kind)
    for value in (0.0, 0.003, 0.5, 1.0, -0.5, 2.0):
        image = torch.full((16, 20, 3), value, requires_grad=True)
        phi = features(image)
        (phi * torch.arange(float(phi.shape[2]))).sum().backward()
        assert torch.isfinite(phi).all() and torch.isfinite(image.grad).all()


@pytest.mark.parametrize("kind", IN_FLOAT64)
def test_the_gradient_equals_finite_differences_in_float64(backend, photo, kind):
    features = backend(kind)
    if kind == "labhog":
        features.fit([photo(k, 45, 64) for k in range(2)])
    else:
        (features.net if kind == "sceneconv" else features.model).double()
    h, rel = (1e-5, 1e-5) if "dino" in kind or kind == "registers" else (1e-6, 2e-3)  # others have kinks
    image = (photo(3, 45, 61)[:16, :16] if rel > 1e-5 else photo(4, 45, 61)).double() * 0.8 + 0.1
    image.requires_grad_(True)
    phi, generator = features(image), torch.Generator().manual_seed(0)
    cotangent = torch.randn(phi.shape, generator=generator, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((phi * cotangent).sum(), image)
    for _ in range(4):
        direction = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            up, down = (((features(image + s * h * direction)) * cotangent).sum() for s in (1, -1))
        assert float((gradient * direction).sum()) == pytest.approx(float(up - down) / (2 * h), rel=rel)


@each
def test_the_same_bits_every_time_and_the_callers_random_numbers_untouched(backend, photo, kind):
    def once():
        features, image = backend(kind), photo(5, 45, 64).requires_grad_(True)
        features.fit([photo(k, 45, 64) for k in range(2)])
        phi = features(image)
        (gradient,) = torch.autograd.grad((phi * torch.arange(float(phi.shape[2]))).sum(), image)
        return phi.detach(), gradient

    torch.manual_seed(5)
    before = torch.get_rng_state()
    first, second = once(), once()
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])
