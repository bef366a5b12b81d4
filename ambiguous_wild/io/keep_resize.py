"""How keep maps are made smaller: one function, and the rule by its name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, overload

import cv2
import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

# "any masked": a pixel is masked if any pixel in it is. For losses and weights, where a distractor at the
# rim of a mask must not count. "majority": a pixel is kept if at least half of its area is. For files, so
# that the rims of masks stay where they are.
Rule = Literal["any masked", "majority"]


@overload
def smaller_keep(keep: np.ndarray, size: tuple[int, int], rule: Rule) -> np.ndarray: ...
@overload
def smaller_keep(keep: Tensor, size: tuple[int, int], rule: Rule) -> Tensor: ...
def smaller_keep(keep: np.ndarray | Tensor, size: tuple[int, int], rule: Rule) -> np.ndarray | Tensor:
    """Reduce a keep map.

    Args:
        keep: [H, W] in [0, 1], 1 = static; bool if it is an array. A tensor stays on its device.
        size: (height, width) of the result, px; they need not divide H and W.
        rule: see `Rule`. By "any masked" the result is the smallest value in each pixel, so weights
            between 0 and 1 are allowed.

    Returns:
        [height, width], float32 or in the type of the tensor.
    """
    if rule == "majority":
        share = cv2.resize(np.asarray(keep, np.float32), size[::-1], interpolation=cv2.INTER_AREA)
        majority = (share >= 0.5).astype(np.float32)
        return majority if isinstance(keep, np.ndarray) else keep.new_tensor(majority)
    import torch

    values = torch.from_numpy(np.asarray(keep, np.float32)) if isinstance(keep, np.ndarray) else keep
    least = -torch.nn.functional.adaptive_max_pool2d(-values[None, None], size)[0, 0]
    return least.numpy() if isinstance(keep, np.ndarray) else least
