"""Cameras of a capture: pose and focal length of every photo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.simulate.spec import FULL_FRAME_DIAGONAL_MM, CaptureSpec
from ambiguous_wild.simulate.world import World

_NEAREST_WALL_M = 0.1
_AHEAD_M = 4.0  # to what an outward camera looks at


def focal_px(spec: CaptureSpec) -> float:
    """Focal length in px of the 35 mm equivalent: same angle over the diagonal (CIPA)."""
    return spec.focal_35mm / FULL_FRAME_DIAGONAL_MM * float(np.hypot(spec.width, spec.height))


def look_at(eye: np.ndarray, target: np.ndarray, roll_deg: float) -> np.ndarray:
    """cam_from_world [4, 4] of a camera at `eye` that looks at `target`; z is up in the world."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose


def plan_cameras(
    spec: CaptureSpec, world: World, rng: np.random.Generator
) -> tuple[list[Camera], list[Camera]]:
    """Train cameras along an arc with varying distance and height; test cameras within their range.

    Test viewpoints have other angles than the train photos, and distances and heights between theirs. An
    outward walk goes around the hub and looks away from it.

    Raises:
        AwError: the walk leads into a wall.
    """
    half = np.deg2rad(spec.arc_deg / 2)
    phase = rng.uniform(0, 2 * np.pi, 2)
    outward = spec.walk == "outward"
    plan = world.plan

    def camera(azimuth: float, sway: float, rise: float, shake: float) -> Camera:
        radius = np.interp(sway, (-1, 1), spec.radius_m)
        height = np.interp(rise, (-1, 1), spec.eye_m)
        center = np.array([world.hub[0], world.hub[1] - (0.0 if outward else 0.3)])
        direction = np.array([np.sin(azimuth), -np.cos(azimuth)])
        eye = np.array([*(center + radius * direction), height])
        behind = "wall_front" in plan.walls and eye[1] < plan.y_m[0] + _NEAREST_WALL_M
        if (
            not plan.x_m[0] + _NEAREST_WALL_M <= eye[0] <= plan.x_m[1] - _NEAREST_WALL_M
            or eye[1] > plan.y_m[1] - _NEAREST_WALL_M
            or behind
        ):
            raise AwError(
                f"arc_deg {spec.arc_deg:g} and radius_m {spec.radius_m[0]:g} to {spec.radius_m[1]:g} lead "
                f"the camera into a wall of the {spec.world.place}; lower one of them"
            )
        target = np.array([*center, 1.25])
        if outward:  # straight away from the hub
            target = np.array([*(eye[:2] + _AHEAD_M * direction), height + 0.1])
        target = target + rng.normal(0, 0.16, 3) * shake
        f = focal_px(spec)
        pose = look_at(eye, target, float(rng.normal(0, 1.2)) * shake)
        return Camera(spec.width, spec.height, f, f, spec.width / 2, spec.height / 2, pose)

    turn_round = spec.arc_deg >= 360  # the last photo stands beside the first one
    step = 2 * half / (spec.train_views - (0 if turn_round else 1))
    train = []
    for k in range(spec.train_views):
        azimuth = -half + step * (k + (rng.uniform(-0.25, 0.25) if 0 < k < spec.train_views - 1 else 0))
        turn = 2 * np.pi * 3 * k / spec.train_views
        sway, rise = np.sin(turn + phase[0]), np.sin(1.7 * turn + phase[1])
        train.append(camera(azimuth, float(sway), float(rise), 1.0))
    test = []
    for k in range(spec.test_views):
        gap = round((k + 0.5) / spec.test_views * (spec.train_views - 1) - 0.5)
        azimuth = -half + step * (gap + rng.uniform(0.35, 0.65))
        test.append(camera(azimuth, rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), 0.7))
    return _zoomed(train, spec, 0.0), _zoomed(test, spec, 0.35)


def _zoomed(cameras: list[Camera], spec: CaptureSpec, shift: float) -> list[Camera]:
    """The cameras at focal lengths spread over ``spec.zoom``, evenly in their logarithm."""
    low, high = spec.zoom
    if low == high == 1.0:
        return cameras
    zoomed = []
    for k, camera in enumerate(cameras):
        share = (k * 0.6180339887 + shift) % 1.0  # multiples of the golden ratio: even and unordered
        factor = low * (high / low) ** share
        zoomed.append(replace(camera, fx=camera.fx * factor, fy=camera.fy * factor))
    return zoomed
