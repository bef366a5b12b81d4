"""Valid sample files of every type that is read."""

from __future__ import annotations

import atexit
import bz2
import csv
import functools
import gzip
import hashlib
import io
import json
import math
import os
import shutil
import tarfile
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml

from ambiguous_wild.io import images
from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.splat_files import FORMATS, write_splats
from ambiguous_wild.report import board_pictures
from ambiguous_wild.report.board import Entry, board_csv, wide
from ambiguous_wild.simulate import spec_file
from ambiguous_wild.simulate.presets import preset
from ambiguous_wild.splat import checkpoint


@functools.cache
def workshop() -> Path:
    """A temporary folder of this process."""
    folder, owner = tempfile.mkdtemp(prefix="aw-fuzz-samples-"), os.getpid()
    # Forked children end by os._exit, but whoever forks otherwise must not take the folder away.
    atexit.register(lambda: shutil.rmtree(folder, ignore_errors=True) if os.getpid() == owner else None)
    return Path(folder)


def picture(channels: int = 3, dtype: type = np.uint8, width: int = 40, height: int = 32) -> np.ndarray:
    small = np.random.default_rng(channels).integers(0, 256, (6, 8, channels), dtype=np.uint8)
    large = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC).reshape(height, width, channels)
    return large.astype(dtype) * dtype(257 if dtype is np.uint16 else 1)


def encoded(suffix: str, image: np.ndarray, *options: int) -> bytes:
    done, data = cv2.imencode(suffix, image, list(options))
    if not done:
        raise RuntimeError(f"OpenCV cannot write {suffix}")
    return data.tobytes()


@functools.cache
def photos(name: str) -> list[bytes]:
    color, gray, alpha = picture(), picture(1), picture(4)
    if name == "jpeg":
        return [encoded(".jpg", color), encoded(".jpg", gray), encoded(".jpg", color, 2, 1), *with_exif()]
    if name == "png":
        return [encoded(".png", i) for i in (color, gray, alpha, picture(3, np.uint16))]
    if name == "tiff":
        return [
            encoded(".tif", i, *o) for i, o in ((color, ()), (gray, (259, 1)), (picture(3, np.uint16), ()))
        ]
    others = ((".bmp", color), (".bmp", gray), (".webp", color), (".webp", alpha), (".jp2", color))
    return [encoded(suffix, image) for suffix, image in others]


@functools.cache
def with_exif() -> list[bytes]:
    import OpenImageIO as oiio

    path = workshop() / "exif.jpg"
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
    output.write_image(np.ascontiguousarray(picture()))
    output.close()
    return [path.read_bytes()]


@functools.cache
def scene(use: str) -> Path:
    """A scene of two photos and eight points for one reader alone; a text model where its use is a text."""
    from tests.io.model_maker import make_model, write_text

    root, names = workshop() / f"scene {use.replace('/', ' ')}", ["0.png", "1.png"]
    model = make_model(names, points=8)
    if use.endswith("txt"):
        write_text(root / "sparse" / "0", model)
    else:
        write_model(root / "sparse" / "0", model)
    for name in names:
        images.write_png(root / "images" / name, np.zeros((48, 64, 3), np.uint8))
    (root / "train_list.txt").write_text("0.png\n")
    (root / "test_list.txt").write_text("1.png\n")
    return root


@functools.cache
def splats(form: str) -> list[bytes]:
    shapes = {"means": (9, 3), "quats": (9, 4), "log_scales": (9, 3), "opacity_logits": (9,), "sh0": (9, 3)}
    rng, found = np.random.default_rng(0), []
    for rest in (0, 15):
        arrays = {k: rng.random(s, dtype=np.float32) for k, s in (shapes | {"sh_rest": (9, rest, 3)}).items()}
        write_splats(FORMATS[form], workshop() / "a.splats", arrays)
        found.append((workshop() / "a.splats").read_bytes())
    return found


@functools.cache
def specs() -> list[bytes]:
    return [spec_file.dump_spec(preset(name)).encode() for name in ("tiny", "courtyard")]


@functools.cache
def configs() -> list[bytes]:
    config = {"method": "3dgs", "options": {}, "train": {"iterations": 60, "rates": [1.0, 0.5]},
              "scene": {"name": "s", "sha256": "0" * 64, "factor": 1, "path": "/x"},
              "config_hash": "h"}  # fmt: skip
    return [yaml.safe_dump(config).encode(), (yaml_bomb() + "method: *j\nscene: {name: *j}\n").encode()]


def yaml_bomb() -> str:
    """Nine levels of nine aliases each."""
    bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n"
    for old, new in zip("abcdefghi", "bcdefghij"):
        bomb += f"{new}: &{new} [{', '.join(['*' + old] * 9)}]\n"
    return bomb


@functools.cache
def scene_jsons() -> list[bytes]:
    from ambiguous_wild.io.files import sha256_file

    path = scene("scene.json") / "images" / "0.png"
    file = {"sha256": sha256_file(path), "bytes": path.stat().st_size}
    info = {"schema": "ambiguous_wild.scene", "schema_version": 1, "factor": 1, "name": "s",
            "files": {"images/0.png": file}, "capture": {"photos": 4}, "seconds": {"x": 1.0}}  # fmt: skip
    return [json.dumps(info).encode()]


@functools.cache
def results() -> list[bytes]:
    from tests.harness.fake_runs import fake_result

    return [json.dumps(fake_result("3dgs")).encode()]


@functools.cache
def plans() -> list[bytes]:
    from ambiguous_wild.harness.effects_plan import SCHEMA, Decision

    row = dict.fromkeys(Decision.__dataclass_fields__, "x")
    row |= {"decision": "on", "value": 0.5, "threshold": 0.1}  # type: ignore[dict-item]
    row |= {"cost_ms": 1.5, "gain_db": 0.3, "error_db": None}  # type: ignore[dict-item]
    plan = {"schema": SCHEMA, "scene": "s", "decisions": [row, row], "probed": True}
    plan["cost"] = {"iterations": 900, "seconds": 9.5, "share": 0.04}
    return [json.dumps(plan).encode()]


@functools.cache
def captures() -> list[bytes]:
    files = {"a": hashlib.sha256(b"x").hexdigest()}
    facts = {"identity": "i", "preset": "tiny", "seed": 0, "files": files, "photos": {}}
    return [json.dumps(facts).encode()]


@functools.cache
def keys() -> list[bytes]:
    from tests.study.studies import panel_key, write_key

    return [write_key(panel_key(), workshop() / "study.key.json").read_bytes()]


@functools.cache
def answers(kind: str) -> list[bytes]:
    from tests.study.studies import panel, panel_key

    keys()
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


@functools.cache
def tables() -> list[bytes]:
    head = "method,scene,metric,value,table,setting,dataset,variant,mark,printed\n"
    rows = [f"m{i},yard,psnr,2{i}.5{i},t,,d,unknown,{i + 1},\n" for i in range(3)]
    return [(head + "".join(rows)).encode(), b'method,scene,metric,value\n"a, b",yard,ssim,1e-1\n']


@functools.cache
def boards() -> list[bytes]:
    quality = {"psnr": math.inf, "ssim": 0.9, "lpips_alex": 0.25}
    entries = [
        Entry(
            "tiny", "a, b", "=m", "2000 iterations", "", seed, 8, quality, {"train_s": 1.5}, ("flip",), "cpu",
            "a processor", "0.1.0", "", "c0", f"c{seed + 1}", "5c", "e5", "photos", "aw bench",
        )
        for seed in range(2)
    ]  # fmt: skip
    return [board_csv(*wide(entries)).encode()]


@functools.cache
def board_images() -> list[bytes]:
    pictures = board_pictures.BoardPictures(workshop() / "board")
    subject = board_pictures.PictureSubject("tiny", "a, b", "1.png", "=m", "2000 iterations")
    pictures.write(subject, encoded(".png", picture()), 0, 20.5)
    board_pictures.write_index(workshop() / "board", pictures.rows.values())
    kept = board_pictures.folder_of(workshop() / "board")
    return [(kept / board_pictures.INDEX).read_bytes()]


@functools.cache
def archives(kind: str) -> list[bytes]:
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


@functools.cache
def checkpoints() -> list[bytes]:
    path = workshop() / "a.safetensors"
    checkpoint.save(path, {"iteration": 3, "g": {"means": torch.zeros(4, 3), "t": [1, 2.5, None]}, "s": "x"})
    return [path.read_bytes()]


@functools.cache
def weights() -> list[bytes]:
    found = []
    for legacy in (True, False):
        out = io.BytesIO()
        torch.save({"a.weight": torch.zeros(3, 4)}, out, _use_new_zipfile_serialization=not legacy)
        found.append(out.getvalue())
    return found


@functools.cache
def label_maps(kind: str) -> list[bytes]:
    labels = (np.arange(600).reshape(20, 30) // 50).astype(np.int32)
    if kind == "png":
        return [encoded(".png", labels.astype(np.uint8)), encoded(".png", labels.astype(np.uint16)),
                encoded(".png", picture())]  # fmt: skip
    out = io.BytesIO()
    np.save(out, labels)
    return [out.getvalue()]


@functools.cache
def cutouts() -> list[bytes]:
    image = picture(4)
    image[:6, :, 3], image[6:, :, 3] = 0, 255
    return [encoded(".png", image)]


@functools.cache
def caches() -> list[bytes]:
    found = []
    for save in (np.savez_compressed, np.savez):
        out = io.BytesIO()
        save(out, labels=np.zeros((20, 30), np.int32))
        found.append(out.getvalue())
    return found
