"""Readers of damaged files: what once crashed, by name, and seeded damage to every file that is read."""

import io
import json
import os
import pickle
import re
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.core.weight_files import read_tensors
from ambiguous_wild.harness.effects_plan import SCHEMA, read_plan
from ambiguous_wild.harness.result_file import read_result
from ambiguous_wild.harness.store import read_config
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.colmap_model import read_model, write_model
from ambiguous_wild.io.images import header_size
from ambiguous_wild.io.scene_folder import load_scene, read_scene_json
from ambiguous_wild.simulate.spec_file import parse_spec
from ambiguous_wild.splat import checkpoint
from ambiguous_wild.study.answers import KEY_FORMAT, read_answers, read_key
from ambiguous_wild.vision.label_maps import read_labels
from tests.faults.fuzzing.samples import yaml_bomb
from tests.harness.fake_runs import fake_result
from tests.io.model_maker import make_model
from tests.study.studies import METHODS, panel, panel_key
from tests.tiny_scene import write_tiny_scene

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_no_reader_crashes_on_a_hundred_damaged_files():
    words = [sys.executable, "-m", "tests.faults.fuzzing.run", "--inputs", "100"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    counts = re.findall(r"(\d+) inputs, (\d+) refused, 0 crashes$", done.stdout, re.MULTILINE)
    assert len(counts) > 30 and all(inputs == "100" for inputs, _ in counts)
    assert sum(int(refused) for _, refused in counts) > 1000


def replaced(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("cameras.txt", "PINHOLE 64 48", "PINHOLE 0 0"),  # a division by zero
        ("cameras.txt", "PINHOLE 64 48", "PINHOLE 99999999999 48"),
        ("cameras.txt", "60.0", "nan"),
        ("images.txt", "train_0.png\n\n", "train_0.png\n1.0 2.0 19.\n"),  # a point's number with a dot
        ("images.txt", "train_0.png\n\n", "train_0.png\n1.0 2.0 99999999999999999999\n"),
        ("images.txt", "train_0.png", "."),  # no name at all
    ],
)
def test_colmap_text_that_contradicts_itself(tmp_path, file, old, new):
    root = write_tiny_scene(tmp_path / "scene")
    replaced(root / "sparse" / "0" / file, old, new)
    with pytest.raises(AwError, match=r"damaged|not in COLMAP's format"):
        load_scene(root)


def test_colmap_binary_with_a_point_number_beyond_all_integers(tmp_path):
    write_model(tmp_path, make_model(["a.png"]))
    row = struct.pack("<QQ3d3BdQ", 1, 2**64 - 1, 0, 0, 0, 1, 2, 3, 0.5, 0)
    (tmp_path / "points3D.bin").write_bytes(row)
    with pytest.raises(AwError, match="damaged"):
        read_model(tmp_path)


def test_yaml_bombs_and_brackets_without_end(tmp_path):
    for text in (yaml_bomb(), "[" * 1500, "? [1, 2]\n: 3", "!!python/object/apply:os.system [ls]"):
        with pytest.raises(AwError):
            plain_yaml.parse(text)
        (tmp_path / "config.yaml").write_text(text)
        assert read_config(tmp_path) == {}


@pytest.mark.parametrize("number", ["1" + "0" * 400, "1" + "0" * 5000])
def test_numbers_without_end(tmp_path, number):
    with pytest.raises(AwError):
        parse_spec(f"samples: {number}")
    with pytest.raises(AwError):
        parse_spec(f"width: 320\nexposure: {number}")
    for name, text in {
        "metrics.json": json.dumps(fake_result("3dgs")).replace("1234", number),
        "scene.json": f'{{"schema_version": 1, "files": {{}}, "factor": {number}}}',
        "plan.json": f'{{"schema": {SCHEMA}, "scene": "s", "decisions": [{{"threshold": {number}}}]}}',
    }.items():
        (tmp_path / name).write_text(text)
    for read, name in ((read_result, "metrics.json"), (read_plan, "plan.json")):
        with pytest.raises(AwError, match=name):
            read(tmp_path / name)
    with pytest.raises(AwError, match=r"scene\.json"):
        read_scene_json(tmp_path)


def test_an_answer_that_took_longer_than_any_number(tmp_path):
    key = panel_key()
    (name, data), *_ = panel(key, dict.fromkeys(METHODS, 0.0), 1, np.random.default_rng(0)).items()
    data["answers"][0]["ms"] = 10**400
    (tmp_path / name).write_text(json.dumps(data))
    with pytest.raises(AwError, match="no valid time"):
        read_answers([tmp_path / name], key)


@pytest.mark.parametrize("row", [[], "x", 1.5, None])
def test_a_plan_whose_decision_is_none(tmp_path, row):
    (tmp_path / "plan.json").write_text(json.dumps({"schema": SCHEMA, "scene": "s", "decisions": [row]}))
    with pytest.raises(AwError, match="no plan"):
        read_plan(tmp_path / "plan.json")


def test_a_study_key_whose_kind_is_a_list(tmp_path):
    data = {"format": KEY_FORMAT, "version": 1, "study": "s", "title": "t", "questions": {"q": {"kind": []}}}
    (tmp_path / "k.json").write_text(json.dumps(data))
    with pytest.raises(AwError, match="damaged"):
        read_key(tmp_path / "k.json")


@pytest.mark.parametrize("shape", ["(3, 4", "(99999999999, 99999999)", "(-1, 4)"])
def test_label_maps_that_announce_what_they_do_not_hold(tmp_path, shape):
    header = f"{{'descr': '<i4', 'fortran_order': False, 'shape': {shape}, }}".encode() + b"\n"
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(48)
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(AwError, match=r"a\.npy"):
        read_labels(tmp_path / "a.npy")


def test_a_message_stays_one_that_can_be_read():
    with pytest.raises(AwError) as caught:
        parse_spec("x" * 100_000 + ": 1")
    assert len(str(caught.value)) < 2500


def test_image_headers_say_the_size_the_decoder_finds():
    import cv2

    pixels = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)
    lossless, progressive = [cv2.IMWRITE_WEBP_QUALITY, 101], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    kinds = [(s, []) for s in (".png", ".jpg", ".bmp", ".tif", ".webp")]
    for suffix, options in [*kinds, (".webp", lossless), (".jpg", progressive)]:
        data = cv2.imencode(suffix, pixels, options)[1].tobytes()
        assert header_size(data) == (53, 37), suffix
        assert header_size(data[:12]) is None
    assert header_size(b"P6 9 9 255 ") is None


class _Harmful:
    def __init__(self, victim):
        self.victim = victim

    def __reduce__(self):
        return os.mkdir, (str(self.victim),)


@pytest.mark.parametrize("kind", ["pickle", "torch", "numpy"])
def test_code_in_a_file_is_never_run(tmp_path, kind):
    victim, path = tmp_path / "executed", tmp_path / "file"
    harmful = _Harmful(victim)
    if kind == "pickle":
        path.write_bytes(pickle.dumps(harmful))
    elif kind == "torch":
        torch.save({"a": harmful}, path)
    else:
        out = io.BytesIO()
        np.save(out, np.array([harmful], dtype=object), allow_pickle=True)
        path.write_bytes(out.getvalue())
    path.with_suffix(".npy").write_bytes(path.read_bytes())
    for read, name in (
        (checkpoint.load, path),
        (read_tensors, path),
        (read_labels, path.with_suffix(".npy")),
    ):
        with pytest.raises(AwError):
            read(name)
    assert not victim.exists()


@pytest.mark.parametrize("share", [0.0, 0.4, 0.99])
def test_an_interrupted_download_of_weights_is_never_taken_for_whole(tmp_path, share):
    torch.save({"a.weight": torch.zeros(40, 40)}, tmp_path / "whole.pth")
    data = (tmp_path / "whole.pth").read_bytes()
    (tmp_path / "part.pth").write_bytes(data[: int(len(data) * share)])
    with pytest.raises(AwError, match=r"part\.pth cannot be read as weights.*download it again"):
        read_tensors(tmp_path / "part.pth")
    checkpoint.save(tmp_path / "a.safetensors", {"means": torch.zeros(40, 40)})
    data = (tmp_path / "a.safetensors").read_bytes()
    (tmp_path / "a.safetensors").write_bytes(data[: int(len(data) * share)])
    with pytest.raises(AwError, match=r"a\.safetensors"):
        checkpoint.load(tmp_path / "a.safetensors")
