"""Readers of external files: valid samples, how to damage them, and the call.

The calls are those of the commands. To add a reader, add a line to `READERS`.
"""

from __future__ import annotations

import functools
import os
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml

from ambiguous_wild.core.weight_files import read_tensors
from ambiguous_wild.harness.cell_run import refuse_other_config
from ambiguous_wild.harness.effects_plan import read_plan
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.io import archive, images, scene_folder
from ambiguous_wild.io.photos import read_photo
from ambiguous_wild.io.splat_files import FORMATS, read_splats
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.report import board, board_pictures
from ambiguous_wild.report.audit_numbers import read_tables
from ambiguous_wild.simulate import capture_writer, spec_file
from ambiguous_wild.simulate.cutouts import read_cutouts
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.study.answers import read_answers, read_key
from ambiguous_wild.vision.label_maps import read_labels
from ambiguous_wild.vision.precompute import cached
from tests.faults.fuzzing import mutate as damages
from tests.faults.fuzzing import samples as valid

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
    mutate: Mutate = damages.damage


def _scene_images(path: Path) -> None:
    first = None
    for read in (images.read_png_rgb, images.read_gray, images.load_image_float, images.image_size):
        try:
            read(path)
        except images.AwError as error:
            first = first or error
    if first is not None:
        raise first


def _inside_scene(title: str, name: str, mutate: Mutate = damages.damage) -> Reader:
    """A reader of one file of a scene folder, by opening the scene."""

    def read(path: Path) -> None:
        shutil.copyfile(path, valid.scene(name) / name)
        scene_folder.load_scene(valid.scene(name))

    @functools.cache
    def samples() -> list[bytes]:
        return [(valid.scene(name) / name).read_bytes()]

    return Reader(title, Path(name).suffix, samples, read, mutate)


def _config(path: Path) -> None:
    run = valid.workshop() / "runs" / "seed0"
    run.mkdir(parents=True, exist_ok=True)
    (run / "checkpoint").mkdir(exist_ok=True)
    shutil.copyfile(path, run / "config.yaml")
    read_runs(run.parent)
    cell = SimpleNamespace(identity="h", config={"method": "3dgs", "train": {}}, method=get_method("3dgs"))
    refuse_other_config(run, cell)  # type: ignore[arg-type]


def _scene_json(path: Path) -> None:
    root = valid.scene("scene.json")
    shutil.copyfile(path, root / "scene.json")
    scene_folder.load_scene(root)


def _result(path: Path) -> None:
    from ambiguous_wild.report.comparison import comparison
    from ambiguous_wild.report.plain_formats import to_wide_csv

    runs = valid.workshop() / "results" / "scene" / "m" / "seed0"
    runs.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, runs / "metrics.json")
    to_wide_csv(comparison(read_runs(valid.workshop() / "results")))


def _capture(path: Path) -> None:
    truth = valid.workshop() / "captured" / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, truth / "capture.json")
    (truth.parent / "a").write_text("x")
    capture_writer._earlier(truth.parent, "i", overwrite=False)


def _board(path: Path) -> None:
    measured = path.parent / "board" / "measured"
    measured.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, measured / "tiny.csv")
    board.read_board(measured.parent)


def _board_images(path: Path) -> None:
    kept = path.parent / "board" / "measured" / "images"
    kept.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, kept / "index.csv")
    board_pictures.read_index(kept.parent.parent)


def _answer(path: Path) -> None:
    read_answers([path], read_key(valid.workshop() / "study.key.json"))


def _unpack(path: Path) -> None:
    """Also a crash: a file outside the target, or an incomplete target."""
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


def _cutout(path: Path) -> None:
    folder = path.parent / "cutouts"
    folder.mkdir(exist_ok=True)
    shutil.copyfile(path, folder / "a.png")
    read_cutouts(folder)


def _cache(path: Path) -> None:
    """A damaged entry is computed again; it is never an error."""
    shutil.copyfile(path, path.parent / "entry.npz")
    found = cached(path.parent, "entry", {"labels": np.int32}, lambda: {"labels": np.ones((2, 2), np.int32)})
    if found["labels"].dtype != np.int32:
        raise RuntimeError("an entry of another type came back")


def _many() -> list[Reader]:
    photos = []
    for kind, suffix in (("jpeg", ".jpg"), ("png", ".png"), ("tiff", ".tif"), ("bmp, webp, jp2", ".img")):
        samples, mutate = (
            functools.partial(valid.photos, kind),
            damages.png if kind == "png" else damages.damage,
        )
        photos.append(Reader(f"photo {kind}", suffix, samples, read_photo, mutate))
        if suffix != ".img":
            photos.append(Reader(f"scene image {kind}", suffix, samples, _scene_images, mutate))
    models = [
        _inside_scene(f"COLMAP {n}.{kind}", f"sparse/0/{n}.{kind}")
        for kind in ("bin", "txt")
        for n in ("cameras", "images", "points3D")
    ]
    yaml_tree = damages.tree(yaml.safe_load, yaml.safe_dump)
    tree = damages.json_tree
    return [
        *photos,
        Reader("EXIF", ".jpg", valid.with_exif, read_photo, damages.exif),
        *models,
        _inside_scene("split list", "train_list.txt"),
        *(
            Reader(f"splats {name}", form.suffix, functools.partial(valid.splats, name), read_splats)
            for name, form in FORMATS.items()
        ),
        Reader("spec YAML", ".yaml", valid.specs, spec_file.read_spec, yaml_tree),
        Reader("config YAML", ".yaml", valid.configs, _config),
        Reader("scene.json", ".json", valid.scene_jsons, _scene_json, tree),
        Reader("metrics.json", ".json", valid.results, _result, tree),
        Reader("plan JSON", ".json", valid.plans, read_plan, tree),
        Reader("capture.json", ".json", valid.captures, _capture, tree),
        Reader("study key", ".json", valid.keys, read_key, tree),
        Reader("answers JSON", ".json", functools.partial(valid.answers, "json"), _answer, tree),
        Reader("answers CSV", ".csv", functools.partial(valid.answers, "csv"), _answer),
        Reader("audit CSV", ".csv", valid.tables, lambda path: read_tables([path])),
        Reader("leaderboard CSV", ".csv", valid.boards, _board),
        Reader("leaderboard images", ".csv", valid.board_images, _board_images),
        Reader("archive zip", ".zip", functools.partial(valid.archives, "zip"), _unpack),
        Reader("archive tar", ".tar", functools.partial(valid.archives, "tar"), _unpack),
        Reader("checkpoint", ".safetensors", valid.checkpoints, checkpoint.load),
        Reader("LPIPS weights", ".pth", valid.weights, read_tensors),
        Reader("label map PNG", ".png", functools.partial(valid.label_maps, "png"), read_labels, damages.png),
        Reader("label map npy", ".npy", functools.partial(valid.label_maps, "npy"), read_labels),
        Reader("cut-out", ".png", valid.cutouts, _cutout, damages.png),
        Reader("feature and mask cache", ".npz", valid.caches, _cache),
    ]


READERS = {reader.name: reader for reader in _many()}
