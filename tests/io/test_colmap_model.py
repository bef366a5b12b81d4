import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.core.camera import rotation_from_quat
from ambiguous_wild.io.colmap_model import read_model, write_model
from ambiguous_wild.io.colmap_records import points_without_tracks
from ambiguous_wild.io.safe_pycolmap import pycolmap
from tests.io.model_maker import make_model

NAMES = ["a.png", "b é.png", "sub/c.png"]


def test_binary_round_trip(tmp_path):
    model = make_model(NAMES)
    write_model(tmp_path, model)
    again = read_model(tmp_path)
    assert again.cameras == model.cameras
    assert list(again.images) == list(model.images)
    for number, image in model.images.items():
        other = again.images[number]
        assert (other.name, other.camera_id) == (image.name, image.camera_id)
        for field in ("qvec", "tvec", "xys", "point_ids"):
            assert np.array_equal(getattr(other, field), getattr(image, field))
    for field in dataclasses.fields(model.points):
        assert np.array_equal(getattr(again.points, field.name), getattr(model.points, field.name)), (
            field.name
        )


def test_colmap_reads_what_we_write_and_we_read_what_it_writes(tmp_path):
    """pycolmap is the oracle for both directions, binary and text."""
    model = make_model(["a.png", "b.png", "c.png"])
    write_model(tmp_path / "ours", model)
    theirs = pycolmap.Reconstruction(str(tmp_path / "ours"))
    assert theirs.num_reg_images() == 3
    for image in model.images.values():
        pose = theirs.images[image.image_id].cam_from_world().matrix()
        assert np.allclose(pose, image.cam_from_world()[:3])
    for kind in ("binary", "text"):
        folder = tmp_path / kind
        folder.mkdir()
        getattr(theirs, f"write_{kind}")(str(folder))
        again = read_model(folder)
        assert again.cameras[7].params == pytest.approx(model.cameras[7].params)
        for number, image in model.images.items():
            assert again.images[number].name == image.name
            assert np.allclose(again.images[number].xys, image.xys)
        order = np.argsort(again.points.ids)
        assert np.allclose(again.points.xyz[order], model.points.xyz)
        assert np.array_equal(again.points.rgb[order], model.points.rgb)
        assert len(again.points.track_image_ids) == len(model.points.track_image_ids)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_rotation_agrees_with_scipy(q):
    from scipy.spatial.transform import Rotation

    ours = rotation_from_quat(np.array(q))
    assert np.allclose(ours, Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_matrix(), atol=1e-12)
    assert np.allclose(ours @ ours.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_cut_file_is_named(tmp_path, name, share):
    write_model(tmp_path, make_model(["a.png", "b.png"]))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(share * len(data))])
    with pytest.raises(AwError, match=name.replace(".", r"\.")):
        read_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_an_absurd_count_is_refused_before_allocating(tmp_path, name):
    write_model(tmp_path, make_model(["a.png", "b.png"]))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes((2**60).to_bytes(8, "little") + data[8:])
    with pytest.raises(AwError, match="announces"):
        read_model(tmp_path)


def test_lens_distortion_is_refused_for_training_with_the_command():
    camera = make_model(["a.png"], camera="SIMPLE_RADIAL").cameras[7]
    with pytest.raises(AwError, match=r"SIMPLE_RADIAL.*aw import FOLDER"):
        camera.pinhole()
    assert make_model(["a.png"]).cameras[7].pinhole() == (60.0, 62.0, 33.0, 23.0)


def test_damaged_text_names_the_line(tmp_path):
    (tmp_path / "cameras.txt").write_text("# head\n1 PINHOLE 64 48 60 62 33 nan-ish\n")
    (tmp_path / "images.txt").write_text("")
    (tmp_path / "points3D.txt").write_text("")
    with pytest.raises(AwError, match=r"cameras\.txt, line 2"):
        read_model(tmp_path)
    (tmp_path / "cameras.txt").write_text("1 PINHOL 64 48 60 62 33 24\n")
    with pytest.raises(AwError, match="PINHOLE"):
        read_model(tmp_path)


def test_text_image_without_observations(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 64 48 60 32 24\n")
    (tmp_path / "images.txt").write_text(
        "# a\n3 1 0 0 0 0 0 0 1 with space.png\n\n4 1 0 0 0 1 0 0 1 b.png\n1 2 -1\n"
    )
    (tmp_path / "points3D.txt").write_text("")
    model = read_model(tmp_path)
    assert [i.name for i in model.images.values()] == ["with space.png", "b.png"]
    assert [len(i.xys) for i in model.images.values()] == [0, 1]
    assert len(model.points.ids) == 0


def test_no_model_at_all(tmp_path):
    with pytest.raises(AwError, match="holds no COLMAP model"):
        read_model(tmp_path)


def _first(rows):
    return rows[min(rows)]


def _same_name(model):
    last = max(model.images)
    model.images[last] = dataclasses.replace(model.images[last], name=_first(model.images).name)


def _no_lens(model):
    camera = _first(model.cameras)
    model.cameras[camera.camera_id] = dataclasses.replace(camera, params=(1e-300, 1.0, 3.0, 3.0))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda m: _first(m.images).tvec.__setitem__(0, np.nan), "translation"),
        (lambda m: _first(m.images).tvec.__setitem__(2, 1e20), "translation"),
        (lambda m: m.points.xyz.__setitem__((3, 1), np.inf), "1 points have no valid position, the first is"),
        (lambda m: m.points.xyz.__setitem__((slice(2, 4), 1), 1e200), "2 points have no valid position"),
        (_same_name, "twice"),
        (_no_lens, "parameters"),
    ],
)
def test_what_no_mapper_writes_is_named_when_the_model_is_read(tmp_path, spoil, said):
    model = make_model(NAMES)
    spoil(model)
    write_model(tmp_path, model)
    with pytest.raises(AwError, match=said):
        read_model(tmp_path)


def test_points_without_tracks_are_read_and_written_as_others(tmp_path):
    model = make_model(["a.png", "b.png"])
    bare = dataclasses.replace(model, points=points_without_tracks(model.points.xyz, model.points.rgb))
    write_model(tmp_path / "0", bare)
    theirs = pycolmap.Reconstruction()
    theirs.read_binary(tmp_path / "0")
    back = read_model(tmp_path / "0").points
    assert np.array_equal(back.xyz, bare.points.xyz) and np.array_equal(back.rgb, bare.points.rgb)
    assert np.array_equal(back.ids, bare.points.ids) and not back.track_offsets.any()
    assert np.allclose([theirs.points3D[i].xyz for i in back.ids], back.xyz)


@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("cameras", "1 PINHOLE 64 48 60 60 32 24"),
        ("images", "1 1 0 0 0 0 0 0 1 other.png\n"),
        ("points3D", "1 0 0 1 9 9 9 0.5"),
    ],
)
def test_an_id_that_is_there_twice_is_refused(name, row, tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    (tmp_path / "points3D.txt").write_text("1 0 0 4 9 9 9 0.5\n")
    assert len(read_model(tmp_path).points.ids) == 1
    with open(tmp_path / f"{name}.txt", "a") as f:
        f.write(row + "\n")
    with pytest.raises(AwError, match=rf"{name}.txt has the id 1 twice"):
        read_model(tmp_path)
