"""Photos in which a person may be seen, by weak classical detectors: a list to look through, no guarantee."""

from __future__ import annotations

import warnings
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.io.images import read_png_rgb

SIDE = 800  # px, longer side
HOW_WEAK = (
    "OpenCV's HOG detector finds upright people of at least 128 px from head to foot, and the LBP "
    "cascade frontal "
    "faces of at least 24 px, in photos reduced to 800 px. Both miss people who sit, turn away, are "
    "cut off or "
    "far, and both find people in trees and windows. Number plates are not looked for. A photo that "
    "is not listed "
    "may show people: look at every photo before release."
)
_LEAST_WEIGHT = 0.5  # of the SVM; below, most finds are wrong


@cache
def _detectors() -> tuple[Any, Any]:
    from skimage import data
    from skimage.feature import Cascade

    hog = cv2.HOGDescriptor()
    hog.setSVMDetector(np.asarray(cv2.HOGDescriptor.getDefaultPeopleDetector(), np.float32))
    return hog, Cascade(data.lbp_frontal_face_cascade_filename())


def may_show_person(path: Path) -> str:
    """What was found: "person", "face", "person and face", or "" for nothing."""
    rgb = read_png_rgb(path)
    scale = SIDE / max(rgb.shape[:2])
    if scale < 1:
        rgb = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    hog, cascade = _detectors()
    found = []
    if gray.shape[0] >= 128 and gray.shape[1] >= 64:
        _, weights = hog.detectMultiScale(gray, winStride=(8, 8), scale=1.1)
        if np.size(weights) and float(np.max(weights)) >= _LEAST_WEIGHT:
            found.append("person")
    if min(gray.shape) >= 24:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            faces = cascade.detect_multi_scale(
                img=gray, scale_factor=1.3, step_ratio=2, min_size=(24, 24), max_size=(400, 400)
            )
        found += ["face"] if len(faces) else []
    return " and ".join(found)
