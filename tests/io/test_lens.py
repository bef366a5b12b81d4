"""The way back through a lens: pictures of the pinhole camera in the pixels of the photo."""

import cv2
import numpy as np
import pytest

from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.lens import make_lens

LENSES = {
    "SIMPLE_RADIAL": (300.0, 160.0, 120.0, -0.12),
    "OPENCV": (300.0, 290.0, 158.0, 123.0, -0.2, 0.05, 0.002, -0.003),
    "OPENCV_FISHEYE": (220.0, 220.0, 160.0, 120.0, 0.02, 0.0, 0.0, 0.0),
    "PINHOLE": (300.0, 300.0, 160.0, 120.0),
}


@pytest.mark.parametrize("model", LENSES)
def test_the_way_back_ends_where_it_began(model):
    """Oracle: each pixel of the photo shows what the pinhole camera shows at its undistorted point."""
    lens = make_lens(ModelCamera(1, model, 320, 240, LENSES[model]))
    width, height = lens.pinhole.width, lens.pinhole.height
    rows, columns = np.mgrid[:height, :width].astype(np.float32) + 0.5
    x, y = lens.distort(columns), lens.distort(rows)  # where each pixel of the photo came from
    points = np.stack(np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5), axis=-1).reshape(-1, 2)
    true = lens.undistort_points(points).reshape(240, 320, 2)
    inside = ((true > 0.5) & (true < [width - 0.5, height - 0.5])).all(axis=-1)
    assert inside.mean() > 0.5
    assert np.abs(x - true[..., 0])[inside].max() < 0.05 and np.abs(y - true[..., 1])[inside].max() < 0.05


def test_a_reduced_picture_is_enlarged_in_place():
    lens = make_lens(ModelCamera(1, "SIMPLE_RADIAL", 320, 240, LENSES["SIMPLE_RADIAL"]))
    mask = np.zeros((240, 320), np.float32)
    cv2.circle(mask, (90, 70), 40, 1.0, -1)
    flat = lens.remap(mask, nearest=True)
    small = cv2.resize(flat, (flat.shape[1] // 4, flat.shape[0] // 4), interpolation=cv2.INTER_AREA)
    back = lens.distort(small) > 0.5
    both, either = (back & (mask > 0)).sum(), (back | (mask > 0)).sum()
    assert both / either > 0.97
