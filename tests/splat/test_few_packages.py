"""A machine that holds torch, gsplat, numpy, safetensors and one reader of images: a scene trains there."""

import io
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from ambiguous_wild.core import AwError
from ambiguous_wild.io import images, pillow_fallback
from ambiguous_wild.splat import device as devices
from ambiguous_wild.splat.neighbours import nearest_three, nearest_three_torch
from tests.tiny_scene import write_tiny_scene

ROOT = Path(__file__).resolve().parents[2]
ABSENT = (
    "pycolmap", "OpenImageIO", "numba", "scipy", "skimage", "pandas", "matplotlib", "yaml", "click", "tqdm",
)  # fmt: skip
# Refuses what is absent by name, also below a package that is there.
BLOCKER = """
import importlib.util
import sys

class Absent:
    names = set({absent!r})

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

def found(name, package=None, look=importlib.util.find_spec):
    return None if name.partition(".")[0] in Absent.names else look(name, package)

importlib.util.find_spec = found  # who only asks is told that it is not there
sys.meta_path.insert(0, Absent())
sys.path.insert(0, {root!r})
"""
TRAIN = """
import importlib
from pathlib import Path
import pytest, torch
from ambiguous_wild.harness import train_alone
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from tests.splat import fake_gsplat

scene, runs = load_scene({scene!r}), Path({runs!r})
entry = get_method("3dgs")
with fake_gsplat.installed(pytest.MonkeyPatch()):
    config = TrainConfig(iterations=3, resolution="full")
    cell = train_alone.Cell(entry, entry.options(), scene, train_alone.scene_identity(scene), config)
    lines = []
    folder = train_alone.train_alone(cell, runs, lines.append)
    print(lines[-1])
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=runs)
    trainer = Trainer(data, entry.build(entry.options()), config, folder=folder)
    assert trainer.resume() and trainer.iteration == 3 and trainer.done
    start = Trainer(data, entry.build(None), config, folder=runs).gaussians
    for name in ("means", "log_scales", "opacity_logits", "sh0"):
        assert float((getattr(trainer.gaussians, name) - getattr(start, name)).abs().max()) > 0, name
print(sorted(p.relative_to(runs).as_posix() for p in folder.rglob("*") if p.is_file()))
print(sorted(set(sys.modules) & set(Absent.names)))
"""


def run(code, *, absent, **names):
    code = BLOCKER.format(absent=sorted(absent), root=str(ROOT)) + code.format(**names)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd="/")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    root = write_tiny_scene(tmp_path_factory.mktemp("few") / "scene")
    (root / "masks" / "train").mkdir(parents=True)
    images.write_png(root / "masks" / "train" / "train_1.png", np.full((48, 64), 255, np.uint8))
    return root


def test_a_scene_trains_and_is_rendered_with_pillow_alone(scene, tmp_path):
    done = run(TRAIN, absent=(*ABSENT, "cv2"), scene=str(scene), runs=str(tmp_path / "runs"))
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("100 %: iteration 3, ") and lines[0].endswith(" 400 Gaussians")
    for name in ("point_cloud.ply", "renders/test/test_0.png", "timeline.csv", "config.yaml"):
        assert f"scene/3dgs/seed0/{name}" in lines[1]
    assert lines[2] == "[]"
    render = images.read_png_rgb(tmp_path / "runs/scene/3dgs/seed0/renders/test/test_0.png")
    assert render.shape == (48, 64, 3) and render.std() > 5


MASKED = """
from dataclasses import replace
from pathlib import Path
import pytest
from ambiguous_wild.harness import train_alone
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.splat.pace import TrainConfig
from tests.splat import fake_gsplat

scene, runs = load_scene({scene!r}), Path({runs!r})
entry = get_method("robustsplat")
with fake_gsplat.installed(pytest.MonkeyPatch()):
    config = TrainConfig(iterations=3, resolution="full")
    options = replace(entry.options(), mask_start=0.0, min_mask_start=1)
    cell = train_alone.Cell(entry, options, scene, train_alone.scene_identity(scene), config)
    lines = []
    train_alone.train_alone(cell, runs, lines.append)
    print(lines[-1])
"""


def test_robustsplat_learns_its_masks_there_too(scene, tmp_path):
    done = run(MASKED, absent=(*ABSENT, "cv2"), scene=str(scene), runs=str(tmp_path / "runs"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("100 %: iteration 3, ")


COMMAND = """
from ambiguous_wild.harness.train_alone import main

for words in {lines!r}:
    try:
        main(words)
    except SystemExit as end:
        assert end.code == 2
"""


def test_what_lacks_is_one_line_each(scene, tmp_path):
    common = [str(scene), "-o", str(tmp_path / "runs"), "--device", "cpu"]
    lines = [common, [*common, "--method", "refinesplat"], [*common, "--method", "3dsg"]]
    done = run(COMMAND, absent=ABSENT, lines=lines)
    plain, refined, misspelt = done.stderr.splitlines()
    install = f", which is not installed: {sys.executable} -m pip install "
    assert plain.startswith("error: 3dgs on the cpu needs numba" + install + "numba")
    assert refined.startswith("error: refinesplat on the cpu needs ") and install in refined
    assert misspelt.startswith("error: unknown method '3dsg': did you mean '3dgs'?")


def test_the_blocker_blocks():
    # The tests above would pass on everything if it did not.
    done = run("import scipy.spatial", absent=ABSENT)
    assert "ModuleNotFoundError: No module named 'scipy" in done.stderr


# -- pictures -------------------------------------------------------------------------------------


def png_of(picture, **options):
    file = io.BytesIO()
    picture.save(file, "PNG", **options)
    return file.getvalue()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Pictures of every kind that a scene holds, by name."""
    rng = np.random.default_rng(1)
    rgba = rng.integers(0, 256, (9, 7, 4), dtype=np.uint8)
    rgb, grey = np.ascontiguousarray(rgba[..., :3]), np.ascontiguousarray(rgba[..., 0])
    soft = io.BytesIO()
    Image.fromarray(cv2.GaussianBlur(rgb, (0, 0), 2)).save(soft, "JPEG", quality=95)
    contents = {
        "rgb.png": png_of(Image.fromarray(rgb)),
        "rgba.png": png_of(Image.fromarray(rgba)),
        "grey.png": png_of(Image.fromarray(grey)),
        "deep_grey.png": cv2.imencode(".png", rng.integers(0, 65536, (9, 7), dtype=np.uint16))[1].tobytes(),
        "palette.png": png_of(Image.fromarray(rgb).quantize(7)),
        "bits.png": png_of(Image.fromarray(grey > 100)),
        "photo.jpg": soft.getvalue(),
    }
    folder = tmp_path_factory.mktemp("pictures")
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return sorted(folder.iterdir())


READERS = (images.read_png_rgb, images.load_image_float, images.image_size)
MASKS = ("grey.png", "deep_grey.png", "bits.png")


def test_pillow_reads_the_pixels_that_opencv_reads(files, monkeypatch):
    by_opencv = [[read(path) for read in READERS] for path in files]
    masks = [images.read_gray(path) for path in files if path.name in MASKS]
    monkeypatch.setattr(images, "_opencv", lambda: None)
    for path, wanted in zip(files, by_opencv, strict=True):
        for read, expected in zip(READERS, wanted, strict=True):
            assert np.array_equal(read(path), expected), (path.name, read.__name__)
    for path, expected in zip([p for p in files if p.name in MASKS], masks, strict=True):
        assert np.array_equal(images.read_gray(path), expected), path.name


@pytest.mark.parametrize("shape", [(5, 6, 3), (5, 6)])
def test_what_pillow_writes_is_read_back(shape, tmp_path, monkeypatch):
    image = np.random.default_rng(2).integers(0, 256, shape, dtype=np.uint8)
    with monkeypatch.context() as patch:
        patch.setattr(images, "_opencv", lambda: None)
        images.write_png(tmp_path / "a.png", image)
        images.write_png(tmp_path / "b.png", image)
    read = images.read_gray if len(shape) == 2 else images.read_png_rgb
    assert np.array_equal(read(tmp_path / "a.png"), image)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_what_pillow_cannot_keep_is_refused(tmp_path, monkeypatch):
    deep = np.random.default_rng(3).integers(0, 65536, (4, 4, 3), dtype=np.uint16)
    images.write_png(tmp_path / "deep.png", deep)
    (tmp_path / "cut.png").write_bytes((tmp_path / "deep.png").read_bytes()[:60])
    monkeypatch.setattr(images, "_opencv", lambda: None)
    with pytest.raises(AwError, match=r"deep\.png is 16-bit colour.* pip install opencv"):
        images.load_image_float(tmp_path / "deep.png")
    with pytest.raises(AwError, match=r"cut\.png: it is empty, cut short"):
        images.read_png_rgb(tmp_path / "cut.png")
    with pytest.raises(AwError, match="16-bit colour"):
        images.write_png(tmp_path / "new.png", deep)
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(AwError, match=r"neither OpenCV nor Pillow .* pip install"):
        pillow_fallback.encode_png(np.zeros((2, 2), np.uint8))


# -- neighbours -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["even", "clustered", "coincident", "line", "outlier"])
@pytest.mark.parametrize("count", [4, 300, 3000])
def test_torch_finds_the_neighbours_that_scipy_finds(kind, count):
    rng = np.random.default_rng(count)
    xyz = rng.normal(size=(count, 3)) if kind != "even" else rng.uniform(size=(count, 3))
    if kind == "clustered":
        xyz = xyz * 0.01 + rng.integers(0, 9, (count, 1)) * np.array([10.0, 3.0, 0.0])
    if kind == "coincident":
        xyz[: count // 2] = xyz[0]
    if kind == "line":
        xyz[:, 1:] = 2.0
    if kind == "outlier":
        xyz[count // 3] = 1e5
    expected = nearest_three(xyz)
    found = nearest_three_torch(torch.from_numpy(xyz)).numpy()
    assert np.allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_on_an_accelerator_and_without_scipy_torch_looks(monkeypatch):
    xyz = np.random.default_rng(0).normal(size=(20, 3))
    expected = nearest_three(xyz)
    asked = []
    monkeypatch.setattr(
        "ambiguous_wild.splat.neighbours.nearest_three_torch", lambda p: asked.append(1) or p * 0
    )
    assert np.array_equal(nearest_three(xyz), expected) and not asked
    with monkeypatch.context() as patch:
        patch.setattr(devices, "accelerated", lambda device: True)
        assert not nearest_three(xyz).any() and len(asked) == 1
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    assert not nearest_three(xyz).any() and len(asked) == 2
