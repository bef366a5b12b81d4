"""Compressed PLY, SPZ, SOG and glTF: against files of another implementation, and back from our own.

tests/io/data/splats holds a model of 40 Gaussians as a plain PLY and what PlayCanvas's splat-transform 2.7.1
made of it (SPZ through Niantic's own library).
"""

from __future__ import annotations

import gzip
import io
import json
import shutil
import struct
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.core import AwError, SceneTransform
from ambiguous_wild.io.ply import read_splat_ply, write_splat_ply
from ambiguous_wild.io.splat_arrays import SH_C0, finite
from ambiguous_wild.io.splat_files import FORMATS, read_splats, write_splats
from ambiguous_wild.io.spz import decode_spz, encode_spz
from ambiguous_wild.io.untrusted import read_bytes

THEIRS = Path(__file__).parent / "data" / "splats"
Arrays = dict[str, np.ndarray]
FORMS = {form.suffix[1:]: form for form in FORMATS.values()}
QUANTISED = ("compressed.ply", "spz", "sog")
# Largest error of positions, quaternions (1 - cosine), log scales, opacity, colour, harmonics; codebooks of
# SOG hold 256 values for everything, its quaternions 8 bits.
LOOSE = {
    "compressed.ply": (0.02, 1e-5, 0.01, 0.003, 0.02, 0.02),
    "spz": (0.001, 1e-5, 0.04, 0.003, 0.02, 0.07),
    "sog": (0.002, 1e-3, 0.06, 0.005, 0.06, 0.45),
    "glb": (0.0, 1e-6, 1e-6, 1e-6, 0.0, 0.0),
    "ply": (0.0, 1e-6, 0.0, 0.0, 0.0, 0.0),
}
OURS = {**LOOSE, "spz": (*LOOSE["spz"][:-1], 0.008)}  # we write SPZ's harmonics with 7 bits, others with 4
TOOL = shutil.which("splat-transform")


def model(count: int = 700, rest: int = 15, seed: int = 0) -> Arrays:
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(0, 3, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.normal(-4, 1, (count, 3)),
        "opacity_logits": rng.normal(0, 2, count),
        "sh0": rng.normal(0, 0.8, (count, 3)),
        "sh_rest": rng.normal(0, 0.1, (count, rest, 3)),
    }
    return {name: value.astype(np.float32) for name, value in arrays.items()}


def write(ending: str, path: Path, given: Arrays) -> int:
    return write_splats(FORMS[ending], path, given)


def read(ending: str, path: Path) -> Arrays:
    return FORMS[ending].decode(read_bytes(path), path).gaussians


def test_opacities_of_exactly_0_and_1_are_no_damage() -> None:
    given = model(9)
    given["opacity_logits"][:4] = np.inf, -np.inf, np.nan, 40.0
    kept = finite(given)
    assert len(kept["means"]) == 8 and kept["opacity_logits"][:3].tolist() == [15.0, -15.0, 40.0]


def matched(found: Arrays, given: Arrays) -> Arrays:
    """The rows of `found` in the order of `given`: formats reorder."""
    distance = np.linalg.norm(found["means"][None] - given["means"][:, None], axis=2)
    rows = distance.argmin(axis=1)
    assert sorted(rows) == list(range(len(found["means"])))
    return {name: value[rows] for name, value in found.items()}


def alpha(logits: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-logits.astype(np.float64)))


def check_near(found: Arrays, given: Arrays, limits: tuple[float, ...]) -> None:
    given = finite(given)
    found = matched(found, given)
    seen = alpha(given["opacity_logits"]) > 0.01  # WebP keeps no colour of what is transparent
    assert np.abs(found["means"] - given["means"]).max() <= limits[0]
    assert (1 - np.abs((found["quats"] * given["quats"]).sum(axis=1))).max() <= limits[1]
    assert np.abs(found["log_scales"] - given["log_scales"]).max() <= limits[2]
    assert np.abs(alpha(found["opacity_logits"]) - alpha(given["opacity_logits"])).max() <= limits[3]
    assert np.abs(found["sh0"] - given["sh0"])[seen].max() <= limits[4]
    assert found["sh_rest"].shape == given["sh_rest"].shape
    assert np.abs(found["sh_rest"] - given["sh_rest"]).max(initial=0.0) <= limits[5]


@pytest.mark.parametrize("ending", QUANTISED)
def test_what_another_program_wrote_is_read(ending: str) -> None:
    given = read_splat_ply(THEIRS / "model.ply")
    check_near(read(ending, THEIRS / f"model.{ending}"), given, LOOSE[ending])


def dot_splat(given: Arrays) -> bytes:
    """The bytes that antimatter15's convert.py writes, record by record."""
    records = []
    for k in range(len(given["means"])):
        colour = [*(0.5 + SH_C0 * given["sh0"][k]), alpha(given["opacity_logits"][k])]
        turned = given["quats"][k] / np.linalg.norm(given["quats"][k]) * 128 + 128
        records += [given["means"][k].tobytes(), np.exp(given["log_scales"][k]).tobytes()]
        records += [(255 * np.array(colour)).clip(0, 255).astype(np.uint8).tobytes()]
        records += [turned.clip(0, 255).astype(np.uint8).tobytes()]
    return b"".join(records)


def test_dot_splat_is_read_by_its_name(tmp_path: Path) -> None:
    given = model(300, rest=0)
    given["sh0"] = given["sh0"].clip(-1.7, 1.7)  # colours in [0, 1]; others are clipped
    (tmp_path / "a.SPLAT").write_bytes(dot_splat(given))
    check_near(read_splats(tmp_path / "a.SPLAT").gaussians, given, (0.0, 1e-3, 1e-6, 0.004, 0.014, 0.0))
    (tmp_path / "a.splat").write_bytes(dot_splat(given)[:-1])
    with pytest.raises(AwError, match="9599 bytes, not a multiple of 32"):
        read_splats(tmp_path / "a.splat")


def test_an_unpacked_sog_is_read_by_its_meta_json(tmp_path: Path) -> None:
    with zipfile.ZipFile(THEIRS / "model.sog") as archive:
        archive.extractall(tmp_path)
    unpacked, packed = read_splats(tmp_path / "meta.json"), read_splats(THEIRS / "model.sog")
    assert all(np.array_equal(unpacked.gaussians[name], value) for name, value in packed.gaussians.items())
    (tmp_path / "quats.webp").unlink()
    with pytest.raises(AwError, match=r"quats\.webp"):
        read_splats(tmp_path / "meta.json")
    meta = (tmp_path / "meta.json").read_text()
    (tmp_path / "meta.json").write_text(meta.replace("quats.webp", "../quats.webp"))
    with pytest.raises(AwError, match=r"'../quats\.webp' is no file beside it"):
        read_splats(tmp_path / "meta.json")


def spz_of_version(version: int, given: Arrays) -> bytes:
    """Our SPZ in the layout of another version, as Niantic's reference (load-spz.cc) has it."""
    raw = gzip.decompress(b"".join(encode_spz(finite(given), antialias=True)))
    n, rest = len(given["means"]), given["sh_rest"].shape[1]
    head, parts, at = raw[:16], [], 16
    for width in (9, 1, 3, 3, 4, 3 * rest):
        parts.append(raw[at : at + n * width])
        at += n * width
    if version == 2:
        w, x, y, z = decode_spz(gzip.compress(raw), "m").gaussians["quats"].T
        xyz = np.column_stack([x, -y, -z]) * np.where(w < 0, -1, 1)[:, None]
        parts[4] = np.rint(xyz * 127.5 + 127.5).astype(np.uint8).tobytes()
        return gzip.compress(head[:4] + struct.pack("<I", 2) + head[8:] + b"".join(parts))
    zstandard = pytest.importorskip("zstandard")
    packed = [zstandard.ZstdCompressor().compress(part) for part in parts]
    note = b"extension"  # lies before the table
    head = head[:4] + struct.pack("<I", 4) + head[8:15] + bytes([6]) + struct.pack("<I", 32 + len(note))
    sizes = b"".join(struct.pack("<QQ", len(p), len(q)) for p, q in zip(packed, parts))
    return head + bytes(12) + note + sizes + b"".join(packed)


@pytest.mark.parametrize("rest", [0, 15])
@pytest.mark.parametrize("version", [2, 4])
def test_other_versions_of_spz_are_read(tmp_path: Path, version: int, rest: int) -> None:
    given, path = model(rest=rest), tmp_path / "model.spz"
    path.write_bytes(spz_of_version(version, given))
    splats = read_splats(path)
    limits = list(OURS["spz"])
    limits[1] = 6e-3 if version == 2 else limits[1]  # w follows from 8 bits of x, y, z
    check_near(splats.gaussians, given, tuple(limits))
    assert splats.antialias and splats.transform == SceneTransform()
    for cut in (20, 40, path.stat().st_size // 2):
        (tmp_path / "cut.spz").write_bytes(path.read_bytes()[:cut])
        with pytest.raises(AwError, match="cut"):
            read_splats(tmp_path / "cut.spz")


@pytest.mark.parametrize("version", [2, 3, 4])
def test_what_follows_the_end_of_an_spz_is_refused(version: int) -> None:
    given = finite(model(20))
    whole = b"".join(encode_spz(given)) if version == 3 else spz_of_version(version, given)
    assert len(decode_spz(whole, "m").gaussians["means"]) == 20
    for data in (whole + b"\0", whole + whole):
        with pytest.raises(AwError, match="m goes on after the Gaussians that its header announces"):
            decode_spz(data, "m")
    if version == 3:
        raw = bytearray(gzip.decompress(whole) + b"more")
        with pytest.raises(AwError, match="goes on after"):
            decode_spz(gzip.compress(raw), "m")
        raw[14] |= 2  # Niantic's flag for extensions, which follow the Gaussians
        assert len(decode_spz(gzip.compress(raw), "m").gaussians["means"]) == 20


def test_a_gaussian_that_float32_cannot_square_is_refused(tmp_path: Path) -> None:
    given = model(9)
    given["means"][4, 1] = -3e38
    write_splat_ply(tmp_path / "far.ply", given)
    with pytest.raises(AwError, match=r"far\.ply holds a Gaussian with a coordinate above 1e\+18; remove it"):
        read_splats(tmp_path / "far.ply")


def test_a_compressed_ply_without_bounds_of_colours_is_read(tmp_path: Path) -> None:
    given, path = model(300, 0), tmp_path / "old.ply"
    given["sh0"] = np.clip(given["sh0"], -1.7, 1.7)
    given["sh0"][:2] = [[-0.5 / SH_C0] * 3, [0.5 / SH_C0] * 3]
    given["means"] = given["means"][np.argsort(given["means"][:, 0])]
    write("compressed.ply", path, {k: v[:256] for k, v in given.items()})
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = [f"property float {end}_{c}\n".encode() for end in ("min", "max") for c in "rgb"]
    for name in names:
        head = head.replace(name, b"")
    path.write_bytes(head + b"end_header\n" + body[:48] + body[72:])  # one chunk
    check_near(read_splats(path).gaussians, {k: v[:256] for k, v in given.items()}, LOOSE["compressed.ply"])


@pytest.mark.parametrize("ending", FORMS)
def test_any_format_is_told_by_its_bytes_and_has_its_place(tmp_path: Path, ending: str) -> None:
    given, path = model(90), tmp_path / "renamed.bin"
    given["means"][3, 1], given["sh_rest"][4, 2, 0], given["quats"][5] = np.nan, np.inf, 0.0
    place = SceneTransform((5e5, -4e6, 3.0), 0.25, (0.5, 0.5, -0.5, 0.5))
    assert write_splats(FORMS[ending], path, given, place, antialias=True) == 87
    splats = read_splats(path)
    assert splats.transform == place and splats.antialias == (ending != "glb")
    assert len(splats.gaussians["means"]) == 87 and splats.left_out == 0
    with pytest.raises(AwError, match="no Gaussian is finite"):
        write(ending, path, model(0))


@pytest.mark.parametrize("data", [b"", b"ply", b"PK\3\4", b"NGSP", b"glTF", b"\x1f\x8b", b"solid"])
def test_a_file_of_another_kind_is_one_line(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "m").write_bytes(data + b" nothing")
    with pytest.raises(AwError, match=r"/m[: ]") as error:
        read_splats(tmp_path / "m")
    assert "\n" not in str(error.value)


def test_a_file_without_gaussians_is_refused(tmp_path: Path) -> None:
    write_splat_ply(tmp_path / "none.ply", model(0))
    with pytest.raises(AwError, match="no Gaussian"):
        read_splats(tmp_path / "none.ply")


@pytest.mark.parametrize(("count", "rest"), [(700, 0), (700, 3), (700, 8), (700, 15), (1, 15)])
@pytest.mark.parametrize("ending", FORMS)
def test_there_and_back(tmp_path: Path, ending: str, count: int, rest: int) -> None:
    given, path = model(count, rest), tmp_path / f"model.{ending}"
    assert write(ending, path, given) == count
    check_near(read(ending, path), given, OURS[ending])
    first = path.read_bytes()
    write(ending, path, given)
    assert path.read_bytes() == first  # the same model, the same bytes


def test_sizes_are_in_the_order_that_people_expect(tmp_path: Path) -> None:
    given, sizes = model(4000), {}
    for ending in FORMS:
        write(ending, tmp_path / f"model.{ending}", given)
        sizes[ending] = (tmp_path / f"model.{ending}").stat().st_size
    assert (
        sizes["spz"] < sizes["compressed.ply"] < 0.3 * sizes["ply"] and sizes["sog"] < sizes["compressed.ply"]
    )


def test_the_header_of_spz_is_the_specified_one() -> None:
    data = b"".join(encode_spz(finite(model(5)), antialias=True))
    magic, version, points, degree, bits, flags, reserved = struct.unpack_from(
        "<IIIBBBB", gzip.decompress(data)
    )
    assert (magic, version, points, degree, flags, reserved) == (0x5053474E, 3, 5, 3, 1, 0)
    assert 12 <= bits <= 18


def test_far_positions_keep_what_24_bits_allow(tmp_path: Path) -> None:
    given = model(10)
    given["means"] *= 1000
    write("spz", tmp_path / "far.spz", given)
    error = np.abs(matched(read("spz", tmp_path / "far.spz"), given)["means"] - given["means"]).max()
    assert error <= np.abs(given["means"]).max() / 2**22
    given["means"][0, 0] = 1e9
    with pytest.raises(AwError, match="8 388 607 units"):
        write("spz", tmp_path / "too-far.spz", given)
    assert not (tmp_path / "too-far.spz").exists()


def test_a_skybox_does_not_spread_the_scene_over_the_chunks_of_a_compressed_ply(tmp_path: Path) -> None:
    scene, far = model(3000), model(900, seed=1)
    far["means"] *= 1000.0 / np.linalg.norm(far["means"], axis=1, keepdims=True)
    both = {name: np.concatenate([scene[name], far[name]]) for name in scene}
    errors = []
    for name, arrays in (("alone", scene), ("both", both)):
        write("compressed.ply", tmp_path / f"{name}.compressed.ply", arrays)
        back = read("compressed.ply", tmp_path / f"{name}.compressed.ply")["means"]
        near = back[np.linalg.norm(back, axis=1) < 100]
        gaps = np.linalg.norm(near[:, None] - scene["means"][None, ::10], axis=2)
        errors.append(np.quantile(gaps.min(axis=0), 0.9))
    assert errors[1] < 3 * errors[0]


def test_gltf_follows_the_extension(tmp_path: Path) -> None:
    given, path = model(6, rest=3), tmp_path / "m.glb"
    write("glb", path, given)
    data = path.read_bytes()
    assert data[:4] == b"glTF" and struct.unpack_from("<II", data, 4) == (2, len(data))
    length = struct.unpack_from("<I", data, 12)[0]
    head = json.loads(data[20 : 20 + length])
    assert head["extensionsUsed"] == ["KHR_gaussian_splatting"]
    primitive = head["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    names = {f"KHR_gaussian_splatting:SH_DEGREE_1_COEF_{c}" for c in range(3)}
    names |= {f"KHR_gaussian_splatting:{n}" for n in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0")}
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0"} | names
    accessor = head["accessors"][primitive["attributes"]["POSITION"]]
    assert accessor["count"] == 6
    assert np.allclose(accessor["min"], given["means"].min(axis=0)) and np.allclose(
        accessor["max"], given["means"].max(axis=0)
    )
    body = data[20 + length + 8 :]
    view = head["bufferViews"][
        head["accessors"][primitive["attributes"]["KHR_gaussian_splatting:SCALE"]]["bufferView"]
    ]
    scale = np.frombuffer(body, "<f4", 18, view["byteOffset"]).reshape(6, 3)
    assert np.allclose(scale, np.exp(given["log_scales"]), rtol=1e-6)


def drawn(head: dict) -> dict:
    return head["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda head: head["nodes"][0].update(translation=[5, 0, 0]), "whose nodes"),
        (lambda head: head["nodes"].append({"mesh": 0}), "whose nodes"),
        (lambda head: head["buffers"][0].update(uri="other.bin"), "whose external buffer"),
        (lambda head: drawn(head).update(colorSpace="lin_rec709_display"), "whose kernel, colours"),
        (lambda head: head["meshes"][0]["primitives"][0].update(mode=4), "whose kind of primitive"),
        (lambda head: head.update(extensionsRequired=["KHR_draco"]), "whose required extension"),
        (lambda head: head["scenes"][0].update(nodes=[]), "whose scene"),
        (lambda head: head["accessors"][1].update(count=5), "whose counts of rows"),
        (lambda head: head["bufferViews"][0].update(byteStride=24), "whose stride of rows"),
        (lambda head: head["accessors"][0].update(componentType=5123), "whose types of numbers"),
        (lambda head: head["accessors"][0].update(byteOffset=4), "whose offsets of columns"),
        (lambda head: head["bufferViews"][0].update(byteOffset=-4), "lies outside of its data"),
        (lambda head: head["bufferViews"][0].update(byteOffset=10**6), "lies outside of its data"),
    ],
)
def test_a_glb_that_another_program_changed_is_refused(tmp_path: Path, change, words: str) -> None:
    path = tmp_path / "m.glb"
    write("glb", path, model(6))
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    head = json.loads(data[20 : 20 + length])
    change(head)
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, len(data) - length + len(text))
        + struct.pack("<I4s", len(text), data[16:20]) + text + data[20 + length :]
    )  # fmt: skip
    with pytest.raises(AwError, match=words):
        read("glb", path)


@pytest.mark.parametrize("ending", FORMS)
def test_damaged_files_are_one_line(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"bad.{ending}"
    write(ending, path, model(30))
    whole = path.read_bytes()
    for data in (b"", b"hello", whole[: len(whole) // 2], whole[:40], b"\0" * 200):
        path.write_bytes(data)
        with pytest.raises(AwError, match="bad"):
            read(ending, path)
    with pytest.raises(AwError, match="cannot read"):
        read(ending, tmp_path / "absent")


def zip_of(**members: object) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.json", json.dumps(data))
    return out.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 4_000_000_000, 3, 12, 0, 0) + bytes(10**7)),
            "cut short",
        ),
        (zip_of(meta={"version": 7}), "version 7"),
        (
            zip_of(meta={"version": 2}).replace(b"PK\1\2\x14\3\x14", b"PK\1\2\x14\3\xff"),
            "zip file version",
        ),
    ],
    ids=["SPZ that unpacks to much", "SOG of another version", "ZIP of another version"],
)
def test_what_a_header_announces_is_not_believed(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "m").write_bytes(data)
    with pytest.raises(AwError, match=message):
        read_splats(tmp_path / "m")


@pytest.mark.skipif(
    TOOL is None, reason="no splat-transform in PATH (npm install -g @playcanvas/splat-transform)"
)
@pytest.mark.parametrize("ending", QUANTISED)
def test_another_program_reads_what_we_wrote(tmp_path: Path, ending: str) -> None:
    assert TOOL is not None
    given = model(500)
    write(ending, tmp_path / f"m.{ending}", given)
    done = subprocess.run(
        [TOOL, "-w", "-q", str(tmp_path / f"m.{ending}"), str(tmp_path / "back.ply")],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    back = read_splat_ply(tmp_path / "back.ply")
    assert len(back["means"]) == 500
    check_near(finite(back), given, OURS[ending])
    ours = read(ending, tmp_path / f"m.{ending}")
    assert np.abs(finite(back)["means"] - ours["means"]).max() < 1e-5
    assert np.abs(back["sh_rest"] - ours["sh_rest"]).max() < 1e-5
