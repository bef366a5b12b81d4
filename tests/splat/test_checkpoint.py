"""Checkpoints come back exactly, and hold nothing that could run."""

import contextlib

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.splat import checkpoint


def test_every_kind_of_value_survives(tmp_path):
    rng = np.random.default_rng(3)
    shared = torch.arange(6.0)
    tree = {
        "a": {"t": torch.randn(3, 2), "i": torch.tensor([1, 2]), "b": torch.tensor([True, False])},
        "same": [shared, shared[2:4]],
        "empty": torch.zeros(0, 3),
        "n": 12,
        "x": 0.1 + 0.2,
        "s": "ü",
        "none": None,
        "flag": True,
        "rng": rng.bit_generator.state,
        "array": np.arange(3),
    }
    checkpoint.save(tmp_path / "c.safetensors", tree)
    back = checkpoint.load(tmp_path / "c.safetensors")
    assert torch.equal(back["a"]["t"], tree["a"]["t"])
    assert back["a"]["b"].dtype == torch.bool
    assert torch.equal(back["same"][1], shared[2:4])
    assert back["empty"].shape == (0, 3)
    assert (back["n"], back["x"], back["s"], back["none"], back["flag"]) == (12, 0.1 + 0.2, "ü", None, True)
    assert back["rng"] == tree["rng"]
    assert back["array"].tolist() == [0, 1, 2]


def test_only_what_shares_memory_is_copied(tmp_path, monkeypatch):
    stack, written = torch.arange(12.0).view(3, 4), {}
    monkeypatch.setattr(checkpoint, "save_file", lambda tensors, path, **_: written.update(tensors))
    tree = {"first": stack[0], "last": stack[2], "both": stack[1:], "whole": stack, "alone": torch.ones(2)}
    with contextlib.suppress(OSError):  # nothing is written
        checkpoint.save(tmp_path / "c.safetensors", tree)
    kept = {name for name, tensor in tree.items() if written[f"/{name}"].data_ptr() == tensor.data_ptr()}
    assert kept == {"first", "last", "alone"}
    assert all(torch.equal(written[f"/{name}"], tensor) for name, tensor in tree.items())


@pytest.mark.parametrize("content", [b"", b"junk", b"\x80\x04\x95pickle", b"\xff" * 64])
def test_a_file_that_is_no_checkpoint_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "c.safetensors"
    path.write_bytes(content)
    with pytest.raises(AwError, match="checkpoint"):
        checkpoint.load(path)


def test_a_cut_file_is_refused(tmp_path):
    path = tmp_path / "c.safetensors"
    checkpoint.save(path, {"t": torch.zeros(1000)})
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(AwError, match="overwrite"):
        checkpoint.load(path)


def test_objects_are_refused(tmp_path):
    with pytest.raises(TypeError, match="'/a/b'"):
        checkpoint.save(tmp_path / "c.safetensors", {"a": {"b": object()}})
    assert list(tmp_path.iterdir()) == []
