"""Binary glTF 2.0 with KHR_gaussian_splatting: float32 attributes, nothing quantised.

Names and values follow the extension's specification: opacities after the sigmoid, scales after exp,
quaternions x, y, z, w. A node turns the splat PLY's axes (y down) by 180 degrees about z, so that y is up.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, SceneTransform
from ambiguous_wild.io.splat_arrays import (
    SH_C0,
    Arrays,
    SplatFile,
    logit,
    rounded,
    sigmoid,
    transform_from,
    transform_record,
)

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_HALF_TURN = [0.0, 0.0, 1.0, 0.0]  # x, y, z, w


def _harmonics(rest: int) -> list[str]:
    degree = round((rest + 1) ** 0.5) - 1
    return [f"SH_DEGREE_{d}_COEF_{c}" for d in range(1, degree + 1) for c in range(2 * d + 1)]


_DRAWN = {  # how the Gaussians of our files are to be drawn
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "sortingMethod": "cameraDistance",
    "projection": "perspective",
}


def encode_gltf(
    gaussians: Arrays, transform: SceneTransform = UNMOVED, antialias: bool = False
) -> list[bytes]:
    """Return the parts of a .glb; the offset of the transform is the node's translation.

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
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: _DRAWN}}
    extras = {"extras": transform_record(transform)} if transform != UNMOVED else {}
    head = {
        "asset": {"version": "2.0", "generator": "ambiguous_wild", **extras},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [_node(transform)],
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


def _node(transform: SceneTransform) -> dict[str, object]:
    """Return the node that turns and moves the model to where glTF's viewers expect it."""
    if transform.quat != UNMOVED.quat:  # the caller turned the model so that y is up
        return {"mesh": 0}
    x, y, z = transform.centre
    return {"mesh": 0, "rotation": _HALF_TURN} | (
        {"translation": [-x, -y, z]} if any(transform.centre) else {}
    )


def _changed(head: dict[str, Any], transform: SceneTransform) -> str:
    """Name what a file has that ours have not, and that changes where or how Gaussians are read."""
    primitives = [primitive for mesh in head["meshes"] for primitive in mesh["primitives"]]
    named = {name: head["accessors"][index] for name, index in primitives[0]["attributes"].items()}
    used = list(named.values())
    views = [head["bufferViews"][accessor["bufferView"]] for accessor in used]
    found = {
        "nodes": head["nodes"] != [_node(transform)],
        "second mesh": len(primitives) > 1,
        "kernel, colours, order or projection": primitives[0].get("extensions", {}).get(EXTENSION) != _DRAWN,
        "kind of primitive": primitives[0].get("mode") != _POINTS,
        "required extension": bool(set(head.get("extensionsRequired", ())) - {EXTENSION}),
        "scene": (head.get("scene"), head.get("scenes")) != (0, [{"nodes": [0]}]),
        "counts of rows": len({accessor["count"] for accessor in used}) > 1,
        "external buffer": any("uri" in buffer for buffer in head["buffers"]) or len(head["buffers"]) > 1,
        "stride of rows": any("byteStride" in view for view in views),
        "types of numbers": any(
            "sparse" in a or a["componentType"] != (_BYTE if name.startswith("COLOR") else _FLOAT)
            for name, a in named.items()
        ),
        "offsets of columns": any(accessor.get("byteOffset", 0) for accessor in used),
    }
    return next((name for name, there in found.items() if there), "")


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
        transform = transform_from(head["asset"].get("extras"))
        if changed := _changed(head, transform):
            raise AwError(
                f"{path} was changed by another program, whose {changed} this reader does not follow; "
                "export the model again, or save it as PLY there"
            )
        body = 20 + length + 8

        def column(name: str) -> np.ndarray:
            accessor = head["accessors"][attributes[name]]
            width = next(k for k, v in _TYPES.items() if v == accessor["type"])
            view, count = head["bufferViews"][accessor["bufferView"]], int(accessor["count"])
            if not 0 <= int(view["byteOffset"]) <= len(data) - body - 4 * count * width:
                raise AwError(f"{path} is damaged: {name} lies outside of its data")
            start = body + int(view["byteOffset"])
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
        return SplatFile(arrays, transform)
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
