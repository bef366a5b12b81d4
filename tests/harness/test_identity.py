"""What a scene is known by, and what it is not."""

import shutil
from dataclasses import replace

from ambiguous_wild.harness.running.cell import scene_identity
from ambiguous_wild.io.scene_folder import load_scene
from tests.tiny_scene import write_tiny_scene


def test_a_scene_is_known_by_what_is_trained_and_scored_on(tmp_path):
    scene = load_scene(write_tiny_scene(tmp_path / "scene"))
    files = {name: {"sha256": f"{k}"} for k, name in enumerate(("images/a.png", "truth/capture.json"))}

    def identity(**changed):
        return scene_identity(replace(scene, info={**scene.info, "files": files | changed}))

    assert identity() == identity(**{"truth/capture.json": {"sha256": "another version's"}})
    assert identity() != identity(**{"images/a.png": {"sha256": "another photo"}})


def test_a_plain_scene_is_known_by_its_photos_masks_and_model(tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    seen = {scene_identity(load_scene(root))}

    def another():
        found = scene_identity(load_scene(root))
        new = found not in seen
        seen.add(found)
        return new

    assert not another()
    shutil.copy(root / "images/train_1.png", root / "images/train_0.png")
    assert another()
    (root / "masks/train").mkdir(parents=True)
    shutil.copy(root / "truth/distractor/train_0.png", root / "masks/train/train_0.png")
    assert another()
    shutil.copy(root / "truth/distractor/train_1.png", root / "masks/train/train_0.png")
    assert another()
    for file, old, new in (
        ("cameras.txt", "60.0 60.0", "61.0 61.0"),
        ("points3D.txt", " 0.5\n", " 0.5\n9999 0.1 0.1 4 1 2 3 0.5\n"),
    ):
        text = (root / "sparse/0" / file).read_text()
        (root / "sparse/0" / file).write_text(text.replace(old, new, 1))
        assert another(), file
