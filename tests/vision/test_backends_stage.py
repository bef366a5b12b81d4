import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.io.progress_bar import terminal_bar
from ambiguous_wild.vision.backends import DINO, SAM, SAM_VIDEO, make_features, make_instances
from ambiguous_wild.vision.dino import DinoConfig, DinoFeatures
from ambiguous_wild.vision.grounded import GroundedInstances
from ambiguous_wild.vision.label_maps import LabelMaps, SceneLabelMaps
from ambiguous_wild.vision.labhog import LabHog
from ambiguous_wild.vision.precompute import instance_labels, photo_features
from ambiguous_wild.vision.protocols import SceneInstances
from ambiguous_wild.vision.sam import SamInstances
from ambiguous_wild.vision.sam_video import SamVideoInstances
from ambiguous_wild.vision.segments import GraphSegments, SegmentConfig


def test_features_by_name(checkpoint):
    assert isinstance(make_features("labhog"), LabHog)
    made = make_features(f"dinov2-small@70,blocks=2,normalise=raw,weights={checkpoint('dinov2')}")
    assert isinstance(made, DinoFeatures)
    assert made.config == DinoConfig(size=70, blocks=2, normalise="raw")
    assert made(torch.rand(40, 60, 3)).shape == (3, 5, 32)
    assert made.name.startswith("dino-1-dinov2-small-")
    for name in DINO:  # every one of them takes its family's weights
        kind = "registers" if "registers" in name else "dinov2" if "dinov2" in name else "dinov1"
        assert make_features(f"{name},weights={checkpoint(kind)}").channels == 32


def test_instances_by_name(checkpoint, tmp_path):
    assert make_instances("graph").name == GraphSegments().name
    fine = make_instances("graph,fewest=150,most=300")
    assert isinstance(fine, GraphSegments) and fine.config == SegmentConfig(fewest=150, most=300)
    assert fine.name != GraphSegments().name  # or the cache would mix them up
    for name in SAM:
        made = make_instances(f"{name}@8,weights={checkpoint('sam2' if 'sam2' in name else 'sam')}")
        assert isinstance(made, SamInstances) and made.config.grid == 8
    for name in SAM_VIDEO:
        video = make_instances(f"{name}@8,every=4,sam.batch=9,weights={checkpoint('sam2_video')}")
        assert isinstance(video, SamVideoInstances) and isinstance(video, SceneInstances)
        assert (video.config.every, video.config.sam.grid, video.config.sam.batch) == (4, 8, 9)
    weights = f"weights={checkpoint('grounding')},sam_weights={checkpoint('sam2')}"
    grounded = make_instances(f"grounded:person, car,least_score=0.2,{weights}")
    assert isinstance(grounded, GroundedInstances)
    assert (grounded.prompt, grounded.config.least_score) == ("person. car.", 0.2)
    weights = f"weights={checkpoint('grounding')},sam_weights={checkpoint('sam2_video')}"
    followed = make_instances(f"grounded-video:dog,least_score=0.2,every=5,{weights}")
    assert isinstance(followed, SamVideoInstances) and isinstance(followed.single, GroundedInstances)
    assert (followed.config.every, followed.single.config.least_score) == (5, 0.2)
    assert followed.name != SamVideoInstances("sam2.1-hiera-tiny", None, checkpoint("sam2_video")).name
    np.save(tmp_path / "a.npy", np.ones((4, 4), np.int32))
    own = make_instances(f"labels:{tmp_path}")
    assert isinstance(own, LabelMaps)
    assert not isinstance(own, SceneInstances)
    assert isinstance(make_instances(f"labels:{tmp_path},scene_wide=true"), SceneLabelMaps)


@pytest.mark.parametrize(
    "spec, message",
    [
        ("vgg16,layer=relu3", "unknown layer of vgg16 'relu3': did you mean 'relu"),
        ("vgg16@2", "at least one cell of 4 px"),
        ("efficientnet-lite0,fit_photos=0", "fit_photos at least 1"),
        ("efficientnet-lite0:x", "nothing after a colon"),
        ("dinov2-smal", "did you mean 'dinov2-small'"),
        ("labhog,blocks=3", "takes no options"),
        ("dinov2-small:x", "nothing after a colon"),
        ("dinov2-small,block=3", "blocks"),
    ],
)
def test_features_that_do_not_exist(spec, message):
    with pytest.raises(AwError, match=message):
        make_features(spec)


@pytest.mark.parametrize(
    "spec, message",
    [
        ("efficientnet-lite0,alike=2", "alike"),
        ("vgg16,similar=0.5", "unknown option of vgg16"),
        ("sam2video", "did you mean 'sam2-video'"),
        ("graph,kk=3", "unknown option of graph"),
        ("graph@7", "graph takes no size"),
        ("sam2:x", "nothing after a colon"),
        ("labels", "write labels:FOLDER"),
        ("labels:x,scene=true", "did you mean 'scene_wide'"),
        ("labels:x,scene_wide=maybe", "true or false"),
        ("grounded:", "no phrase in the prompt"),
    ],
)
def test_instances_that_do_not_exist(spec, message):
    with pytest.raises(AwError, match=message):
        make_instances(spec)


def test_without_weights_a_name_answers_with_the_command(offline):
    for make, spec in (
        (make_features, "dinov2-small-registers"),
        (make_features, "vgg16"),
        (make_instances, "sam2-video"),
        (make_instances, "grounded:car"),
        (make_instances, "efficientnet-lite0"),
    ):
        with pytest.raises(AwError, match=r"missing \(not in .* run: aw weights get [a-z0-9.-]+"):
            make(spec)


def test_features_are_computed_once_a_photo(checkpoint, photo, tmp_path):
    class Counted(DinoFeatures):
        calls = 0

        def __call__(self, image: torch.Tensor) -> torch.Tensor:
            self.calls += 1
            return super().__call__(image)

    photos = [photo(k, 40, 60) for k in range(3)]

    def fresh(config: DinoConfig) -> Counted:
        return Counted("x", config, checkpoint("dinov2"))

    features = fresh(DinoConfig(size=70))
    first = photo_features(features, photos, tmp_path)
    assert features.calls == 3
    again = fresh(DinoConfig(size=70))
    second = photo_features(again, [*photos, photo(9, 40, 60)], tmp_path)
    assert again.calls == 1  # the new photo alone
    assert all(torch.equal(a, b) for a, b in zip(first, second))
    other = fresh(DinoConfig(size=84))
    assert photo_features(other, photos, tmp_path)[0].shape != first[0].shape and other.calls == 3


def test_instances_are_looked_for_once_a_photo_and_a_stop_loses_one(photo, tmp_path):
    class Stopping(GraphSegments):
        def __init__(self, after: int) -> None:
            super().__init__()
            self.after, self.calls = after, 0

        def labels(self, image: torch.Tensor) -> np.ndarray:
            if self.calls == self.after:
                raise KeyboardInterrupt
            self.calls += 1
            return super().labels(image)

    photos, names = [photo(k, 40, 60) for k in range(4)], [f"{k}.jpg" for k in range(4)]
    with pytest.raises(KeyboardInterrupt):
        instance_labels(Stopping(2), photos, names, tmp_path)
    rest = Stopping(99)
    found = instance_labels(rest, photos, names, tmp_path)
    assert rest.calls == 2 and not found.scene_wide
    assert all(np.array_equal(a, GraphSegments().labels(p)) for a, p in zip(found.labels, photos))


def test_back_ends_that_see_the_whole_scene_give_its_identities(tmp_path):
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", np.full((4, 6), 10 * (k + 1), np.int32))
    photos, names = [torch.zeros(4, 6, 3)] * 2, ["0.jpg", "1.jpg"]
    own = instance_labels(make_instances(f"labels:{tmp_path}"), photos, names, tmp_path / "cache")
    assert [int(m.max()) for m in own.labels] == [1, 1] and not own.scene_wide
    wide = make_instances(f"labels:{tmp_path},scene_wide=true")
    scene = instance_labels(wide, photos, names, tmp_path / "cache")
    assert [int(m.max()) for m in scene.labels] == [1, 2] and scene.scene_wide


def test_no_bar_off_a_terminal(capfd):
    assert list(terminal_bar("masks")([1, 2])) == [1, 2]
    assert capfd.readouterr().err == ""
