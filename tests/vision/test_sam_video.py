import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import natural_key
from ambiguous_wild.vision.sam import SamConfig
from ambiguous_wild.vision.sam_video import SamVideoConfig, SamVideoInstances

ALL = SamConfig(grid=3, least_iou=-9.0, least_stability=0.0)


def sequence(count: int) -> tuple[list[torch.Tensor], list[str]]:
    """A red square moves right all the time; a green one appears in photo 3 and moves down."""
    photos = []
    for k in range(count):
        image = torch.zeros(40, 60, 3)
        image[5:15, 2 + 4 * k : 12 + 4 * k, 0] = 1.0
        if k >= 3:
            image[2 + 3 * k : 8 + 3 * k, 45:55, 1] = 1.0
        photos.append(image)
    return photos, [f"frame{k}.jpg" for k in range(count)]


class Coloured(SamVideoInstances):
    """The nets are replaced by the colours: what is left is how ids are given and carried on."""

    def __init__(self, folder, config: SamVideoConfig) -> None:
        super().__init__("x", config, folder)
        self.looked = self.chunks = 0
        self.single.labels = self.look  # type: ignore[method-assign]

    def look(self, photo: torch.Tensor) -> np.ndarray:
        self.looked += 1
        red, green = (photo[:, :, 0] > 0).numpy(), (photo[:, :, 1] > 0).numpy()
        # labels differ from photo to photo, as a segmenter's do
        order = (green, red) if self.looked % 2 else (red, green)
        return np.where(order[0], 1, np.where(order[1], 2 if order[0].any() else 1, 0)).astype(np.int32)

    def follow(self, frames, first):
        self.chunks += 1
        ids = {c: int(first[(frames[0][:, :, c] > 0).numpy()].max(initial=0)) for c in (0, 1)}
        maps = [sum(ids[c] * (f[:, :, c] > 0).numpy() for c in (0, 1)).astype(np.int32) for f in frames[1:]]
        return [first, *maps]


@pytest.mark.parametrize("every", [1, 2, 3, 4, 20])
def test_a_thing_keeps_its_id_through_the_sequence(checkpoint, every):
    photos, names = sequence(8)
    maps = Coloured(checkpoint("sam2_video"), SamVideoConfig(every=every)).identities(photos, names)
    assert len(maps) == 8
    red = {int(k) for m, p in zip(maps, photos) for k in np.unique(m[(p[:, :, 0] > 0).numpy()])}
    assert len(red) == 1 and 0 not in red
    green = [{int(k) for k in np.unique(m[(p[:, :, 1] > 0).numpy()])} for m, p in zip(maps, photos)]
    looks = [k for k in range(8) if k % every == 0 and k >= 3]  # where it is first looked for after it came
    for k in range(3, 8):
        if looks and k >= looks[0]:
            assert green[k] == green[looks[0]] and not green[k] & (red | {0})
        else:
            assert green[k] == {0}
    assert all(set(np.unique(m)) <= {0, *red, *set().union(*green)} for m in maps)


def test_the_order_is_that_of_the_names(checkpoint):
    photos, names = sequence(12)
    folder = checkpoint("sam2_video")
    expected = Coloured(folder, SamVideoConfig(every=4)).identities(photos, names)
    shuffled = np.random.default_rng(0).permutation(12)
    found = Coloured(folder, SamVideoConfig(every=4)).identities(
        [photos[i] for i in shuffled], [names[i] for i in shuffled]
    )
    assert all(np.array_equal(found[k], expected[i]) for k, i in enumerate(shuffled))
    assert sorted(["a10", "a9", "b1", "a", "3"], key=natural_key) == ["3", "a", "a9", "a10", "b1"]


def test_a_stopped_stage_goes_on_where_it_was(checkpoint, tmp_path):
    photos, names = sequence(9)
    config = SamVideoConfig(every=3)

    class Stopped(Coloured):
        def follow(self, frames, first):
            if self.chunks == 2:
                raise KeyboardInterrupt
            return super().follow(frames, first)

    with pytest.raises(KeyboardInterrupt):
        Stopped(checkpoint("sam2_video"), config).identities(photos, names, tmp_path)
    rest = Coloured(checkpoint("sam2_video"), config)
    maps = rest.identities(photos, names, tmp_path)
    assert (rest.looked, rest.chunks) == (0, 1)  # all three looks and two chunks were there
    whole = Coloured(checkpoint("sam2_video"), config).identities(photos, names)
    assert all(np.array_equal(a, b) for a, b in zip(maps, whole))
    again = Coloured(checkpoint("sam2_video"), config)
    again.identities(photos, names, tmp_path)
    assert (again.looked, again.chunks) == (0, 0)


def test_the_real_net_follows_masks(checkpoint, photo):
    instances = SamVideoInstances("x", SamVideoConfig(every=2, sam=ALL), checkpoint("sam2_video"))
    photos = [photo(k, 60, 90) for k in range(4)]
    first = np.zeros((60, 90), np.int32)
    first[10:40, 10:40], first[20:55, 50:85] = 5, 9
    maps = instances.follow(photos, first)
    assert [m.shape for m in maps] == [(60, 90)] * 4 and all(m.dtype == np.int32 for m in maps)
    assert np.array_equal(maps[0], first)
    assert all(set(np.unique(m)) <= {0, 5, 9} for m in maps)
    again = SamVideoInstances("x", instances.config, checkpoint("sam2_video")).follow(photos, first)
    assert all(np.array_equal(a, b) for a, b in zip(maps, again))
    nothing = instances.follow(photos, np.zeros_like(first))
    assert len(nothing) == 4 and not any(m.any() for m in nothing)
    whole = instances.identities(photos, list("abcd"))
    assert [m.shape for m in whole] == [(60, 90)] * 4 and whole[0].any()


def test_what_the_video_net_needs_is_checked_at_once(checkpoint):
    with pytest.raises(AwError, match="holds a model of type 'sam2', x needs sam2_video"):
        SamVideoInstances("x", folder=checkpoint("sam2"))
    with pytest.raises(AwError, match="at least 1"):
        SamVideoInstances("x", SamVideoConfig(every=0), checkpoint("sam2_video"))
