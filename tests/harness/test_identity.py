"""What a scene is known by, and what it is not."""

from dataclasses import replace

from ambiguous_wild.harness.identity import scene_identity
from ambiguous_wild.io.scene_folder import load_scene
from tests.tiny_scene import write_tiny_scene


def test_a_scene_is_known_by_what_is_trained_and_scored_on(tmp_path):
    scene = load_scene(write_tiny_scene(tmp_path / "scene"))
    files = {name: {"sha256": f"{k}"} for k, name in enumerate(("images/a.png", "truth/capture.json"))}

    def identity(**changed):
        return scene_identity(replace(scene, info={**scene.info, "files": files | changed}))

    assert identity() == identity(**{"truth/capture.json": {"sha256": "another version's"}})
    assert identity() != identity(**{"images/a.png": {"sha256": "another photo"}})
