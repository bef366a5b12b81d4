from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.sam import SamConfig, SamInstances

ALL = SamConfig(grid=4, least_iou=-9.0, least_stability=0.0, batch=7)
KINDS = ("sam", "sam2", "sam2_video")
SIDE = 128


class Scene:
    """Stands in for the net: knows three discs on the photo, answers points and boxes on its own square.

    What it is told is in px of the square it sees, so that every conversion between photo and square shows.
    """

    discs = ((30.0, 20.0, 12.0), (95.0, 60.0, 22.0), (100.0, 60.0, 7.0))  # x, y, radius on a 130x90 photo

    def __init__(self, height: int, width: int, padded: bool) -> None:
        scale = SIDE / max(height, width)
        self.sx, self.sy = (scale, scale) if padded else (SIDE / width, SIDE / height)
        self.config = SimpleNamespace(prompt_encoder_config=SimpleNamespace(image_size=SIDE))
        self.calls: list[int] = []

    def to(self, _: object) -> "Scene":
        return self

    def get_image_embeddings(self, pixels: torch.Tensor) -> torch.Tensor:
        assert pixels.shape == (1, 3, SIDE, SIDE)
        return pixels

    def low(self, which: int | None) -> torch.Tensor:
        """Logits [32, 32] of a disc, the signed distance to its edge in px of the photo."""
        y, x = torch.meshgrid(torch.arange(32) * 4.0 + 2.0, torch.arange(32) * 4.0 + 2.0, indexing="ij")
        if which is None:
            return torch.full((32, 32), -5.0)
        cx, cy, radius = self.discs[which]
        return radius - torch.hypot(x / self.sx - cx, y / self.sy - cy)

    def __call__(self, image_embeddings, input_points=None, input_labels=None, input_boxes=None, **_):
        if input_points is not None:
            self.calls.append(input_points.shape[1])
            assert input_labels.shape == input_points.shape[:3] and bool((input_labels == 1).all())
            masks = torch.stack(
                [self.at(x / self.sx, y / self.sy) for x, y in input_points[0, :, 0].tolist()]
            )
            return SimpleNamespace(pred_masks=masks[None], iou_scores=masks.amax((2, 3))[None] * 0.01 + 0.9)
        middles = [((a + c) / 2 / self.sx, (b + d) / 2 / self.sy) for a, b, c, d in input_boxes[0].tolist()]
        return SimpleNamespace(pred_masks=torch.stack([self.at(x, y)[:1] for x, y in middles])[None])

    def at(self, x: float, y: float) -> torch.Tensor:
        """[3, 32, 32]: the discs that hold the point, the smallest first."""
        hit = [i for i, (cx, cy, r) in enumerate(self.discs) if np.hypot(x - cx, y - cy) <= r]
        hit.sort(key=lambda i: self.discs[i][2])
        return torch.stack([self.low(i) for i in [*hit, None, None, None][:3]])


def truth(height: int = 90, width: int = 130) -> np.ndarray:
    """Labels by falling area: the large disc 1, the one in it 3."""
    y, x = np.mgrid[:height, :width] + 0.5
    result = np.zeros((height, width), np.int32)
    for label, (cx, cy, radius) in zip((1, 2, 3), (Scene.discs[1], Scene.discs[0], Scene.discs[2])):
        result[np.hypot(x - cx, y - cy) < radius] = label
    return result


@pytest.mark.parametrize("kind", KINDS)
def test_a_grid_of_points_finds_what_is_there_where_it_is(checkpoint, photo, kind):
    instances = SamInstances(kind, SamConfig(grid=12, batch=50, least_stability=0.5), checkpoint(kind))
    scene = instances.model = Scene(90, 130, padded=kind == "sam")
    labels = instances.labels(photo(0, 90, 130))
    assert labels.dtype == np.int32 and labels.max() == 3
    for label in (1, 2, 3):
        one, two = labels == label, truth() == label
        assert np.count_nonzero(one & two) / np.count_nonzero(one | two) > 0.85
    assert scene.calls == [50, 50, 44]


@pytest.mark.parametrize("kind", KINDS)
def test_boxes_of_the_photo_give_the_instance_inside(checkpoint, photo, kind):
    instances = SamInstances(kind, ALL, checkpoint(kind))
    instances.model = Scene(90, 130, padded=kind == "sam")
    boxes = np.array([[18, 8, 42, 32], [93, 53, 107, 67]] * 5, float)  # more than one batch
    masks = instances.in_boxes(photo(0, 90, 130), boxes)
    assert masks.shape == (10, 90, 130)
    for mask, label in zip(masks, (2, 3) * 5):
        expected = truth() == label
        assert np.count_nonzero(mask & expected) / np.count_nonzero(mask | expected) > 0.85
    assert instances.in_boxes(photo(0, 90, 130), np.zeros((0, 4))).shape == (0, 90, 130)


@pytest.mark.parametrize("kind", KINDS)
def test_points_give_the_instance_that_they_lie_on(checkpoint, photo, kind):
    instances = SamInstances(kind, ALL, checkpoint(kind))
    net = Scene(90, 130, padded=kind == "sam")
    prompts = []

    def answer(image_embeddings, input_points, input_labels, multimask_output):
        assert input_labels.shape == input_points.shape[:3] == (1, 1, input_points.shape[2])
        points = input_points[0, 0] / torch.tensor([net.sx, net.sy])
        prompts.append((points.numpy(), input_labels[0, 0].tolist()))
        return SimpleNamespace(pred_masks=net.at(*points[0].tolist())[None, :1, None])

    net.__class__ = type("Prompted", (Scene,), {"__call__": lambda self, **words: answer(**words)})
    instances.model = net
    group = np.array([[30.0, 20], [32, 22], [28, 18]])
    outside = np.array([[120.0, 80], [60, 20], [50, 22], *[[126.0, 85]] * 9])
    masks = instances.at_points(photo(0, 90, 130), [group, np.tile([[100.0, 60]], (30, 1))], outside)
    for mask, label in zip(masks, (2, 3), strict=True):
        expected = truth() == label
        assert np.count_nonzero(mask & expected) / np.count_nonzero(mask | expected) > 0.85
    points, signs = prompts[0]
    assert signs == [1] * 3 + [0] * 8
    np.testing.assert_allclose(points[:6], [*group, [50, 22], [60, 20], [120, 80]], atol=0.5)
    assert prompts[1][1] == [1] * 8 + [0] * 8
    real = SamInstances(kind, ALL, checkpoint(kind)).at_points(photo(1, 96, 130), [group], outside[:0])
    assert real.shape == (1, 96, 130)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("height, width", [(96, 130), (131, 77)])
def test_the_real_nets_run_and_repeat(checkpoint, photo, kind, height, width):
    image = photo(1, height, width)
    first = SamInstances(kind, ALL, checkpoint(kind)).labels(image)
    assert first.shape == (height, width) and first.dtype == np.int32
    present = np.unique(first[first > 0])
    assert len(present) and list(present) == list(range(1, len(present) + 1))
    assert np.array_equal(SamInstances(kind, ALL, checkpoint(kind)).labels(image), first)


def test_masks_of_boxes_equal_the_librarys_own_way(checkpoint, photo):
    """SAM 1 has a processor that needs no torchvision: the same boxes through it."""
    from transformers import SamImageProcessorPil, SamProcessor

    instances = SamInstances("sam", ALL, checkpoint("sam"))
    image = photo(2, 90, 128)
    boxes = np.array([[10, 12, 60, 70], [40, 5, 120, 88]], float)
    found = instances.in_boxes(image, boxes)
    size, low = {"longest_edge": 128}, {"longest_edge": 32}
    processor = SamProcessor(
        SamImageProcessorPil(
            size=size, pad_size={"height": 128, "width": 128}, mask_size=low,
            mask_pad_size={"height": 32, "width": 32},
        )
    )  # fmt: skip
    pixels = (image.numpy() * 255).round().astype(np.uint8)
    inputs = processor(pixels, input_boxes=[boxes.tolist()], return_tensors="pt")
    with torch.no_grad():
        out = instances.model(
            pixel_values=inputs["pixel_values"],
            input_boxes=inputs["input_boxes"].float(),
            multimask_output=False,
        )
    masks = processor.image_processor.post_process_masks(
        out.pred_masks, inputs["original_sizes"], inputs["reshaped_input_sizes"]
    )[0][:, 0]
    assert masks.shape == found.shape
    assert (np.asarray(masks) == found).mean() > 0.98  # 8-bit pixels there


def test_what_is_unsure_small_or_unstable_is_dropped(checkpoint, photo):
    instances = SamInstances("sam2", SamConfig(grid=12, least_iou=2.0), checkpoint("sam2"))
    instances.model = Scene(90, 130, padded=False)
    assert not instances.labels(photo(0, 90, 130)).any()
    instances.config = SamConfig(grid=12, least_stability=0.5, least_area=0.03)
    assert instances.labels(photo(0, 90, 130)).max() == 2  # the small disc is 1.3 % of the photo
    instances.config = SamConfig(grid=12, least_stability=0.8)  # between logits -1 and 1: a ring of 2 px
    assert instances.labels(photo(0, 90, 130)).max() == 1


def test_settings_and_weights_are_checked_at_once(checkpoint):
    with pytest.raises(AwError, match="at least 1"):
        SamInstances("x", SamConfig(grid=0), checkpoint("sam"))
    with pytest.raises(AwError, match="needs sam or sam2 or sam2_video"):
        SamInstances("x", folder=checkpoint("dinov2"))
    names = {SamInstances("x", c, checkpoint("sam")).name for c in (SamConfig(), SamConfig(grid=8))}
    assert len(names) == 2
