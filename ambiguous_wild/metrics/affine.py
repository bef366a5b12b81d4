"""PSNR of a render whose colours are fitted to the photo: light and exposure are not counted.

Test photos of an automatic camera have exposures of their own, which no model can know. `psnr` compares them
as brightness; this metric allows one affine colour map per picture.
"""

from __future__ import annotations

import numpy as np

from ambiguous_wild.metrics.image import checked_pair, psnr_from_mse

RANK = 1e-12  # of the largest eigenvalue: below it a channel is a copy of others, as in grey pictures


def psnr_affine(
    render: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
    photo: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
) -> float:
    """PSNR in dB after the affine colour map (3x3 and an offset, least squares) from render to photo.

    The map is fitted to the whole picture, its result cut to [0, 1]. Never below `psnr`, as leaving the
    colours alone is such a map. (Nerfstudio and gsplat fit a quadratic map for `cc_psnr`: other values.)

    Raises:
        AwError: see `checked_pair`.
    """
    left, right = checked_pair(render, photo)
    x, y = left.reshape(-1, 3), right.reshape(-1, 3)
    plain = float(np.mean((x - y) ** 2))
    # Normal equations of centred colours: exact enough for 8 bits, and no 4-column copy of a large picture.
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    x = x - x_mean
    matrix = np.linalg.lstsq(x.T @ x, x.T @ (y - y_mean), rcond=RANK)[0]
    fitted = np.clip(x @ matrix + y_mean, 0.0, 1.0)
    return psnr_from_mse(min(plain, float(np.mean((fitted - y) ** 2))))
