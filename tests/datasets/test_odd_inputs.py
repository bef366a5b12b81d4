"""What people bring: every kind of folder through `aw import`, what is read of it and what is said."""

import json
import unicodedata
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms

from ambiguous_wild.core import AwError
from ambiguous_wild.core.srgb import srgb_to_linear
from ambiguous_wild.datasets.write import ImportSettings, import_scene
from ambiguous_wild.io.colmap_model import read_model, write_model
from ambiguous_wild.io.colour_profile import ADOBE, ADOBE_GAMMA, Colours
from ambiguous_wild.io.images import load_image_float, read_png_rgb, write_png
from ambiguous_wild.io.ply import write_point_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.data import load_keep
from tests.datasets import layouts
from tests.datasets.layouts import HEIGHT, NAMES, TRAIN, WIDTH

KEEP = np.zeros((HEIGHT, WIDTH), np.uint8)
KEEP[:, 20:] = 255


@dataclass
class Odd:
    """A folder, what its import says, and how many masks, points and test photos the scene has."""

    make: Callable[[Path], object]
    says: tuple[str, ...] = ()
    masks: int = 0
    points: int = 60
    kind: str | None = None
    tests: list[str] = field(default_factory=lambda: list(layouts.TEST))


def plain(root: Path, photos: str = "images", name: Callable[[str], str] = str, lists: bool = True) -> Path:
    """A COLMAP dataset whose model calls its photos `name(...)`."""
    layouts.write_photos(root / photos)
    write_model(root / "sparse/0", layouts.make_model([name(n) for n in NAMES]))
    if lists:
        layouts.write_lists(root)
    return root


def masked(spelling: str, folder: str = "masks") -> Callable[[Path], None]:
    def make(root: Path) -> None:
        plain(root)
        for name in NAMES:
            write_png(root / folder / spelling.format(name=name, stem=name[:-4]), KEEP)

    return make


def decomposed(root: Path) -> None:
    names = [n.replace("clutter", "fürchterlich") for n in NAMES]
    write_model(root / "sparse/0", layouts.make_model(names))
    layouts.write_photos(root / "images", [unicodedata.normalize("NFD", n) for n in names])
    layouts.write_lists(root, names[:5], names[5:])


def renamed_files(root: Path) -> None:
    plain(root)
    for name in NAMES[:3]:
        (root / "images" / name).rename(root / "images" / name.replace("clutter", "CLUTTER"))
    jpeg = cv2.imencode(".jpg", layouts.photo(3)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    (root / "images" / NAMES[3]).unlink()
    (root / "images" / f"{NAMES[3][:-4]}.jfif").write_bytes(jpeg)


def listed_tests(root: Path) -> None:
    (plain(root, lists=False) / "sparse/0/test.txt").write_text("extra000\nextra001.png\n")


def cloud(root: Path) -> None:
    points = read_model(plain(root) / "sparse/0").points
    (root / "sparse/0/points3D.bin").unlink()
    write_point_ply(root / "sparse/0/points3D.ply", points.xyz[:40], points.rgb[:40])


def more_than_it_uses(root: Path) -> None:
    plain(root)
    (root / "depths").mkdir()
    (root / "poses_bounds.npy").write_bytes(b"x")
    (root / "README.md").write_text("x")
    write_png(root / "images/unplaced.png", layouts.photo(9))


def blender_with_points(root: Path) -> None:
    layouts.blender(root)
    points = layouts.make_model().points
    write_point_ply(root / "points3d.ply", points.xyz, points.rgb)


def tagged(root: Path) -> None:
    """Photos in the colours of a profile with primaries of its own, which a viewer shows as the others."""
    plain(root)
    profile = wide_profile()
    for name in TRAIN[:2]:
        with Image.open(root / "images" / name) as image:
            to_wide = ImageCms.buildTransform(ImageCms.createProfile("sRGB"), profile, "RGB", "RGB")
            converted = ImageCms.applyTransform(image, to_wide)
        converted.save(root / "images" / name, icc_profile=profile.tobytes())


def wide_profile() -> ImageCms.ImageCmsProfile:
    """sRGB with red and green exchanged, which lcms writes as a matrix profile."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    tags = {bytes(data[k : k + 4]): k for k in range(132, 132 + 12 * int.from_bytes(data[128:132]), 12)}
    red, green = tags[b"rXYZ"] + 4, tags[b"gXYZ"] + 4
    data[red : red + 8], data[green : green + 8] = data[green : green + 8], data[red : red + 8]
    return ImageCms.getOpenProfile(BytesIO(bytes(data)))


def gamma(root: Path) -> None:
    """Photos whose codes are linear light, as PNG's gAMA says, without a profile."""
    plain(root)
    for name in TRAIN[:2]:
        path = root / "images" / name
        codes = (srgb_to_linear(read_png_rgb(path) / 255.0) * 65535 + 0.5).astype(np.uint16)
        data = cv2.imencode(".png", codes[..., ::-1])[1].tobytes()
        chunk = b"gAMA" + (100_000).to_bytes(4)
        path.write_bytes(data[:33] + (4).to_bytes(4) + chunk + zlib.crc32(chunk).to_bytes(4) + data[33:])


def adobe(root: Path) -> None:
    """Photos in Adobe RGB, as EXIF alone says it."""
    plain(root)
    for name in TRAIN[:2]:
        path = root / "images" / name
        light = srgb_to_linear(read_png_rgb(path) / 255.0) @ np.linalg.inv(ADOBE).T
        codes = (np.clip(light, 0, 1) ** (1 / ADOBE_GAMMA) * 255 + 0.5).astype(np.uint8)
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {1: "R03"}
        Image.fromarray(codes).save(path, exif=exif.tobytes())


def other_case_in_lists(root: Path) -> None:
    plain(root)
    layouts.write_lists(root, [n.upper() for n in TRAIN], [n.upper() for n in layouts.TEST])


def numpy_masks(root: Path) -> None:
    (plain(root) / "masks").mkdir()
    np.save(root / "masks" / f"{TRAIN[0]}.npy", KEEP)


def wholly_transparent(root: Path) -> None:
    plain(root)
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    rgba = np.dstack([layouts.photo(0)[..., ::-1], 0 * alpha])
    cv2.imwrite(str(root / "images" / TRAIN[0]), rgba)


def foreign_test_list(root: Path) -> None:
    (plain(root, lists=False) / "sparse/0/test.txt").write_text("nobody.png\n")


def unlisted_nerfstudio(root: Path) -> None:
    path = layouts.nerfstudio(root) / "transforms.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in data.items() if "filenames" not in key}))


ODD = {
    "linear light by gAMA": Odd(gamma, ("2 photos: colours converted to sRGB from gamma 1",)),
    "Adobe RGB by EXIF": Odd(adobe, ("2 photos: colours converted to sRGB from Adobe RGB (EXIF)",)),
    "nerfstudio without lists": Odd(
        unlisted_nerfstudio, ("nerfstudio itself tests a tenth",), tests=["clutter000.png"], masks=-1
    ),
    "lists in capitals": Odd(other_case_in_lists),
    "masks in the photos' folder": Odd(masked("{stem}.png", "images/Masks"), ("keep masks of 5 of 5",), 7),
    "a list of other photos": Odd(
        foreign_test_list,
        ("test.txt names none or all", "no test set"),
        kind="colmap",
        tests=["clutter000.png"],
    ),
    "photos in input/": Odd(lambda root: plain(root, "input"), ("photos are read from input/",)),
    "names with a folder": Odd(lambda root: plain(root, name=lambda n: f"images/{n}")),
    "absolute names": Odd(lambda root: plain(root, name=lambda n: f"/home/me/scan/images/{n}")),
    "names of Windows": Odd(lambda root: plain(root, "pictures", name=lambda n: f"C:\\scan\\{n}")),
    "names that lead upwards": Odd(lambda root: plain(root, name=lambda n: f"../images/{n}")),
    "decomposed names": Odd(decomposed, tests=[f"{n}" for n in layouts.TEST]),
    "other case and suffix": Odd(renamed_files),
    "masks of RealityScan": Odd(masked("{name}.mask.png"), ("keep masks of 5 of 5",), 7),
    "masks of OpenMVS": Odd(masked("{stem}.mask.png"), ("psnr_valid leaves out",), 7),
    "masks of Metashape": Odd(masked("{stem}_mask.png"), masks=7),
    "masks of LichtFeld": Odd(masked("{stem}.png", "segmentation"), masks=7),
    "masks with a prefix": Odd(masked("mask_{stem}.png"), masks=7),
    "masks beside photos": Odd(masked("{name}.mask.png", "images"), ("keep masks of 5 of 5",), 7),
    "masks of NumPy": Odd(numpy_masks, ("not used: masks/ holds no mask: a mask of a.jpg is called a.png",)),
    "tests of 3DGS": Odd(listed_tests, ("sparse/0/test.txt names 2 of 7 photos",), kind="colmap"),
    "a point cloud": Odd(cloud, ("points from points3D.ply",), points=40),
    "more than it uses": Odd(
        more_than_it_uses,
        ("1 photo without a pose, left out: unplaced", "not used: depths/, poses_bounds"),
    ),
    "points of Blender": Odd(blender_with_points, ("points from points3d.ply", "drawn behind the model")),
    "a profile": Odd(tagged, ("2 photos: colours converted to sRGB from",)),
}


@pytest.mark.parametrize("odd", ODD.values(), ids=ODD)
def test_what_is_read_and_what_is_said(odd: Odd, tmp_path: Path) -> None:
    odd.make(tmp_path / "raw")
    done = import_scene(tmp_path / "raw", tmp_path / "scene", ImportSettings(kind=odd.kind))
    told = "\n".join(done.info["imported"]["notes"])
    for words in odd.says:
        assert words in told
    scene = load_scene(done.scene)
    assert [Path(view.name).stem for view in scene.test] == [name[:-4] for name in odd.tests]
    assert len(scene.views) == len(NAMES) and len(scene.points) == odd.points
    assert odd.masks < 0 or sum(view.keep_path is not None for view in scene.views) == odd.masks
    for view in scene.views if odd.masks > 0 else ():
        assert np.array_equal(load_keep(view) > 0, KEEP > 0)
    if not any(scene.background):
        order = sorted(scene.views, key=lambda view: view.name.replace("extra", "z").casefold())
        for index, view in enumerate(order):
            error = load_image_float(view.image_path) - layouts.photo(index) / 255
            assert np.abs(error).mean() < 0.01


def test_white_behind_the_photos_is_behind_the_model_too(tmp_path: Path) -> None:
    blender_with_points(tmp_path / "raw")
    scene = load_scene(import_scene(tmp_path / "raw", tmp_path / "scene").scene)
    assert scene.background == (1.0, 1.0, 1.0)
    assert (read_png_rgb(scene.train[0].image_path)[:4, :4] == 255).all()
    path = tmp_path / "scene/scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"background": [1, 2]}))
    with pytest.raises(AwError, match="background must be three whole numbers"):
        load_scene(tmp_path / "scene", verify=False)


def test_reduced_photos_that_show_something_else_are_refused(tmp_path: Path) -> None:
    root = plain(tmp_path / "raw")
    for index, name in enumerate(NAMES):
        small = cv2.resize(layouts.photo(index + 4), (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
        write_png(root / "images_2" / name, small)
    with pytest.raises(AwError, match=r"reduced photos .* do not show what their full photos"):
        load_scene(root, factor=2)
    for index, name in enumerate(NAMES):
        small = cv2.resize(layouts.photo(index), (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
        write_png(root / "images_2" / name, small)
    assert load_scene(root, factor=2).train[0].camera.width == WIDTH // 2


def test_a_photo_that_is_wholly_transparent_is_not_learnt(tmp_path: Path) -> None:
    wholly_transparent(tmp_path / "raw")
    scene = load_scene(import_scene(tmp_path / "raw", tmp_path / "scene").scene)
    keep = load_keep(scene.train[0])
    assert keep is not None and not keep.any()


def test_reduced_photos_of_several_sizes_are_refused(tmp_path: Path) -> None:
    root = plain(tmp_path / "raw")
    for index, name in enumerate(NAMES):
        size = (WIDTH, HEIGHT) if index == 3 else (WIDTH // 2, HEIGHT // 2)
        write_png(
            root / "images_2" / name, cv2.resize(layouts.photo(index), size, interpolation=cv2.INTER_AREA)
        )
    with pytest.raises(AwError, match=r"1 photos of .* are reduced otherwise"):
        load_scene(root, factor=2)


def test_adobe_rgb_is_converted_as_computed_by_hand() -> None:
    """Pure green and mid red: linear by the gamma 563/256, then the published matrices through XYZ (D65)."""
    codes = np.uint8([[[0, 255, 0], [128, 64, 32]]])
    adobe_xyz = np.array(
        [[0.57667, 0.18556, 0.18823], [0.29734, 0.62736, 0.07529], [0.02703, 0.07069, 0.99134]]
    )
    xyz_srgb = np.array(
        [[3.24045, -1.53714, -0.49853], [-0.96927, 1.87601, 0.04156], [0.05564, -0.20403, 1.05723]]
    )
    light = np.clip((codes / 255.0) ** (563 / 256) @ adobe_xyz.T @ xyz_srgb.T, 0, 1)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert np.abs(Colours(adobe=True).to_srgb(codes) - 255 * srgb).max() < 1


def test_other_folders_and_other_cameras_do_not_stand_in(tmp_path: Path) -> None:
    """A folder of masks with the photos' names, and equal names in the folders of a rig."""
    root = plain(tmp_path / "raw")
    (root / "images" / NAMES[0]).unlink()
    layouts.write_photos(root / "sam_masks")
    with pytest.raises(AwError, match=r"1 of 7 photos that the model registers are not in .*images"):
        import_scene(root, tmp_path / "scene", ImportSettings(kind="colmap"))
    rig = [f"cam{k}/{n}" for k in (0, 1) for n in ("a.png", "b.png")]
    model = layouts.make_model(rig)
    write_model(tmp_path / "rig/sparse/0", model)
    layouts.write_photos(tmp_path / "rig/images", rig)
    (tmp_path / "rig/sparse/0/test.txt").write_text("cam0/a.png\n")
    assert [view.name for view in load_scene(tmp_path / "rig").test] == ["cam0/a.png"]


def test_marked_masks_of_one_side_leave_the_photos_of_the_other_alone(tmp_path: Path) -> None:
    names = [f"{'train' if n in TRAIN else 'test'}/{n}" for n in NAMES]
    root = tmp_path / "raw"
    layouts.write_photos(root / "images", names)
    write_model(root / "sparse/0", layouts.make_model(names))
    layouts.write_lists(root, names[:5], names[5:])
    for name in names[:5]:
        write_png(root / "images" / f"{name[:-4]}_mask.png", KEEP)
    scene = load_scene(import_scene(root, tmp_path / "scene", ImportSettings(kind="colmap")).scene)
    assert sum(view.keep_path is not None for view in scene.views) == 5
