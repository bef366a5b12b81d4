"""Row 25, what other tests of the builder leave open: two photos."""

from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError
from tests.builder.capture_maker import write_capture

SETTINGS = BuildSettings(max_features=500)


def outcome(raw, scene) -> str:
    """The error, or "" where a scene was made; nothing half-made is left beside it."""
    try:
        build_scene(raw, scene, SETTINGS)
    except AwError as error:
        assert sorted(p.name for p in raw.parent.iterdir()) == [raw.name]
        return str(error)
    assert (scene / "scene.json").is_file()
    return ""


def test_25_two_photos_are_refused_with_how_many_are_needed_or_make_a_scene(tmp_path):
    write_capture(tmp_path / "raw", 2)
    said = outcome(tmp_path / "raw", tmp_path / "scene")
    assert said == "" or "2 photos" in said or "of 2" in said
