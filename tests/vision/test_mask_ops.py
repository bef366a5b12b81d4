import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ambiguous_wild.vision.mask_ops import add_untracked, box_nms, mask_boxes, paint


def random_masks(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.random((6, 9, 11)) < rng.random((6, 1, 1)) ** 2


masks_of = st.integers(0, 2**32 - 1).map(random_masks)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """By counting cells of a fine raster."""
    raster = np.zeros((2, 40, 40), bool)
    for layer, (x0, y0, x1, y1) in zip(raster, (a, b)):
        layer[int(y0) : int(y1), int(x0) : int(x1)] = True
    return np.count_nonzero(raster.all(0)) / max(np.count_nonzero(raster.any(0)), 1)


@given(masks_of)
def test_boxes_are_tight(masks):
    for mask, (x0, y0, x1, y1) in zip(masks, mask_boxes(masks).astype(int)):
        assert mask[y0:y1, x0:x1].sum() == mask.sum()
        if mask.any():
            assert mask[y0].any() and mask[y1 - 1].any() and mask[:, x0].any() and mask[:, x1 - 1].any()


@given(st.integers(0, 2**32 - 1))
def test_suppression_keeps_the_best_of_every_overlapping_set(seed):
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 30, (12, 2))
    boxes = np.concatenate([low, low + rng.integers(1, 10, (12, 2))], axis=1).astype(float)
    scores = rng.random(12)
    kept = box_nms(boxes, scores, 0.3)
    assert list(scores[kept]) == sorted(scores[kept], reverse=True)
    for i in range(12):
        better = [k for k in kept if k != i and iou(boxes[i], boxes[k]) > 0.3]
        if i in kept:
            assert not better
        else:  # somebody better stands for it
            assert any(scores[k] >= scores[i] for k in better)


@given(masks_of)
def test_a_small_mask_lies_on_a_large_one(masks):
    labels, which = paint(masks, 9, 11)
    assert labels.dtype == np.int32
    assert sorted(np.unique(labels[labels > 0])) == list(range(1, len(which) + 1))
    areas = masks.sum((1, 2))
    assert list(areas[which]) == sorted(areas[which], reverse=True)
    for y in range(9):
        for x in range(11):
            covering = np.flatnonzero(masks[:, y, x])
            if not len(covering):
                assert labels[y, x] == 0
            else:
                assert areas[which[labels[y, x] - 1]] == areas[covering].min()


def test_nothing_to_paint():
    labels, which = paint([], 4, 5)
    assert labels.shape == (4, 5) and not labels.any() and len(which) == 0


def test_what_is_followed_is_not_found_again():
    tracked = np.zeros((4, 10), np.int32)
    tracked[:, :4] = 7
    found = np.zeros((4, 10), np.int32)
    found[:, :5] = 1  # four fifths under 7: known
    found[:, 5:7] = 2  # new, small
    found[:, 7:] = 3  # new, larger: first
    labels, free = add_untracked(tracked, found, 20, most=10)
    assert free == 22
    assert [int(x) for x in labels[0]] == [7, 7, 7, 7, 0, 21, 21, 20, 20, 20]
    labels, free = add_untracked(tracked, found, 20, most=2)
    assert free == 21 and sorted(np.unique(labels)) == [0, 7, 20]
    assert add_untracked(tracked, found, 20, most=1)[1] == 20
