import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.grounded import Detection, GroundedConfig, GroundedInstances, normal_prompt

LOOSE = GroundedConfig(least_score=0.0, least_text=0.0, shorter=64, longer=128, nms=1.0)


@pytest.fixture
def grounded(checkpoint):
    def make(prompt: str = "person. car.", config: GroundedConfig = LOOSE) -> GroundedInstances:
        return GroundedInstances(
            prompt, config, folder=checkpoint("grounding"), sam_folder=checkpoint("sam2")
        )

    return make


def test_boxes_scores_and_labels_equal_the_librarys_own(grounded, checkpoint, photo):
    from transformers import BertTokenizer, GroundingDinoImageProcessorPil, GroundingDinoProcessor

    from ambiguous_wild.vision.sam import fit_to

    instances, image = grounded(), photo(0, 64, 96)
    found = instances.detect(image)
    assert len(found) == 20  # every query, nothing suppressed
    tokenizer = BertTokenizer.from_pretrained(checkpoint("grounding"))
    processor = GroundingDinoProcessor(GroundingDinoImageProcessorPil(), tokenizer)
    text = tokenizer("person. car.", return_tensors="pt")
    with torch.no_grad():
        out = instances._nets[0](pixel_values=fit_to(image, 64, 96), **text)
    expected = processor.post_process_grounded_object_detection(
        out, text["input_ids"], threshold=0.0, text_threshold=0.0, target_sizes=[(64, 96)]
    )[0]
    order = torch.argsort(-expected["scores"], stable=True)
    assert np.allclose([d.score for d in found], expected["scores"][order])
    assert np.allclose([d.box for d in found], expected["boxes"][order].clamp(min=0), atol=1e-3)
    # the library keeps the token that ends the text where the threshold lets it through
    words = [expected["text_labels"][k].removesuffix("[SEP]").strip(" .") for k in order]
    assert [d.label for d in found] == words and words[0] == "person. car"


def test_only_sure_boxes_and_no_doubles(grounded, photo):
    image = photo(1, 60, 90)
    scores = sorted(d.score for d in grounded().detect(image))
    middle = (scores[9] + scores[10]) / 2
    sure = grounded(config=GroundedConfig(least_score=middle, shorter=64, longer=128, nms=1.0)).detect(image)
    assert len(sure) == 10 and min(d.score for d in sure) > middle
    none = grounded(config=GroundedConfig(least_score=1.0, shorter=64, longer=128))
    labels, found = none.labelled(image)
    assert labels.shape == (60, 90) and labels.dtype == np.int32 and not labels.any() and found == []


def test_one_instance_a_box_with_its_words(grounded, photo, monkeypatch):
    instances, image = grounded(), photo(2, 40, 60)
    big, small, hidden = (0, 0, 40, 30), (5, 5, 15, 15), (6, 6, 14, 14)
    told = [Detection(small, 0.9, "car"), Detection(big, 0.8, "person"), Detection(hidden, 0.7, "dog")]
    monkeypatch.setattr(instances, "detect", lambda _: told)

    def boxes_as_masks(_: torch.Tensor, boxes: np.ndarray) -> np.ndarray:
        masks = np.zeros((len(boxes), 40, 60), bool)
        for mask, (x0, y0, x1, y1) in zip(masks, boxes.astype(int)):
            mask[y0:y1, x0:x1] = True
        masks[2] = masks[0]  # the same thing twice: the later one covers it
        return masks

    monkeypatch.setattr(instances.sam, "in_boxes", boxes_as_masks)
    labels, found = instances.labelled(image)
    assert [d.label for d in found] == ["person", "dog"]
    assert labels[20, 30] == 1 and labels[10, 10] == 2 and labels[35, 50] == 0
    assert np.array_equal(instances.labels(image), labels)


def test_the_real_nets_repeat(grounded, photo):
    first = grounded().labels(photo(3, 50, 70))
    assert first.shape == (50, 70) and np.array_equal(first, grounded().labels(photo(3, 50, 70)))


def test_prompts_are_brought_into_the_nets_form(grounded):
    assert normal_prompt("A  Person , car.dog") == "a person. car. dog."
    assert grounded("person, CAR").name == grounded("person. car.").name != grounded("person.").name
    for empty in ("", " . ", ","):
        with pytest.raises(AwError, match="no phrase"):
            normal_prompt(empty)


def test_weights_are_checked_at_once(checkpoint):
    with pytest.raises(AwError, match="needs grounding-dino"):
        GroundedInstances("car", folder=checkpoint("sam2"), sam_folder=checkpoint("sam2"))
    with pytest.raises(AwError, match="shorter <= longer"):
        GroundedInstances("car", GroundedConfig(shorter=900, longer=800))


def test_a_folder_without_a_tokenizer_is_named(checkpoint, tmp_path):
    for name in ("config.json", "model.safetensors"):
        (tmp_path / name).write_bytes((checkpoint("grounding") / name).read_bytes())
    with pytest.raises(AwError, match=r"no tokenizer.json: grounding-dino-tiny cannot read a prompt"):
        GroundedInstances("car", LOOSE, folder=tmp_path, sam_folder=checkpoint("sam2"))
    (tmp_path / "tokenizer.json").write_text("{")
    with pytest.raises(AwError, match="no usable tokenizer"):
        _ = GroundedInstances("car", LOOSE, folder=tmp_path, sam_folder=checkpoint("sam2"))._nets
