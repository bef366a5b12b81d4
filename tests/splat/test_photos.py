"""Photos read as a list are read: wherever they lie, and whenever they were sent."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import load_image_float, write_png
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat import data as data_module
from ambiguous_wild.splat.data import (
    PHOTOS_ON_DEVICE,
    RESIDENT_SHARE,
    CudaPhotoTransfer,
    HostPhotoTransfer,
    KeepMaps,
    PhotoPyramid,
    PrefetchedPhotos,
    load_train_data,
    photo_memory,
    shrink,
)
from tests.tiny_scene import write_tiny_scene

CPU = torch.device("cpu")


class SlowCopies:
    """What was sent is nonsense until somebody waits for it."""

    def __init__(self, *_):
        self.begun, self.finished = [], 0

    def hold(self, file, codes):
        return torch.from_numpy(codes)

    def begin(self, tensor):
        self.begun.append(tensor)
        return torch.full_like(tensor, 77), tensor

    def finish(self, sent):
        there, tensor = sent
        self.finished += 1
        return there.copy_(tensor)


@pytest.fixture
def codes():
    rng = np.random.default_rng(0)
    return [torch.from_numpy(rng.integers(0, 256, (3, 4, 3), dtype=np.uint8)) for _ in range(7)]


def expected(codes):
    return [torch.from_numpy(c.numpy().astype(np.float32) / np.float32(255)) for c in codes]


def test_they_are_a_sequence_of_what_the_host_would_have_made(codes):
    photos = PrefetchedPhotos(codes, CPU, SlowCopies())
    assert len(photos) == 7
    for got, wanted in zip(photos, expected(codes), strict=True):
        assert got.dtype == torch.float32 and torch.equal(got, wanted)
    assert torch.equal(photos[-1], expected(codes)[-1])
    assert [torch.equal(a, b) for a, b in zip(photos[::3], expected(codes)[::3])] == [True] * 3
    assert len(photos[1:3]) == 2
    with pytest.raises(IndexError):
        photos[7]


def test_photos_of_more_than_eight_bits_stay_what_they_are():
    deep = torch.rand(2, 2, 3)
    assert torch.equal(PrefetchedPhotos([deep], CPU, SlowCopies())[0], deep)


def test_one_sent_ahead_is_not_sent_again_and_is_waited_for_when_it_is_read(codes):
    copies = SlowCopies()
    photos = PrefetchedPhotos(codes, CPU, copies)
    photos.prefetch(3)
    photos.prefetch(3)
    assert len(copies.begun) == 1 and copies.begun[0] is codes[3] and copies.finished == 0
    assert torch.equal(photos[3], expected(codes)[3])
    assert torch.equal(photos[3], expected(codes)[3]) and photos[3] is photos[3]
    assert len(copies.begun) == copies.finished == 1
    photos.prefetch(3)  # it is there
    assert len(copies.begun) == 1


def test_few_lie_on_the_device_at_a_time(codes):
    photos = PrefetchedPhotos(codes, CPU, SlowCopies())
    for index in range(7):
        photos.prefetch((index + 1) % 7)
        assert torch.equal(photos[index], expected(codes)[index])
    assert list(photos._ready) == [4, 5, 6] and PHOTOS_ON_DEVICE == 3
    for index in range(7):
        photos.prefetch(index)
    assert len(photos._coming) <= PHOTOS_ON_DEVICE
    assert all(torch.equal(photos[i], e) for i, e in enumerate(expected(codes)))


@pytest.fixture
def scene(tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    (root / "masks" / "train").mkdir(parents=True)
    keep = np.full((48, 64), 255, np.uint8)
    keep[:, :9] = 0
    write_png(root / "masks" / "train" / "train_1.png", keep)
    return load_scene(root)


def load(scene, tmp_path):
    return load_train_data(scene, device=CPU, seed=0, cache_dir=tmp_path)


def test_on_the_cpu_photos_are_a_plain_list(scene, tmp_path):
    data = load(scene, tmp_path)
    assert type(data.photos) is list
    for photo, view in zip(data.photos, scene.train, strict=True):
        assert np.array_equal(photo.numpy(), load_image_float(view.image_path))
    assert [k is not None for k in data.user_keep] == [v.name == "train_1.png" for v in scene.train]


@pytest.mark.parametrize(
    ("copies", "memory", "held"),
    [(HostPhotoTransfer, 5.0, 6), (HostPhotoTransfer, 0.6, 2), (SlowCopies, 0.6, 6)],
)
def test_photos_that_do_not_fit_are_brought_when_they_are_read(
    scene, tmp_path, monkeypatch, copies, memory, held
):
    """Of a machine with room for some photos as codes: the others are read from their files again."""
    resident = load(scene, tmp_path).photos
    codes = 48 * 64 * 3
    monkeypatch.setattr(data_module, "usable_memory", lambda: memory * 4 * codes / RESIDENT_SHARE)
    monkeypatch.setattr(data_module, "HostPhotoTransfer", copies)
    photos = load(scene, tmp_path).photos
    assert isinstance(photos._copies, copies)
    assert sum(not isinstance(kept, Path) for kept in photos._held) == held
    for k, (a, b) in enumerate(zip(photos, resident, strict=True)):
        photos.prefetch((k + 1) % 6)
        assert torch.equal(a, b)


def test_what_is_held_for_a_gpu_are_the_codes_of_the_file(codes, tmp_path):
    held = CudaPhotoTransfer.hold(None, tmp_path, codes[0].numpy())
    assert held.dtype == torch.uint8 and torch.equal(held, codes[0])
    deep = CudaPhotoTransfer.hold(None, tmp_path, np.full((2, 2, 3), 65535, np.uint16))
    assert torch.equal(deep, torch.ones(2, 2, 3))


def test_a_photo_that_has_gone_is_named_when_it_is_read(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(data_module, "usable_memory", lambda: 0)
    photos = load(scene, tmp_path).photos
    scene.train[2].image_path.unlink()
    assert photos[1].shape == (48, 64, 3)
    with pytest.raises(AwError, match=scene.train[2].name):
        photos[2]


def test_a_share_of_the_memory_decides(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1000, 8000))
    assert photo_memory(torch.device("cuda")) == 250
    monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 10, "SC_PHYS_PAGES": 100}.__getitem__)
    assert (photo_memory(CPU), photo_memory(CPU, RESIDENT_SHARE)) == (50, 250)


def test_keep_maps_take_a_byte_a_pixel_and_are_read_as_float32():
    maps = [None, torch.tensor([[0.0, 1.0], [-1.0, 0.0]]), torch.ones(3, 2)]
    kept = KeepMaps(maps)
    assert len(kept) == 3 and kept[0] is None and kept._codes[2].nbytes == 6
    assert all(
        torch.equal(a, b) and a.dtype == torch.float32 for a, b in zip(kept[1:], maps[1:], strict=True)
    )


def test_smaller_photos_are_kept_at_the_present_size_alone(scene, tmp_path):
    data = load(scene, tmp_path)
    pyramid = PhotoPyramid(data)
    quarter = pyramid.photo(0, 4)
    assert pyramid.photo(0, 4) is quarter and quarter.shape == (12, 16, 3)
    assert torch.equal(pyramid.photo(1, 2), shrink(data.photos[1], 2)) and list(pyramid._photos) == [1]
    assert pyramid.photo(0, 1) is data.photos[0]
