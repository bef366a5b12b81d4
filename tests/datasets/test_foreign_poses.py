"""Cameras as other tools export them, written here from each format's own definition.

Known points of the world must fall where the tool sees them, before and after our import takes the lens out.
"""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.readers import read_foreign, recognise
from ambiguous_wild.datasets.write import import_scene
from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera, ModelImage, points_without_tracks
from ambiguous_wild.io.images import pillow, read_gray
from ambiguous_wild.io.safe_pycolmap import pycolmap
from ambiguous_wild.io.scene_folder import load_scene

COUNT = 9
POINTS = np.array(
    [[x, y, 0.3 * y + 0.2 * x * x] for x in (-0.9, -0.3, 0.3, 0.9) for y in (-1, -0.4, 0.2, 0.8)]
)
FLIP = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera axes to OpenGL's


@dataclass
class Shot:
    """The truth of one photo; the world has z up."""

    name: str
    rotation: np.ndarray  # [3, 3], world to camera, OpenCV's axes
    centre: np.ndarray  # [3]
    size: tuple[int, int]
    pixels: np.ndarray = None  # [K, 2] px of POINTS, by the format's own lens

    def rays(self) -> np.ndarray:
        cam = (POINTS - self.centre) @ self.rotation.T
        return cam[:, :2] / cam[:, 2:]

    def to_world(self) -> np.ndarray:
        """[4, 4] camera to world, OpenGL's axes."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation.T @ FLIP, self.centre
        return pose


def shots(names: list[str], size: tuple[int, int] = (320, 240)) -> list[Shot]:
    """Cameras on an arc, each rolled, the last one upright where the format states each photo's size."""
    found = []
    for i, name in enumerate(names):
        turn = 0.2 * i - 0.7
        centre = np.array([4 * np.sin(turn), -4 * np.cos(turn), 1.5 + 0.1 * i])
        z = np.array([0.05, 0.02 * i, 0.2]) - centre
        x, y = np.cross(z, [0, 0, 1.0]), np.cross(z, np.cross(z, [0, 0, 1.0]))
        rotation = np.stack([axis / np.linalg.norm(axis) for axis in (x, y, z)])
        roll = Rotation.from_euler("z", 0.1 * i - 0.3).as_matrix()
        found.append(Shot(name, roll @ rotation, centre, size))
    return found


def brown(rays: np.ndarray, radial: list[float], p1: float, p2: float) -> np.ndarray:
    """x' = x (1 + k1 r^2 + ...) + p1 (r^2 + 2 x^2) + 2 p2 x y, as Agisoft and RealityScan state it."""
    x, y = rays.T
    r2 = x**2 + y**2
    gain = 1 + sum(k * r2 ** (i + 1) for i, k in enumerate(radial))
    return np.column_stack(
        [x * gain + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y, y * gain + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y]
    )


def write_photo(path: Path, shot: Shot) -> None:
    """A soft white dot at each point."""
    path.parent.mkdir(parents=True, exist_ok=True)
    columns, rows = np.meshgrid(np.arange(shot.size[0]) + 0.5, np.arange(shot.size[1]) + 0.5)
    image = np.zeros(columns.shape)
    for x, y in shot.pixels:
        image = np.maximum(image, np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 6))
    cv2.imwrite(str(path), np.round(255 * image).astype(np.uint8))


def write_points(path: Path) -> None:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n"
    head += "".join(f"property float {a}\n" for a in "xyz") + "end_header\n"
    path.write_text(head + "".join(f"{x} {y} {z}\n" for x, y, z in POINTS))


RADIAL, P1, P2 = [-0.2, 0.12, -0.05, 0.02], 0.003, -0.002


def realityscan(
    root: Path, header: str = "heading,pitch,roll,f,px,py", spreadsheet: bool = False
) -> list[Shot]:
    """Angles by the rows of RealityCapture's own world-to-camera matrix; lengths in longer sides."""
    lines = [f"#cameras {COUNT}", f"#name,x,y,alt,{header},k1,k2,k3,k4,t1,t2"]
    truth = shots([f"IMG_{i}.png" for i in range(COUNT)])
    truth[-1].size = (240, 320)
    for shot in truth:
        r = shot.rotation
        angles = np.arctan2(-r[1, 0], -r[1, 1]), -np.arcsin(r[1, 2]), np.arctan2(-r[0, 2], -r[2, 2])
        f, px, py = 34.5, 0.012, -0.008
        shot.pixels = (f / 36 * brown(shot.rays(), RADIAL, P1, P2) + [px, py]) * max(shot.size)
        shot.pixels += np.array(shot.size) / 2
        numbers = [*shot.centre, *np.degrees(angles), f, px, py, *RADIAL, P1, P2]
        lines.append(",".join([shot.name, *map(repr, map(float, numbers))]))
        write_photo(root / "images" / shot.name, shot)
    text = "\r\n".join(lines)
    if spreadsheet:  # as one saves it in half of Europe
        (root / "Cameras.CSV").write_text(text.replace(",", ";").replace(".", ",").replace(",png", ".png"))
    else:
        (root / "cameras.csv").write_text(text, encoding="utf-8-sig")
    write_points(root / "points.ply")
    return truth


def metashape(root: Path, kind: str = "frame", place: str = "component") -> list[Shot]:
    """Two sensors, a group, a photo not aligned, labels without extension; chunk to world by `place`."""
    turn, scale, shift = Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix(), 2.5, np.array([3.0, -1.0, 0.5])
    truth, cameras = shots([f"DSC.{i:04d}.png" for i in range(COUNT)]), []
    lenses = [(300.0, 4.0, -3.0, 2.0, -1.5), (310.0, -2.0, 5.0, 0.0, 0.0)]  # f, cx, cy, b1, b2
    for i, shot in enumerate(truth):
        f, cx, cy, b1, b2 = lenses[i % 2]
        rays = shot.rays()
        if kind != "frame":
            length = np.linalg.norm(rays, axis=1, keepdims=True)
            rays = rays * np.arctan(length) / length
        x, y = brown(rays, RADIAL, P1, P2).T
        u, v = shot.size[0] / 2 + cx + x * f + x * b1 + y * b2, shot.size[1] / 2 + cy + y * f
        shot.pixels = np.column_stack([u, v])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T @ shot.rotation.T, turn.T @ (shot.centre - shift) / scale
        text = " ".join(map(repr, map(float, pose.ravel())))
        label = shot.name.removesuffix(".png")
        cameras.append(
            f'<camera id="{i}" sensor_id="{i % 2}" component_id="0" label="{label}">'
            f"<transform>{text}</transform><orientation>1</orientation></camera>"
        )
        write_photo(root / "images" / shot.name, shot)
    sensors = ""
    for i, values in enumerate(lenses):
        stated = dict(zip(("f", "cx", "cy", "b1", "b2"), values)) | {"p1": P1, "p2": P2}
        stated |= {f"k{j + 1}": k for j, k in enumerate(RADIAL)}
        sensors += (
            f'<sensor id="{i}" label="camera" type="{kind}"><resolution width="320" height="240"/>'
            f'<calibration type="{kind}" class="initial"><f>1</f></calibration>'
            f'<calibration type="{kind}" class="adjusted"><resolution width="320" height="240"/>'
            + "".join(f"<{k}>{v!r}</{k}>" for k, v in stated.items())
            + "</calibration></sensor>"
        )
    move = f"<transform><rotation>{' '.join(map(repr, map(float, turn.ravel())))}</rotation>"
    move += f"<translation>3 -1 0.5</translation><scale>{scale}</scale></transform>"
    own, whole = (move, "") if place == "component" else ("", move)
    (root / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1">'
        f'<sensors>{sensors}</sensors><components><component id="0">{own}</component></components><cameras>'
        f'<group label="a">{"".join(cameras[:4])}</group>{"".join(cameras[4:])}'
        '<camera id="99" sensor_id="0" label="lost"/></cameras><reference>LOCAL_CS["m"]</reference>'
        f"{whole}</chunk></document>"
    )
    write_points(root / "points.ply")
    return truth


def with_pinholes(truth: list[Shot], change: float = 0.0) -> list[tuple[Shot, tuple[float, ...]]]:
    """The photos with their own fx, fy, cx, cy."""
    lenses = []
    for i, shot in enumerate(truth):
        fx, fy, cx, cy = 300.0 + change * i, 301.0 + change * i, 158.5 + change * i, 121.5
        shot.pixels = shot.rays() * [fx, fy] + [cx, cy]
        lenses.append((shot, (fx, fy, cx, cy)))
    return lenses


def polycam(root: Path, corrected: str = "corrected_") -> list[Shot]:
    truth = shots([f"17254{i}.jpg" for i in range(COUNT)])
    for shot, lens in with_pinholes(truth, 1.5):
        write_photo(root / "keyframes" / f"{corrected}images" / shot.name, shot)
        data = dict(zip(("fx", "fy", "cx", "cy"), lens)) | {"width": 320, "height": 240, "blur_score": 99.0}
        data |= {f"t_{i}{j}": shot.to_world()[i, j] for i in range(3) for j in range(4)}
        path = root / "keyframes" / f"{corrected}cameras" / f"{Path(shot.name).stem}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(data))
    return truth


def record3d(root: Path, name: str = "metadata.json", each: bool = True) -> list[Shot]:
    truth = shots([f"{i}.jpg" for i in range(COUNT)])
    lenses = with_pinholes(truth, 1.5 if each else 0.0)
    poses = [[*Rotation.from_matrix(s.to_world()[:3, :3]).as_quat(), *s.centre] for s in truth]
    fx, fy, cx, cy = lenses[0][1]
    data = {"w": 320, "h": 240, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "poses": poses, "fps": 60}
    if each:
        data["perFrameIntrinsicCoeffs"] = [lens for _, lens in lenses]
    for shot in truth:
        write_photo(root / ("rgb" if each else "rgbd") / shot.name, shot)
    (root / name).write_text(json.dumps(data))
    return truth


def nerfcapture(root: Path, studio: bool = False, folder: str = "images/") -> list[Shot]:
    """Its common camera is a place holder: each frame states its own; file_path lacks the extension."""
    truth = shots([f"{i}.png" for i in range(COUNT)])
    frames = []
    for shot, lens in with_pinholes(truth, 1.5):
        if studio:
            shot.pixels = brown(shot.rays(), RADIAL, P1, P2) * lens[:2] + lens[2:]
        write_photo(root / "images" / shot.name, shot)
        frame = dict(zip(("fl_x", "fl_y", "cx", "cy"), lens)) | {"w": 320, "h": 240, "timestamp": 1.5}
        path = f"{folder}{Path(shot.name).stem}"
        frames.append({"file_path": path, "depth_path": f"{path}.depth.png"} | frame)
        frames[-1]["transform_matrix"] = shot.to_world().tolist()
    common = {"fl_x": 1.0, "fl_y": 1.0, "cx": 320, "cy": 240, "w": 320, "h": 240, "depth_integer_scale": 1.0}
    if studio:  # nerfstudio's lens, with OpenCV's order of p1 and p2
        common |= {"camera_model": "OPENCV", "p1": P2, "p2": P1} | {
            f"k{i + 1}": k for i, k in enumerate(RADIAL)
        }
    (root / "transforms.json").write_text(json.dumps({**common, "frames": frames}))
    return truth


def feed_forward(root: Path, model: str = "PINHOLE", share: float = 1.0) -> list[Shot]:
    """sparse/ of VGGT and Depth Anything 3: a camera a photo, points without tracks, leftovers."""
    truth = shots([f"{i}.png" for i in range(COUNT)])
    cameras, images = {}, {}
    for i, (shot, (f, _, cx, cy)) in enumerate(with_pinholes(truth), start=1):
        shot.pixels = shot.rays() * f + [cx, cy]
        write_photo(root / "images" / shot.name, shot)
        params = np.array((f, cx, cy) if model == "SIMPLE_PINHOLE" else (f, f, cx, cy)) * share
        params = np.append(params, np.zeros(8 if model == "FULL_OPENCV" else 0))
        cameras[i] = ModelCamera(i, model, round(320 * share), round(240 * share), tuple(params))
        q = Rotation.from_matrix(shot.rotation).as_quat()[[3, 0, 1, 2]]
        none = np.zeros((0, 2)), np.zeros(0, np.int64)
        images[i] = ModelImage(i, q, -shot.rotation @ shot.centre, i, shot.name, *none)
    points = points_without_tracks(POINTS, np.full(POINTS.shape, 99, np.uint8))
    write_model(root / "sparse", ColmapModel(cameras, images, points))
    reconstruction = pycolmap.Reconstruction(str(root / "sparse"))  # with rigs and frames, as the demos write
    reconstruction.write(str(root / "sparse"))
    reconstruction.write_text(str(root / "sparse"))
    write_points(root / "sparse" / "points.ply")
    return truth


FORMATS = {
    "realityscan": (realityscan, {}),
    "realityscan 2.2": (realityscan, {"header": "yaw,pitch,roll,f_35mm,px_norm,py_norm"}),
    "realityscan spreadsheet": (realityscan, {"spreadsheet": True}),
    "metashape": (metashape, {}),
    "metashape 1": (metashape, {"place": "chunk"}),
    "metashape fisheye": (metashape, {"kind": "fisheye"}),
    "metashape 2.3 fisheye": (metashape, {"kind": "equidistant_fisheye"}),
    "polycam": (polycam, {}),
    "polycam raw": (polycam, {"corrected": ""}),
    "record3d": (record3d, {}),
    "record3d r3d": (record3d, {"name": "metadata", "each": False}),
    "instant-ngp nerfcapture": (nerfcapture, {}),
    "instant-ngp colmap2nerf": (nerfcapture, {"folder": "../../data/fox/images/"}),
    "instant-ngp Windows": (nerfcapture, {"folder": "C:\\me\\images\\"}),
    "instant-ngp absolute": (nerfcapture, {"folder": "/home/me/images/"}),
    "nerfstudio": (nerfcapture, {"studio": True}),
    "colmap vggt": (feed_forward, {}),
    "colmap vggt ba": (feed_forward, {"model": "SIMPLE_PINHOLE"}),
    "colmap realityscan": (feed_forward, {"model": "FULL_OPENCV"}),  # photos that it has undistorted
    "colmap reduced": (feed_forward, {"share": 0.5}),
}


def written(name: str, root: Path) -> list[Shot]:
    root.mkdir()
    write, options = FORMATS[name]
    return write(root, **options)


@pytest.mark.parametrize("name", FORMATS)
def test_known_points_fall_where_the_tool_sees_them(name: str, tmp_path: Path) -> None:
    truth = {shot.name: shot for shot in written(name, tmp_path / "theirs")}
    kind = name.split()[0]
    assert recognise(tmp_path / "theirs")[0] == kind
    scene = read_foreign(tmp_path / "theirs")[0]
    assert sorted(i.name for i in scene.model.images.values()) == sorted(truth)
    for image in scene.model.images.values():
        shot, camera = truth[image.name], scene.model.cameras[image.camera_id]
        pose = image.cam_from_world()
        np.testing.assert_allclose(pose[:3, :3], shot.rotation, atol=1e-6)
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], shot.centre, atol=1e-6)
        lens = pycolmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
        )
        seen = np.asarray(lens.img_from_cam(POINTS @ pose[:3, :3].T + pose[:3, 3]))
        seen[:, 0] += camera.shear * (seen[:, 1] - lens.principal_point_y)
        seen *= np.array(shot.size) / (camera.width, camera.height)
        assert np.abs(seen - shot.pixels).max() < 0.05, image.name
    if kind in ("realityscan", "metashape", "colmap"):
        np.testing.assert_allclose(scene.model.points.xyz, POINTS, atol=1e-5)


def test_a_table_is_read_once_by_its_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ambiguous_wild.datasets.readers import realityscan as reader

    root = tmp_path / "theirs"
    written("realityscan", root)
    (root / "other.csv").write_text("a,b\n1,2\n")
    read: list[Path] = []
    monkeypatch.setattr(reader, "read_text", lambda path: read.append(path) or path.read_text("utf-8-sig"))
    read_foreign(root, "realityscan")
    assert sorted(read) == sorted(root.glob("*.csv")) and len(read) == 2


@pytest.mark.parametrize(
    "name", ["realityscan", "metashape", "metashape fisheye", "colmap reduced", "record3d"]
)
def test_imported_photos_show_known_points_where_their_cameras_see_them(name: str, tmp_path: Path) -> None:
    """Dots drawn through the tool's lens: the pinhole cameras of the import must meet their centres."""
    written(name, tmp_path / "theirs")
    import_scene(tmp_path / "theirs", tmp_path / "scene", jobs=1)
    errors = []
    for view in load_scene(tmp_path / "scene", raw=True).views:
        image, camera = read_gray(view.image_path).astype(float), view.camera
        cam = POINTS @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        for x, y in cam[:, :2] / cam[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]:
            column, row = int(x), int(y)
            if not (6 <= column < camera.width - 6 and 6 <= row < camera.height - 6):
                continue
            window = image[row - 5 : row + 6, column - 5 : column + 6]
            window = np.where(window > 60, window, 0)
            offsets = np.arange(-5, 6) + 0.5
            centre = [(window.sum(0) @ offsets), (window.sum(1) @ offsets)] / window.sum()
            errors.append(centre - [x - column, y - row])
    assert len(errors) > 100 and np.abs(errors).max() < 0.25


def edit(name: str, *changes: tuple[str, str]):
    """A file of the dataset, each text in it replaced once."""

    def spoil(root: Path) -> None:
        path = next(root.rglob(name))
        text = path.read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path.write_text(text, encoding="utf-8")

    return spoil


def turned(root: Path) -> None:
    path = root / "images" / "IMG_0.png"
    image = pillow().open(path)
    exif = image.getexif()
    exif[274] = 6
    image.save(path, exif=exif)


BOMB = '<!DOCTYPE a [<!ENTITY b "bbbb"><!ENTITY c "&b;&b;">]><document'
MOVE = "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0 0 0</translation><scale>1</scale>"
XML, CSV, R3D = "cameras.xml", "cameras.csv", "metadata.json"
LENS = ",-0.2,0.12,-0.05,0.02,0.003,-0.002"
REFUSED = {
    "entities": ("metashape", edit(XML, ("<document", BOMB)), "DOCTYPE"),
    "cut": ("metashape", edit(XML, ("</chunk>", "")), "not as Metashape writes it"),
    "panorama": ("metashape", edit(XML, ('type="frame"', 'type="spherical"')), "splits 360"),
    "equisolid": ("metashape", edit(XML, ('type="frame"', 'type="equisolid_fisheye"')), "equidistant"),
    "p3": ("metashape", edit(XML, ("</p2>", "</p2><p3>1e-4</p3>")), "p3 or p4"),
    "rig": ("metashape", edit(XML, ('<camera id="99"', '<camera id="99" master_id="1"')), "multi-camera"),
    "chunks": ("metashape", edit(XML, ("</chunk>", "</chunk><chunk><cameras/></chunk>")), "2 chunks"),
    "moves": ("metashape", edit(XML, ("</reference>", f"</reference>{MOVE}</transform>")), "different"),
    "parts": ("metashape 1", edit(XML, *[("rotation", "r")] * 2, ('t_id="0"', 't_id="1"')), "2 components"),
    "mirrored": ("metashape", edit(XML, ("<scale>", "<scale>-")), "scaled or mirrored"),
    "folded lens": ("metashape", edit(XML, ("<k4>0.02", "<k4>-90.0")), "folds"),
    "two XML": ("metashape", lambda r: shutil.copy(r / XML, r / "b.xml"), "b.xml, cameras.xml"),
    "lost photo": ("metashape", lambda r: (r / "images/DSC.0003.png").unlink(), "1 of 9 photos"),
    "same labels": ("metashape", edit(XML, ("DSC.0001", "DSC.0002")), "twice"),
    "division": ("realityscan", edit(CSV, (LENS, ",-0.2,0,0,0,0,0")), "division"),
    "EXIF": ("realityscan", turned, "turned by its EXIF"),
    "short line": ("realityscan", edit(CSV, (LENS, ",0")), "not as RealityScan"),
    "nan": ("realityscan", edit(CSV, ("34.5", "nan")), "nan"),
    "no rotation": ("record3d", edit(R3D, ('"poses": [[', '"poses": [[0, 0, 0, 0, 1, 1, 1], [')), "Record3D"),
    "texts": ("record3d", edit(R3D, (', 1], "poses"', ', "1"], "poses"')), "not as Record3D"),
    "lenses": ("record3d", edit(R3D, ('Coeffs": [', 'Coeffs": [[1, 2, 3, 4], ')), "not as Record3D"),
    "no t_00": ("polycam", edit("172540.json", ("t_00", "u_00")), "172540.json is not as Polycam"),
    "no cameras": ("polycam", lambda r: shutil.rmtree(r / "keyframes/corrected_cameras"), "developer mode"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    name, spoil, told = REFUSED[case]
    written(name, tmp_path / "theirs")
    spoil(tmp_path / "theirs")
    with pytest.raises(AwError, match=re.escape(told)) as caught:
        read_foreign(tmp_path / "theirs", name.split()[0])
    assert "\n" not in str(caught.value)


def test_labels_with_paths_and_folders_below_find_their_photos(tmp_path: Path) -> None:
    truth = written("metashape", tmp_path / "theirs")
    folder = tmp_path / "theirs" / "images"
    (folder / "front").mkdir()
    for shot in truth[:5]:
        (folder / shot.name).rename(folder / "front" / shot.name)
    edit(XML, ('label="DSC.0000"', 'label="/home/me/DSC.0000.png"'), ("DSC.0001", "C:\\me\\DSC.0001.png"))(
        tmp_path / "theirs"
    )
    scene = read_foreign(tmp_path / "theirs")[0]
    wanted = [f"front/{s.name}" for s in truth[:5]] + [s.name for s in truth[5:]]
    assert sorted(scene.split) == sorted(wanted)
