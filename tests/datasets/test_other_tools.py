"""Models as other tools and platforms write them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.readers import read_foreign
from ambiguous_wild.datasets.write import import_scene
from ambiguous_wild.io.scene_folder import load_scene
from tests.io.model_maker import make_model, write_scene, write_text

NAMES = [f"DJI (1) {k}.png" for k in range(8)]


def edit(root: Path, names: str, change) -> None:
    for path in (root / "sparse" / "0").glob(names):
        path.write_bytes(change(path.read_bytes()))


def pairs_apart(data: bytes) -> bytes:
    """Each image's own line alone."""
    return b"".join(data.splitlines(keepends=True)[::2])


SPOILT = {
    "beside the photos": lambda r: [
        shutil.move(p, r) for f in ("sparse/0", "images") for p in (r / f).glob("*")
    ],
    "among the photos": lambda r: [shutil.move(p, r / "images") for p in (r / "sparse/0").glob("*")],
    "no points": lambda r: (r / "sparse/0/points3D.txt").unlink(),
    "no observations": lambda r: edit(r, "images.txt", pairs_apart),
    "line ends": lambda r: edit(r, "*.txt", lambda d: d.replace(b"\n", b"\r\n")),
    "byte order mark": lambda r: edit(r, "*.txt", lambda d: b"\xef\xbb\xbf" + d),
    "Windows": lambda r: edit(r, "images.txt", lambda d: d.replace(b" DJI", b" images\\DJI")),
    "a disk": lambda r: edit(r, "images.txt", lambda d: d.replace(b" DJI", b" C:\\me\\my photos\\DJI")),
    "exponents": lambda r: edit(r, "cameras.txt", lambda d: d.replace(b"33.0", b"3.3e+001")),
    "leftovers": lambda r: [
        (r / p).write_text("x")
        for p in ("images/._DJI (1) 0.png", "images/Thumbs.db", "sparse/0/._cameras.txt")
    ],
}


def scene_of(root: Path) -> Path:
    write_scene(root, NAMES)
    shutil.rmtree(root / "images_2")
    shutil.rmtree(root / "sparse")
    write_text(root / "sparse" / "0", make_model(NAMES))
    return root


@pytest.mark.parametrize("kind", SPOILT)
def test_a_model_of_another_tool_is_read_as_it_is_meant(kind: str, tmp_path: Path) -> None:
    root = scene_of(tmp_path / "theirs")
    known = read_foreign(root)[0].model
    SPOILT[kind](root)
    for folder in ("sparse/0", "sparse", "images"):
        if (root / folder).is_dir() and not any((root / folder).iterdir()):
            (root / folder).rmdir()
    if kind == "no points":  # photos of noise match nothing: random ones are said
        result = import_scene(root, tmp_path / "scene")
        assert "starts from random" in str(result.info)
    else:
        import_scene(root, tmp_path / "scene")
        found = load_scene(tmp_path / "scene")
        assert [v.name for v in found.views] == NAMES and len(found.points) == len(known.points.ids)
        camera = found.views[0].camera
        assert (camera.cx, camera.width) == (33.0, 64)
        poses = sorted(known.images.values(), key=lambda i: i.name)
        np.testing.assert_allclose(
            [v.camera.cam_from_world for v in found.views], [p.cam_from_world() for p in poses], atol=1e-9
        )


def test_photos_that_another_tool_turned_by_exif_are_named(tmp_path: Path) -> None:
    root = scene_of(tmp_path / "theirs")
    Image.open(root / "images" / NAMES[0]).rotate(90, expand=True).save(root / "images" / NAMES[0])
    with pytest.raises(AwError, match=r"DJI \(1\) 0\.png \(48x64, its camera 64x48, turned\)"):
        import_scene(root, tmp_path / "scene")
