"""Read cameras of Agisoft Metashape: the XML of File > Export > Export Cameras.

Camera to chunk has OpenCV's axes; a component or the chunk states chunk to world as s R x + t. The lens
follows the manual's appendix on camera models, whose P1 and P2 are OpenCV's p2 and p1.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ambiguous_wild.core.camera import rigid
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.datasets.foreign import ForeignScene
from ambiguous_wild.datasets.readers import posed_photos
from ambiguous_wild.io.colmap_records import SPLIT_PANORAMAS, ModelCamera
from ambiguous_wild.io.untrusted import read_text

FISHEYES = ("fisheye", "equidistant_fisheye")  # one lens: Metashape 2.3 calls it by the longer name
LENS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


def find_cameras(root: Path) -> Path | None:
    """Find the folder's XML of cameras; None without one."""
    return posed_photos.only_file(root, ".xml", lambda path: b"<chunk" in path.read_bytes()[:4096])


def read_metashape(root: Path) -> ForeignScene:
    """Read poses and lenses of the aligned cameras of one chunk, and the point cloud of a PLY beside."""
    path = find_cameras(root)
    if path is None:
        raise AwError(f"{root} has no XML of Metashape's File > Export > Export Cameras")
    text = read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities may expand without limit
        raise AwError(f"{path} has a DOCTYPE or entities, which Metashape does not write; do not use it")
    with posed_photos.tool_errors("Metashape", path):
        chunks = [c for c in ElementTree.fromstring(text).iter("chunk") if c.find("cameras") is not None]
        if len(chunks) != 1:
            raise AwError(f"{path} holds {counted(len(chunks), 'chunk')} with cameras; export one")
        (chunk,) = chunks
        every = chunk.findall("cameras//camera")
        used = [
            c for c in every if c.find("transform") is not None and c.get("enabled") not in ("0", "false")
        ]
        if rig := [c.attrib["label"] for c in every if "master_id" in c.attrib]:
            raise AwError(
                f"{path}: {shortlist(rig, 3)} belong to a multi-camera system, whose first camera alone has "
                "poses: export COLMAP from Metashape 2.3"
            )
        if not used:
            raise AwError(f"{path}: none of {counted(len(every), 'camera')} is aligned")
        seen = {c.attrib["sensor_id"] for c in used}
        sensors = {s.attrib["id"]: s for s in chunk.findall("sensors/sensor")}
        lenses = {key: _camera(sensors[key], f"{path}, sensor {key}") for key in seen}
        moves = {c.get("id"): _move(c.find("transform")) for c in chunk.findall("components/component")}
        whole = _move(chunk.find("transform"))
        parts = {c.get("component_id") for c in used}
        if len(parts) > 1 and whole is None and any(moves.get(part) is None for part in parts):
            raise AwError(
                f"{path}: the photos lie in {len(parts)} components without common coordinates; export one"
            )
        photos = root / "images" if (root / "images").is_dir() else root
        rows = []
        for camera, name in zip(
            used, posed_photos.find_posed(photos, [c.attrib["label"] for c in used], path)
        ):
            own = moves.get(camera.get("component_id"))
            if own is not None and whole is not None and not np.allclose(own, whole):
                raise AwError(f"{path}: component and chunk state different transforms; export one")
            move = next((m for m in (own, whole) if m is not None), np.eye(4))
            pose = move @ _numbers(camera.find("transform"), 4, 4) @ np.diag([1, -1, -1, 1])
            pose[:3, :3] /= np.cbrt(abs(np.linalg.det(move[:3, :3])))
            rows.append((name, pose, lenses[camera.attrib["sensor_id"]]))
        # Of a chunk on a map, the points are in the map's projection, but the cameras are geocentric.
        placed = whole is not None or any(move is not None for move in moves.values())
        local = not placed or "LOCAL_CS" in (chunk.findtext("reference") or "LOCAL_CS")
    left = len(every) - len(used)
    notes = [f"{counted(left, 'photo')} not aligned or not enabled: left out"] if left else []
    if not local:
        notes.append("a chunk on a map: its point cloud would have other coordinates than its cameras")
    return posed_photos.posed_scene("metashape", root, photos, rows, notes, points=local)


def _numbers(element: Element | None, *shape: int) -> np.ndarray:
    text = element.text if element is not None else None
    return np.array((text or "").split(), np.float64).reshape(shape)


def _move(transform: Element | None) -> np.ndarray | None:
    """Return the transform [4, 4] of a component or chunk; None without one."""
    if transform is None or transform.find("rotation") is None:
        return None
    scaled = _numbers(transform.find("rotation"), 3, 3) * _numbers(transform.find("scale"), 1)
    return rigid(scaled, _numbers(transform.find("translation"), 3))


def _camera(sensor: Element, where: str) -> ModelCamera:
    """Read the sensor's adjusted calibration."""
    kind = sensor.get("type", "")
    if kind != "frame" and kind not in FISHEYES:
        what = SPLIT_PANORAMAS if kind == "spherical" else "export undistorted photos"
        raise AwError(f"{where} is of type {kind[:40]!r}, neither frame nor equidistant fisheye: {what}")
    stated = {c.get("class"): c for c in sensor.findall("calibration")}
    lens = stated.get("adjusted", stated.get("initial"))
    if lens is None:
        raise AwError(f"{where} has no calibration: align the photos before the export")
    f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4 = (float(lens.findtext(key, "0")) for key in LENS)
    if p3 or p4:
        raise AwError(f"{where} has p3 or p4, which no other tool has: export undistorted photos")
    size = next(s for s in (lens.find("resolution"), sensor.find("resolution")) if s is not None)
    width, height = int(size.attrib["width"]), int(size.attrib["height"])
    pinhole, shear = (f + b1, f, width / 2 + cx, height / 2 + cy), b2 / f if f else 0.0
    if kind == "frame":
        return posed_photos.brown_camera((width, height), pinhole, (k1, k2, k3, k4), (p2, p1), where, shear)
    params = (*pinhole, k1, k2, p2, p1, k3, k4, 0.0, 0.0)
    return ModelCamera(1, "THIN_PRISM_FISHEYE", width, height, params, shear)
