"""One small native scene, and the same scene in every public layout."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera
from ambiguous_wild.io.images import write_png
from ambiguous_wild.io.ply import write_point_ply
from tests.io.model_maker import tracked

WIDTH, HEIGHT = 64, 36
FX, FY, CX, CY = 70.0, 71.0, 31.5, 18.5
TRAIN = [f"clutter{i:03d}.png" for i in range(5)]
TEST = [f"extra{i:03d}.png" for i in range(2)]
NAMES = [*TRAIN, *TEST]
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def photo(index: int) -> np.ndarray:
    """[H, W, 3] uint8 of smooth waves that move with the camera."""
    x, y = np.meshgrid(np.arange(WIDTH) + 6.0 * index, np.arange(HEIGHT))
    waves = [np.sin(x / 5 + y / 9), np.cos(y / 4 - x / 11), np.sin(x / 3) * np.cos(y / 6)]
    return np.round(127 + 110 * np.stack(waves, axis=-1)).astype(np.uint8)


def make_model(names: list[str] = NAMES, *, points: int = 60, cameras: int = 1) -> ColmapModel:
    """Cameras that step sideways and turn; points with exact tracks, the last ones of test photos."""
    rng = np.random.default_rng(3)
    xyz = np.column_stack([rng.uniform(*ends, points) for ends in ((-1.5, 2.5), (-1, 1), (4, 6))])
    lens = (FX, FY, CX, CY)
    lenses = {k: ModelCamera(k, "PINHOLE", WIDTH, HEIGHT, lens) for k in range(1, cameras + 1)}
    poses = []
    for k, name in enumerate(names):
        q = np.array([np.cos(0.01 * k), 0.0, np.sin(0.01 * k), 0.0])
        # The last ten points are seen in test photos alone.
        seen = np.flatnonzero((np.arange(points) < points - 10) | (name in TEST or "extra" in name))
        poses.append((k + 1, q, np.array([-0.3 * k, 0.05 * k, 0.1]), 1 + k % cameras, name, seen))
    return tracked(lenses, lens, poses, xyz, 1, rng)


def write_photos(folder: Path, names: list[str] = NAMES) -> None:
    for index, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            write_png(path, photo(index))
        else:
            data = cv2.imencode(".jpg", photo(index)[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1]
            path.write_bytes(data.tobytes())


def write_lists(root: Path, train: list[str] = TRAIN, test: list[str] = TEST) -> None:
    (root / "train_list.txt").write_text("".join(f"{n}\n" for n in train))
    (root / "test_list.txt").write_text("".join(f"{n}\n" for n in test))


def native(root: Path) -> Path:
    """The scene as `aw` reads it without an import."""
    write_photos(root / "images")
    write_model(root / "sparse" / "0", make_model())
    write_lists(root)
    return root


def robustnerf(root: Path) -> Path:
    write_photos(root / "images")
    write_photos(root / "images", ["clean000.png"])
    write_model(root / "sparse" / "0", make_model([*NAMES, "clean000.png"]))
    return root


def drone(root: Path) -> Path:
    """Names without extension in the lists, the instances of a segmentation in masks/."""
    native(root)
    write_lists(root, [Path(n).stem for n in TRAIN], [Path(n).stem for n in TEST])
    (root / "masks").mkdir()
    (root / "masks" / "masks.json").write_text("{}")
    return root


def dualsplat(root: Path) -> Path:
    native(root)
    (root / "pseudo_masks").mkdir()
    np.save(root / "pseudo_masks" / "clutter000.npy", np.zeros((HEIGHT, WIDTH), bool))
    return root


def phototourism(root: Path) -> Path:
    """dense/, no 0/, one camera a photo, wrong ids, a row without an id."""
    write_photos(root / "dense" / "images", [*NAMES, "unlisted.png"])
    write_model(root / "dense" / "sparse", make_model([*NAMES, "unlisted.png"], cameras=8))
    rows = ["filename\tid\tsplit\tdataset"]
    rows += [f"{n}\t{900 - i}\t{'train' if n in TRAIN else 'test'}\ttoy" for i, n in enumerate(NAMES)]
    (root / "toy.tsv").write_text("\n".join([*rows, "unlisted.png\t\ttrain\ttoy"]) + "\n")
    return root


def nerfbaselines(root: Path, protocol: str = "default") -> Path:
    native(root)
    info = {
        "loader": "colmap",
        "loader_kwargs": {"images_path": "images"},
        "scene": "toy",
        "evaluation_protocol": protocol,
    }
    (root / "nb-info.json").write_text(json.dumps(info))
    return root


def frames(folder: str, names: list[str] = NAMES) -> list[dict]:
    model = make_model(names)
    return [
        {
            "file_path": f"{folder}{image.name}",
            "transform_matrix": (np.linalg.inv(image.cam_from_world()) @ OPENGL).tolist(),
        }
        for image in model.images.values()
    ]


def shared_camera() -> dict:
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY}
    return lens | dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)


def instant_ngp(root: Path) -> Path:
    write_photos(root / "images")
    (root / "transforms.json").write_text(json.dumps({**shared_camera(), "frames": frames("./images/")}))
    write_lists(root)
    return root


def nerfstudio(root: Path) -> Path:
    """Names by side in the file, a point cloud, keep masks."""
    write_photos(root / "images")
    listed = frames("images/")
    write_png(
        root / "masks" / "m.png",
        np.where(np.arange(WIDTH) < 20, 0, 255).astype(np.uint8)[None].repeat(HEIGHT, 0),
    )
    listed[0]["mask_path"] = "masks/m.png"
    points = make_model().points
    write_point_ply(root / "sparse_pc.ply", points.xyz, points.rgb)
    data = {
        **shared_camera(),
        "camera_model": "OPENCV",
        "ply_file_path": "sparse_pc.ply",
        "frames": listed,
        "train_filenames": [f"images/{n}" for n in TRAIN],
        "test_filenames": [f"images/{n}" for n in TEST],
        "val_filenames": [],
    }
    (root / "transforms.json").write_text(json.dumps(data))
    return root


def blender(root: Path) -> Path:
    """RGBA photos, opaque but for one corner; square pixels, the centre in the middle."""
    for side, names in (("train", TRAIN), ("test", TEST)):
        (root / side).mkdir(parents=True)
        rows = []
        for frame in frames("", NAMES):
            name = frame["file_path"]
            if name not in names:
                continue
            rgba = np.dstack([photo(NAMES.index(name))[:, :, ::-1], np.full((HEIGHT, WIDTH), 255, np.uint8)])
            rgba[:4, :4, 3] = 0
            cv2.imwrite(str(root / side / name), rgba)
            rows.append({**frame, "file_path": f"./{side}/{Path(name).stem}"})
        data = {"camera_angle_x": 2 * float(np.arctan(WIDTH / 2 / FX)), "frames": rows}
        (root / f"transforms_{side}.json").write_text(json.dumps(data))
    return root


def on_the_go(root: Path) -> Path:
    """The original release with a COLMAP model of one's own; positions count sorted names."""
    write_photos(root / "images")
    listed = frames("images/")
    data = {**shared_camera(), "frames": listed[::-1]}
    (root / "transforms.json").write_text(json.dumps(data))
    order = sorted(NAMES)
    split = {"clutter": [order.index(n) for n in TRAIN], "extra": [order.index(n) for n in TEST]}
    (root / "split.json").write_text(json.dumps(split))
    write_model(root / "sparse" / "0", make_model())
    return root


def on_the_go_undistorted(root: Path) -> Path:
    """A copy with lists and images_8; its name says what it is."""
    native(root)
    shutil.copytree(root / "images", root / "images_8")
    for path in (root / "images_8").iterdir():
        pixels = cv2.imread(str(path))
        cv2.imwrite(
            str(path), cv2.resize(pixels, (WIDTH // 8, round(HEIGHT / 8)), interpolation=cv2.INTER_AREA)
        )
    return root


def edited(layout, file: str, change):
    """A function that writes the layout, and changes the data of one of its JSON files."""

    def write(root: Path) -> Path:
        layout(root)
        data = json.loads((root / file).read_text())
        (root / file).write_text(json.dumps(change(data) or data))
        return root

    return write


LAYOUTS = {
    "robustnerf": robustnerf,
    "drone": drone,
    "dualsplat": dualsplat,
    "photo-tourism": phototourism,
    "nerfbaselines": nerfbaselines,
    "instant-ngp": instant_ngp,
    "nerfstudio": nerfstudio,
    "blender": blender,
    "on-the-go": on_the_go,
    "colmap": native,
}
