import numpy as np
import torch
from skimage.color import rgb2lab

from ambiguous_wild.vision.labhog import LabHog, lab_image


def test_lab_equals_scikit_image(photo):
    image = photo(0, 45, 64)
    expected = rgb2lab(image.double().numpy()) / 100.0
    assert np.abs(lab_image(image).permute(1, 2, 0).numpy() - expected).max() < 2e-4


def test_shape_and_block_lengths(photo):
    features = LabHog()
    features.fit([photo(k, 45, 64) for k in range(3)])
    phi = features(photo(7, 45, 64))
    assert phi.shape == (12, 16, 27)
    assert phi.dtype == torch.float32
    # each block has unit length times sqrt(weight)
    norm = (phi * phi).sum(2)
    assert torch.allclose(norm, features.weights.sum().expand_as(norm), rtol=1e-3)
