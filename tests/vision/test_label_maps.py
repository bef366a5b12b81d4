import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.label_maps import LabelMaps, SceneLabelMaps, read_labels


def png(path, array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(".png", array)
    assert done
    path.write_bytes(data.tobytes())


def blank(height: int = 4, width: int = 6) -> torch.Tensor:
    return torch.zeros(height, width, 3)


def test_every_kind_of_file_reads_the_same_labels(tmp_path):
    ids = np.array([[0, 1, 1, 7, 7, 7], [0, 0, 1, 7, 7, 7], [9, 9, 0, 0, 0, 0], [9, 9, 9, 9, 0, 0]])
    expected = np.searchsorted([0, 1, 7, 9], ids)
    png(tmp_path / "a.png", ids.astype(np.uint8))
    png(tmp_path / "sub" / "b.png", (ids * 1000).astype(np.uint16))
    np.save(tmp_path / "c.npy", np.where(ids == 0, -1, ids * 100_000).astype(np.int64))
    png(tmp_path / "d.png", np.stack([ids * 3, ids * 0, ids * 20], axis=2).astype(np.uint8))
    names = ["a.jpg", "sub/b.JPG", "deep/er/c.jpg", "d.png"]
    for labels in LabelMaps(tmp_path).labels_of([blank()] * 4, names):
        assert labels.dtype == np.int32 and np.array_equal(labels, expected)


def test_a_map_without_background_keeps_all_its_labels(tmp_path):
    png(tmp_path / "a.png", np.array([[3, 3], [5, 5]], np.uint8))
    assert LabelMaps(tmp_path).labels_of([blank(2, 2)], ["a.jpg"])[0].tolist() == [[1, 1], [2, 2]]


def test_scene_wide_ids_stay_the_same_thing(tmp_path):
    png(tmp_path / "a.png", np.array([[0, 40], [900, 900]], np.uint16))
    png(tmp_path / "b.png", np.array([[900, 0], [900, 77]], np.uint16))
    a, b = SceneLabelMaps(tmp_path).identities([blank(2, 2)] * 2, ["a.jpg", "b.jpg"])
    assert a.tolist() == [[0, 1], [3, 3]] and b.tolist() == [[3, 0], [3, 2]]
    a, b = LabelMaps(tmp_path).labels_of([blank(2, 2)] * 2, ["a.jpg", "b.jpg"])
    assert a.tolist() == [[0, 1], [2, 2]] and b.tolist() == [[2, 0], [2, 1]]
    assert not hasattr(LabelMaps(tmp_path), "identities")


def test_another_size_is_resized_without_new_labels(tmp_path):
    big = np.repeat(np.repeat(np.array([[1, 2, 0], [0, 3, 3]], np.uint8), 4, 0), 4, 1)
    png(tmp_path / "a.png", big)
    small = LabelMaps(tmp_path).labels_of([blank(2, 3)], ["a.jpg"])[0]
    assert small.tolist() == [[1, 2, 0], [0, 3, 3]]
    large = LabelMaps(tmp_path).labels_of([blank(16, 24)], ["a.jpg"])[0]
    assert np.array_equal(large, np.repeat(np.repeat(small, 8, 0), 8, 1))
    # off by a pixel through rounding is the same photo; another shape is not
    assert LabelMaps(tmp_path).labels_of([blank(100, 151)], ["a.jpg"])[0].shape == (100, 151)
    with pytest.raises(AwError, match=r"a.png is 12x8, its photo 200x100: not the same shape"):
        LabelMaps(tmp_path).labels_of([blank(100, 200)], ["a.jpg"])


def test_missing_photos_are_named_in_one_line(tmp_path):
    png(tmp_path / "a.png", np.ones((4, 6), np.uint8))
    with pytest.raises(AwError, match=r"2 of 3 photos have no label map in .*: b.jpg, x/c.jpg; add"):
        LabelMaps(tmp_path).labels_of([blank()] * 3, ["a.jpg", "b.jpg", "x/c.jpg"])
    with pytest.raises(AwError, match=r"2 of 2 photos have no label map in .*: x/a.jpg, y/a.jpg"):
        LabelMaps(tmp_path).labels_of([blank()] * 2, ["x/a.jpg", "y/a.jpg"])
    with pytest.raises(AwError, match="call labels_of"):
        LabelMaps(tmp_path).labels(blank())


def test_names_do_not_lead_out_of_the_folder(tmp_path):
    png(tmp_path / "outside.png", np.ones((4, 6), np.uint8))
    png(tmp_path / "in" / "a.png", np.ones((4, 6), np.uint8))
    for name in ("../outside.jpg", str(tmp_path / "outside.jpg")):
        with pytest.raises(AwError, match="have no label map"):
            LabelMaps(tmp_path / "in").labels_of([blank()], [name])


def test_what_is_no_label_map_is_refused_by_name(tmp_path):
    with pytest.raises(AwError, match="no folder"):
        LabelMaps(tmp_path / "absent")
    with pytest.raises(AwError, match="holds no label map"):
        LabelMaps(tmp_path)
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nrest")
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "pickle.npy").write_bytes(b"nonsense")
    np.save(tmp_path / "float.npy", np.ones((3, 3), np.float32))
    np.save(tmp_path / "huge.npy", np.full((3, 3), 2**63, np.uint64))
    np.save(tmp_path / "cube.npy", np.ones((3, 3, 3), np.int32))
    np.save(tmp_path / "object.npy", np.array([{}], dtype=object))
    png(tmp_path / "deep.png", np.ones((3, 3, 3), np.uint16))
    for file in sorted(tmp_path.iterdir()):
        with pytest.raises(AwError, match=file.name):
            read_labels(file)


def test_a_home_that_nobody_has_is_told():
    with pytest.raises(AwError, match="no home folder is known"):
        LabelMaps("~nobody-of-this-name/labels")
