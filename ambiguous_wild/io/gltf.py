"""Binary glTF 2.0 with KHR_gaussian_splatting: float32 attributes, nothing quantised.

Names and values follow the extension's specification: opacities after the sigmoid, scales after exp,
quaternions x, y, z, w. A node turns the splat PLY's axes (y down) by 180 degrees about z, so that y is up.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, SceneTransform
from ambiguous_wild.io.splat_arrays import (
    SH_C0,
    Arrays,
    SplatFile,
    logit,
    place_facts,
    place_from,
    rounded,
    sigmoid,
)

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_HALF_TURN = [0.0, 0.0, 1.0, 0.0]  # x, y, z, w


def _harmonics(rest: int) -> list[str]:
    degree = round((rest + 1) ** 0.5) - 1
    return [f"SH_DEGREE_{d}_COEF_{c}" for d in range(1, degree + 1) for c in range(2 * d + 1)]


def encode_gltf(gaussians: Arrays, place: SceneTransform = UNMOVED, antialias: bool = False) -> list[bytes]:
    """Return the parts of a .glb; the offset of the place is the node's translation.

    The format cannot say `antialias`.

    Raises:
        AwError: more than 4 GiB.
    """
    n, rest = gaussians["sh_rest"].shape[:2]
    alpha = sigmoid(gaussians["opacity_logits"])
    colour = np.column_stack([gaussians["sh0"] * SH_C0 + 0.5, alpha])
    columns = {
        "POSITION": gaussians["means"],
        "COLOR_0": rounded(colour * 255, 255).astype(np.uint8),  # for viewers without the extension
        f"{EXTENSION}:ROTATION": gaussians["quats"][:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(gaussians["log_scales"].astype(np.float64)),
        f"{EXTENSION}:OPACITY": alpha,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": gaussians["sh0"],
    }
    columns |= {f"{EXTENSION}:{name}": gaussians["sh_rest"][:, k] for k, name in enumerate(_harmonics(rest))}
    views: list[dict[str, int]] = []
    accessors: list[dict[str, object]] = []
    attributes: dict[str, int] = {}
    parts: list[bytes] = []
    offset = 0
    for name, values in columns.items():
        data = values if values.dtype == np.uint8 else values.astype("<f4")
        kind = {"componentType": _BYTE if data.dtype == np.uint8 else _FLOAT, "count": n}
        accessor = {"bufferView": len(views), **kind, "type": _TYPES[data.shape[1] if data.ndim > 1 else 1]}
        if data.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        attributes[name] = len(accessors)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": data.nbytes, "target": _ARRAY_BUFFER})
        accessors.append(accessor)
        parts.append(np.ascontiguousarray(data).tobytes())
        offset += data.nbytes  # every row has a multiple of 4 bytes, so views stay aligned
    body = b"".join(parts)
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: extension}}
    x, y, z = place.centre
    node = {"mesh": 0, "rotation": _HALF_TURN} | ({"translation": [-x, -y, z]} if any(place.centre) else {})
    if place.turn != UNMOVED.turn:  # the caller turned the model so that y is up
        node = {"mesh": 0}
    extras = {"extras": place_facts(place)} if place != UNMOVED else {}
    head = {
        "asset": {"version": "2.0", "generator": "ambiguous_wild", **extras},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
    }
    text = json.dumps(head, separators=(",", ":"), allow_nan=False).encode("ascii")
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(body)
    if total >= 1 << 32:
        raise AwError(f"a .glb holds at most 4 GiB, not {total:,} bytes; export as spz")
    head_bytes = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<II", len(text), _JSON) + text
    return [head_bytes, struct.pack("<II", len(body), _BIN), body]


def decode_gltf(data: bytes, path: Path | str) -> SplatFile:
    """Read a .glb that `encode_gltf` made.

    Raises:
        AwError: another layout.
    """
    try:
        magic, version, _ = struct.unpack_from("<4sII", data)
        length, kind = struct.unpack_from("<II", data, 12)
        head = json.loads(data[20 : 20 + length])
        if (magic, version, kind) != (b"glTF", 2, _JSON):
            raise AwError(f"{path} is no binary glTF 2.0")
        attributes = head["meshes"][0]["primitives"][0]["attributes"]
        body = 20 + length + 8

        def column(name: str) -> np.ndarray:
            accessor = head["accessors"][attributes[name]]
            width = next(k for k, v in _TYPES.items() if v == accessor["type"])
            start = body + int(head["bufferViews"][accessor["bufferView"]]["byteOffset"])
            count = int(accessor["count"])
            rows = np.frombuffer(data, "<f4", count * width, start).reshape(count, width)
            return rows[:, 0] if width == 1 else rows

        rest = sum(name.startswith(f"{EXTENSION}:SH_DEGREE_") for name in attributes) - 1
        means = column("POSITION")
        higher = [column(f"{EXTENSION}:{name}") for name in _harmonics(rest)]
        arrays = {
            "means": means,
            "quats": column(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]],
            "log_scales": np.log(column(f"{EXTENSION}:SCALE")),
            "opacity_logits": logit(column(f"{EXTENSION}:OPACITY")),
            "sh0": column(f"{EXTENSION}:SH_DEGREE_0_COEF_0"),
            "sh_rest": np.stack(higher, axis=1) if higher else np.zeros((len(means), 0, 3), np.float32),
        }
        return SplatFile(arrays, place_from(head["asset"].get("extras")))
    except (
        struct.error,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        StopIteration,
        RecursionError,
    ) as error:
        raise AwError(f"{path} is no glTF as 'aw export' writes it: {error}") from None
