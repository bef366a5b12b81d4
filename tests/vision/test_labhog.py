import cv2
import numpy as np
import pytest
import torch
from skimage.color import rgb2lab

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.labhog import LabHog, lab_image


def photo(seed: int, height: int = 45, width: int = 64) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    small = rng.random((6, 8, 3)).astype(np.float32)
    return torch.from_numpy(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 1))


def test_lab_equals_scikit_image():
    image = photo(0)
    expected = rgb2lab(image.double().numpy()) / 100.0
    assert np.abs(lab_image(image).permute(1, 2, 0).numpy() - expected).max() < 2e-4


def test_shape_and_block_lengths():
    features = LabHog()
    features.fit([photo(k) for k in range(3)])
    phi = features(photo(7))
    assert phi.shape == (12, 16, 27)
    assert phi.dtype == torch.float32
    # each block has unit length times sqrt(weight)
    norm = (phi * phi).sum(2)
    assert torch.allclose(norm, features.weights.sum().expand_as(norm), rtol=1e-3)


def test_the_unit_is_the_distance_that_blur_and_noise_make():
    features = LabHog()
    photos = [photo(k) for k in range(4)]
    features.fit(photos)
    from ambiguous_wild.vision.labhog import blurred_noisy_copy

    distances = []
    for index, one in enumerate(photos):
        a, b = features(one), features(blurred_noisy_copy(one, index))
        cosine = (a * b).sum(2) / (a.norm(dim=2) * b.norm(dim=2))
        distances.append((1 - cosine).mean())
    assert float(torch.stack(distances).mean()) == pytest.approx(features.unit, rel=0.05)


@pytest.mark.parametrize("value", [0.0, 0.003, 0.5, 1.0, -0.5, 2.0])
def test_gradient_is_finite_on_flat_and_out_of_range_images(value):
    image = torch.full((16, 20, 3), value, requires_grad=True)
    phi = LabHog()(image)
    phi.sum().backward()
    assert torch.isfinite(phi).all()
    assert torch.isfinite(image.grad).all()


def test_gradient_equals_finite_differences_in_float64():
    features = LabHog()
    features.fit([photo(k) for k in range(2)])
    image = (photo(3, 16, 16).double() * 0.8 + 0.1).requires_grad_(True)
    cotangent = torch.randn(4, 4, 27, generator=torch.Generator().manual_seed(0)).double()
    (gradient,) = torch.autograd.grad((features(image) * cotangent).sum(), image)
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        direction = torch.randn(image.shape, generator=generator).double()
        h = 1e-6
        with torch.no_grad():
            up = (features(image + h * direction) * cotangent).sum()
            down = (features(image - h * direction) * cotangent).sum()
        assert float((gradient * direction).sum()) == pytest.approx(float(up - down) / (2 * h), rel=2e-3)


def test_same_bits_every_time():
    def once() -> tuple[torch.Tensor, torch.Tensor]:
        features = LabHog()
        features.fit([photo(k) for k in range(3)])
        image = photo(5).requires_grad_(True)
        phi = features(image)
        (gradient,) = torch.autograd.grad((phi * torch.arange(27.0)).sum(), image)
        return phi.detach(), gradient

    first, second = once(), once()
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


def test_state_goes_round():
    one, two = LabHog(), LabHog()
    one.fit([photo(k) for k in range(3)])
    two.load_state_dict(one.state_dict())
    assert two.unit == one.unit
    assert torch.equal(one(photo(9)), two(photo(9)))


def test_refuses_what_is_no_image():
    with pytest.raises(AwError, match="at least 8x8"):
        LabHog()(torch.zeros(4, 4, 3))
    with pytest.raises(AwError, match="without training photos"):
        LabHog().fit([])
