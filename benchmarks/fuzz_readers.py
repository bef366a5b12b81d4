"""Every reader of files that come from others: valid samples, how to damage them, and the call.

The calls are those the commands make. To add a reader, add a line to `READERS`.
"""

from __future__ import annotations

import atexit
import bz2
import csv
import functools
import gzip
import hashlib
import io
import json
import os
import random
import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import fuzz_mutate
import numpy as np
import torch
import yaml

from ambiguous_wild.harness.audit.table import read_tables
from ambiguous_wild.harness.planning.file import read_plan
from ambiguous_wild.harness.run import refuse_other_config
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.io import archive, images, ply, scene_folder
from ambiguous_wild.io.photos import read_photo
from ambiguous_wild.metrics import lpips
from ambiguous_wild.simulate import capture, spec_file
from ambiguous_wild.simulate.composite.cutouts import read_cutouts
from ambiguous_wild.simulate.presets import preset
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.study.answers import read_answers
from ambiguous_wild.study.key import read_key
from ambiguous_wild.vision.cache import cached
from ambiguous_wild.vision.label_maps import read_labels

Mutate = Callable[[bytes, random.Random, bytes], bytes]


@dataclass(frozen=True)
class Reader:
    """One way in.

    samples: valid files, made once.
    mutate: damage.
    read: what a command does with the file; any error but AwError is a crash.
    """

    name: str
    suffix: str
    samples: Callable[[], list[bytes]]
    read: Callable[[Path], Any]
    mutate: Mutate = fuzz_mutate.damage


@functools.cache
def _workshop() -> Path:
    folder, owner = tempfile.mkdtemp(prefix="aw-fuzz-samples-"), os.getpid()
    # Forked children end by os._exit, but whoever forks otherwise must not take the folder away.
    atexit.register(lambda: shutil.rmtree(folder, ignore_errors=True) if os.getpid() == owner else None)
    return Path(folder)


def _picture(channels: int = 3, dtype: type = np.uint8, width: int = 40, height: int = 32) -> np.ndarray:
    small = np.random.default_rng(channels).integers(0, 256, (6, 8, channels), dtype=np.uint8)
    large = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC).reshape(height, width, channels)
    return large.astype(dtype) * dtype(257 if dtype is np.uint16 else 1)


def _encoded(suffix: str, image: np.ndarray, *options: int) -> bytes:
    done, data = cv2.imencode(suffix, image, list(options))
    if not done:
        raise RuntimeError(f"OpenCV cannot write {suffix}")
    return data.tobytes()


@functools.cache
def _photo(name: str) -> list[bytes]:
    color, gray, alpha = _picture(), _picture(1), _picture(4)
    if name == "jpeg":
        return [_encoded(".jpg", color), _encoded(".jpg", gray), _encoded(".jpg", color, 2, 1), *_with_exif()]
    if name == "png":
        return [_encoded(".png", i) for i in (color, gray, alpha, _picture(3, np.uint16))]
    if name == "tiff":
        return [
            _encoded(".tif", color),
            _encoded(".tif", gray, 259, 1),
            _encoded(".tif", _picture(3, np.uint16)),
        ]
    others = [
        _encoded(".bmp", color),
        _encoded(".bmp", gray),
        _encoded(".webp", color),
        _encoded(".webp", alpha),
    ]
    return [*others, _encoded(".jp2", color)]


@functools.cache
def _with_exif() -> list[bytes]:
    import OpenImageIO as oiio

    path = _workshop() / "exif.jpg"
    spec = oiio.ImageSpec(40, 32, 3, "uint8")
    facts: dict[str, Any] = {
        "Orientation": 6, "Make": "Maker", "Model": "Phone 3", "Exif:FocalLength": 4.2, "ExposureTime": 0.01,
        "Exif:FocalLengthIn35mmFilm": 26, "FNumber": 1.8, "Exif:PhotographicSensitivity": 100,
        "Exif:WhiteBalance": 0, "Exif:DateTimeOriginal": "2024:01:02 03:04:05", "GPS:LatitudeRef": "N",
    }  # fmt: skip
    for key, value in facts.items():
        spec.attribute(key, value)
    spec.attribute("GPS:Latitude", oiio.TypeDesc("float[3]"), (48.0, 8.0, 30.0))
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), spec)
    output.write_image(np.ascontiguousarray(_picture()))
    output.close()
    return [path.read_bytes()]


def _scene_images(path: Path) -> None:
    first = None
    for read in (images.read_png_rgb, images.read_gray, images.load_image_float, images.image_size):
        try:
            read(path)
        except images.AwError as error:
            first = first or error
    if first is not None:
        raise first


@functools.cache
def _scene(use: str) -> Path:
    """A scene of two photos and eight points for one reader alone; a text model where its use is a text."""
    from tests.io.model_maker import make_model, write_binary

    root, names = _workshop() / f"scene {use.replace('/', ' ')}", ["0.png", "1.png"]
    model = make_model(names, points=8)
    if use.endswith("txt"):
        _write_text(root / "sparse" / "0", model)
    else:
        write_binary(root / "sparse" / "0", model)
    for name in names:
        images.write_png(root / "images" / name, np.zeros((48, 64, 3), np.uint8))
    (root / "train_list.txt").write_text("0.png\n")
    (root / "test_list.txt").write_text("1.png\n")
    return root


def _write_text(folder: Path, model: Any) -> None:
    folder.mkdir(parents=True)

    def line(*values: Any) -> str:
        return " ".join(str(v) for value in values for v in np.atleast_1d(value)) + "\n"

    cameras = [line(c.camera_id, c.model, c.width, c.height, c.params) for c in model.cameras.values()]
    (folder / "cameras.txt").write_text("".join(cameras))
    rows = []
    for i in model.images.values():
        seen = [v for xy, point in zip(i.xys, i.point_ids) for v in (*xy, point)]
        rows += [line(i.image_id, i.qvec, i.tvec, i.camera_id, i.name), line(*seen)]
    (folder / "images.txt").write_text("".join(rows))
    p, rows = model.points, []
    for k in range(len(p.ids)):
        track = slice(p.track_offsets[k], p.track_offsets[k + 1])
        pairs = np.stack([p.track_image_ids[track], p.track_point2d[track]], axis=1).ravel()
        rows.append(line(p.ids[k], p.xyz[k], p.rgb[k], p.error_px[k], pairs))
    (folder / "points3D.txt").write_text("".join(rows))


def _inside_scene(title: str, name: str, mutate: Mutate = fuzz_mutate.damage) -> Reader:
    """A reader of one file of a scene folder, by opening the scene."""

    def read(path: Path) -> None:
        shutil.copyfile(path, _scene(name) / name)
        scene_folder.load_scene(_scene(name))

    @functools.cache
    def samples() -> list[bytes]:
        return [(_scene(name) / name).read_bytes()]

    return Reader(title, Path(name).suffix, samples, read, mutate)


@functools.cache
def _plys() -> list[bytes]:
    rng, found = np.random.default_rng(0), []
    for rest in (0, 15):
        shapes = {
            "means": (9, 3),
            "quats": (9, 4),
            "log_scales": (9, 3),
            "opacity_logits": (9,),
            "sh0": (9, 3),
        }
        arrays = {k: rng.random(s, dtype=np.float32) for k, s in shapes.items()}
        path = _workshop() / "a.ply"
        ply.write_splat_ply(path, arrays | {"sh_rest": np.zeros((9, rest, 3), np.float32)})
        found.append(path.read_bytes())
    return found


@functools.cache
def _specs() -> list[bytes]:
    return [spec_file.dump_spec(preset(name)).encode() for name in ("tiny", "courtyard")]


@functools.cache
def _configs() -> list[bytes]:
    config = {"method": "3dgs", "options": {}, "train": {"iterations": 60, "rates": [1.0, 0.5]},
              "scene": {"name": "s", "sha256": "0" * 64, "factor": 1, "path": "/x"}, "config_hash": "h"}  # fmt: skip
    bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n"
    for old, new in zip("abcdefghi", "bcdefghij"):
        bomb += f"{new}: &{new} [{', '.join(['*' + old] * 9)}]\n"
    return [yaml.safe_dump(config).encode(), (bomb + "method: *j\nscene: {name: *j}\n").encode()]


def _config(path: Path) -> None:
    run = _workshop() / "runs" / "seed0"
    run.mkdir(parents=True, exist_ok=True)
    (run / "checkpoint").mkdir(exist_ok=True)
    shutil.copyfile(path, run / "config.yaml")
    read_runs(run.parent)
    refuse_other_config(run, SimpleNamespace(identity="h", config={"method": "3dgs", "train": {}}))  # type: ignore[arg-type]


@functools.cache
def _scene_jsons() -> list[bytes]:
    from ambiguous_wild.io.hashing import sha256_file

    path = _scene("scene.json") / "images" / "0.png"
    file = {"sha256": sha256_file(path), "bytes": path.stat().st_size}
    info = {"schema": "ambiguous_wild.scene", "schema_version": 1, "factor": 1, "name": "s",
            "files": {"images/0.png": file}, "capture": {"photos": 4}, "seconds": {"x": 1.0}}  # fmt: skip
    return [json.dumps(info).encode()]


def _scene_json(path: Path) -> None:
    root = _scene("scene.json")
    shutil.copyfile(path, root / "scene.json")
    scene_folder.load_scene(root)


@functools.cache
def _results() -> list[bytes]:
    from tests.harness.fake_runs import fake_result

    return [json.dumps(fake_result("3dgs")).encode()]


def _result(path: Path) -> None:
    from ambiguous_wild.harness.render_tables import to_csv
    from ambiguous_wild.harness.tables import comparison

    runs = _workshop() / "results" / "scene" / "m" / "seed0"
    runs.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, runs / "metrics.json")
    to_csv(comparison(read_runs(_workshop() / "results")))


@functools.cache
def _plans() -> list[bytes]:
    from ambiguous_wild.harness.planning.decide import SCHEMA, Decision

    row = {name: "x" for name in Decision.__dataclass_fields__}
    row |= {"decision": "on", "value": 0.5, "threshold": 0.1}  # type: ignore[dict-item]
    return [json.dumps({"schema": SCHEMA, "scene": "s", "decisions": [row, row], "probed": True}).encode()]


@functools.cache
def _captures() -> list[bytes]:
    facts = {
        "identity": "i",
        "preset": "tiny",
        "seed": 0,
        "files": {"a": hashlib.sha256(b"x").hexdigest()},
        "photos": {},
    }
    return [json.dumps(facts).encode()]


def _capture(path: Path) -> None:
    truth = _workshop() / "captured" / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, truth / "capture.json")
    (truth.parent / "a").write_text("x")
    capture._earlier(truth.parent, "i", overwrite=False)


@functools.cache
def _keys() -> list[bytes]:
    from tests.study.studies import panel_key, write_key

    return [write_key(panel_key(), _workshop() / "study.key.json").read_bytes()]


@functools.cache
def _answers(kind: str) -> list[bytes]:
    from tests.study.studies import panel, panel_key

    _keys()
    files = panel(
        panel_key(), {"3dgs": 0.0, "refinesplat": 1.0, "robustsplat": 0.5}, 2, np.random.default_rng(0)
    )
    if kind == "json":
        return [json.dumps(f).encode() for f in files.values()]
    found = []
    for f in files.values():
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(("study", "rater", "name", "question", "answer", "left", "ms"))
        for a in f["answers"]:
            row = (f["study"], f["rater"], f["name"], a["question"], a["answer"], a.get("left", ""), a["ms"])
            writer.writerow(row)
        found.append(text.getvalue().encode())
    return found


def _answer(path: Path) -> None:
    read_answers([path], read_key(_workshop() / "study.key.json"))


@functools.cache
def _tables() -> list[bytes]:
    head = "method,scene,metric,value,table,setting,dataset,variant,mark,printed\n"
    rows = [f"m{i},yard,psnr,2{i}.5{i},t,,d,unknown,{i + 1},\n" for i in range(3)]
    return [(head + "".join(rows)).encode(), b'method,scene,metric,value\n"a, b",yard,ssim,1e-1\n']


@functools.cache
def _archives(kind: str) -> list[bytes]:
    members = [("a.txt", b"one"), ("b/c.bin", bytes(300)), ("../out.txt", b"x"), ("/abs.txt", b"x")]
    out = io.BytesIO()
    if kind == "zip":
        found = []
        for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
            out = io.BytesIO()
            with zipfile.ZipFile(out, "w", method) as z:
                for name, data in members[:2]:
                    z.writestr(name, data)
            found.append(out.getvalue())
        return found
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as t:
        for name, data in [*members[:2], ("é" * 120, b"long name")]:
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            t.addfile(entry, io.BytesIO(data))
    plain = out.getvalue()
    return [plain, gzip.compress(plain), bz2.compress(plain)]


def _unpack(path: Path) -> None:
    """Also a crash: something outside the target, or a target half made."""
    room = path.parent / "room"
    shutil.rmtree(room, ignore_errors=True)
    room.mkdir()
    whole = False
    try:
        archive.extract(path, room / "target")
        whole = True
    finally:
        expected = ["target"] if whole else []
        if sorted(os.listdir(room)) != expected or sorted(os.listdir(path.parent)) != sorted(
            [path.name, "room"]
        ):
            raise RuntimeError(f"left behind: {os.listdir(room)}, {os.listdir(path.parent)}")
        if any(p.is_symlink() or not (p.is_file() or p.is_dir()) for p in room.rglob("*")):
            raise RuntimeError("a link or device was made")


@functools.cache
def _checkpoints() -> list[bytes]:
    path = _workshop() / "a.safetensors"
    checkpoint.save(path, {"iteration": 3, "g": {"means": torch.zeros(4, 3), "t": [1, 2.5, None]}, "s": "x"})
    return [path.read_bytes()]


@functools.cache
def _weights() -> list[bytes]:
    found = []
    for legacy in (True, False):
        out = io.BytesIO()
        torch.save({"a.weight": torch.zeros(3, 4)}, out, _use_new_zipfile_serialization=not legacy)
        found.append(out.getvalue())
    return found


@functools.cache
def _label_maps(kind: str) -> list[bytes]:
    labels = (np.arange(600).reshape(20, 30) // 50).astype(np.int32)
    if kind == "png":
        return [_encoded(".png", labels.astype(np.uint8)), _encoded(".png", labels.astype(np.uint16)),
                _encoded(".png", _picture())]  # fmt: skip
    out = io.BytesIO()
    np.save(out, labels)
    return [out.getvalue()]


@functools.cache
def _cutouts() -> list[bytes]:
    image = _picture(4)
    image[:6, :, 3], image[6:, :, 3] = 0, 255
    return [_encoded(".png", image)]


def _cutout(path: Path) -> None:
    folder = path.parent / "cutouts"
    folder.mkdir(exist_ok=True)
    shutil.copyfile(path, folder / "a.png")
    read_cutouts(folder)


@functools.cache
def _caches() -> list[bytes]:
    found = []
    for save in (np.savez_compressed, np.savez):
        out = io.BytesIO()
        save(out, labels=np.zeros((20, 30), np.int32))
        found.append(out.getvalue())
    return found


def _cache(path: Path) -> None:
    """A damaged entry is made anew: never an error."""
    shutil.copyfile(path, path.parent / "entry.npz")
    found = cached(path.parent, "entry", {"labels": np.int32}, lambda: {"labels": np.ones((2, 2), np.int32)})
    if found["labels"].dtype != np.int32:
        raise RuntimeError("an entry of another type came back")


def _many() -> list[Reader]:
    photos = [
        Reader(f"photo {k}", s, functools.partial(_photo, k), read_photo, m)
        for k, s, m in (
            ("jpeg", ".jpg", fuzz_mutate.damage),
            ("png", ".png", fuzz_mutate.png),
            ("tiff", ".tif", fuzz_mutate.damage),
            ("bmp, webp, jp2", ".img", fuzz_mutate.damage),
        )
    ]
    models = [
        _inside_scene(f"COLMAP {n}.{kind}", f"sparse/0/{n}.{kind}")
        for kind in ("bin", "txt")
        for n in ("cameras", "images", "points3D")
    ]
    yaml_tree = fuzz_mutate.tree(yaml.safe_load, yaml.safe_dump)
    tree = fuzz_mutate.json_tree
    return [
        *photos,
        Reader("EXIF", ".jpg", _with_exif, read_photo, fuzz_mutate.exif),
        Reader("scene image png", ".png", functools.partial(_photo, "png"), _scene_images, fuzz_mutate.png),
        Reader("scene image jpeg", ".jpg", functools.partial(_photo, "jpeg"), _scene_images),
        Reader("scene image tiff", ".tif", functools.partial(_photo, "tiff"), _scene_images),
        *models,
        _inside_scene("split list", "train_list.txt"),
        Reader("splat PLY", ".ply", _plys, ply.read_splat_ply),
        Reader("spec YAML", ".yaml", _specs, spec_file.read_spec, yaml_tree),
        Reader("config YAML", ".yaml", _configs, _config),
        Reader("scene.json", ".json", _scene_jsons, _scene_json, tree),
        Reader("metrics.json", ".json", _results, _result, tree),
        Reader("plan JSON", ".json", _plans, read_plan, tree),
        Reader("capture.json", ".json", _captures, _capture, tree),
        Reader("study key", ".json", _keys, read_key, tree),
        Reader("answers JSON", ".json", functools.partial(_answers, "json"), _answer, tree),
        Reader("answers CSV", ".csv", functools.partial(_answers, "csv"), _answer),
        Reader("audit CSV", ".csv", _tables, lambda path: read_tables([path])),
        Reader("archive zip", ".zip", functools.partial(_archives, "zip"), _unpack),
        Reader("archive tar", ".tar", functools.partial(_archives, "tar"), _unpack),
        Reader("checkpoint", ".safetensors", _checkpoints, checkpoint.load),
        Reader("LPIPS weights", ".pth", _weights, lpips._read),
        Reader("label map PNG", ".png", functools.partial(_label_maps, "png"), read_labels, fuzz_mutate.png),
        Reader("label map npy", ".npy", functools.partial(_label_maps, "npy"), read_labels),
        Reader("cut-out", ".png", _cutouts, _cutout, fuzz_mutate.png),
        Reader("feature and mask cache", ".npz", _caches, _cache),
    ]


READERS = {reader.name: reader for reader in _many()}
