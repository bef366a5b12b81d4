"""Small random scenes and short trainings for tests."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import Cotangents
from ambiguous_wild.splat.step import ViewContext
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train


def camera(width=37, height=29, *, angle=0.3, fx=30.0, fy=33.0, cx=None, cy=None) -> Camera:
    """Turned about y and shifted, with unequal focal lengths and an off-centre principal point."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.1, -0.2, 0.3]
    cx = width / 2 + 1 if cx is None else cx
    cy = height / 2 - 2 if cy is None else cy
    return Camera(width, height, fx, fy, cx, cy, pose)


def shot_of(view: int | None, at: Camera | None = None) -> ViewContext:
    return ViewContext(iteration=0, nominal=0.0, view=view, camera=camera() if at is None else at)


def disturbed(camera: Camera, rotation, shift) -> np.ndarray:
    """The camera's pose [4, 4] followed by a turn (rotation vector, rad) and a shift, both in camera axes."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), shift
    return motion @ camera.cam_from_world


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def gaussians(seed=0, n=60, *, rest=15, size=-1.5) -> Gaussians:
    """Some behind the camera, some outside the frame, opaque and faint, colours on both sides of 0."""
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    return Gaussians(
        means=normal(n, 3) * torch.tensor([2.0, 1.5, 1.5]) + torch.tensor([0.0, 0.0, 3.0]),
        quats=normal(n, 4),
        log_scales=normal(n, 3) * 0.7 + size,
        opacity_logits=normal(n) * 2 + 1,
        sh0=normal(n, 3),
        sh_rest=normal(n, rest, 3) * 0.2,
    )


def doubles(g: Gaussians, *, grad=True) -> dict[str, torch.Tensor]:
    """The same parameters in float64, leaves of a graph."""
    return {name: tensor.double().requires_grad_(grad) for name, tensor in g.items()}


def cotangents(height, width, seed=0) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(seed)
    shapes = {"d_image": (height, width, 3), "d_image_extra": (height, width, 3)}
    shapes |= {"d_alpha": (height, width), "d_depth": (height, width)}
    return {k: torch.from_numpy(rng.normal(size=s).astype(np.float32)) for k, s in shapes.items()}


def given(d: dict[str, torch.Tensor]) -> Cotangents:
    """`cotangents` as a render takes them."""
    names = ("d_image", "d_image_extra", "d_alpha", "d_depth")
    return Cotangents(*(d.get(name) for name in names))


def trainer_for(scene, folder, *, parts=None, probe=None, change=None, **config) -> Trainer:
    """60 iterations on the CPU, unless asked otherwise; `change` makes other data of what was read."""
    data = load_train_data(scene, device=torch.device("cpu"), seed=config.get("seed", 0), cache_dir=folder)
    data = data if change is None else change(data)
    config = TrainConfig(**{"iterations": 60, "probes": 0} | config)
    return Trainer(data, parts or MethodHooks(), config, folder=folder, probe=probe)


def trained(scene, folder, **kw) -> Trainer:
    trainer = trainer_for(scene, folder, **kw)
    train(trainer)
    return trainer


def bits(trainer: Trainer) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in trainer.gaussians.items()}


def same(a: object, b: object) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return torch.equal(a, b)
    return bool(a == b)
