"""The model: N anisotropic Gaussians as raw (unactivated) parameters, one torch tensor each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError

MIN_POINTS = 4  # points to start from: the size of a Gaussian is the distance of three neighbours
# what the renderer reads, in the order of the fields of `Gaussians` and `Gradients`
PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest")
SH_C0 = 0.28209479177387814  # zeroth real spherical harmonic, 1 / (2 sqrt(pi))


class PendingSteps:
    """Updates of rows of `sh_rest` that an optimiser has pending until they are read.

    All Gaussians with the optimiser's `sh_rest` share one object, so that each can ask for the updates.
    """

    def __init__(self, make: Callable[[np.ndarray | None], None]) -> None:
        """
        Args:
            make: makes the updates of these rows (int32 indices; None = all).
        """
        self._make: Callable[[np.ndarray | None], None] | None = make

    def make(self, rows: np.ndarray | None = None) -> None:
        """Make the updates of these rows (indices; None = all)."""
        if self._make is not None:
            self._make(rows)

    def end(self) -> None:
        """Make all updates; from now on the optimiser leaves none of these rows pending."""
        self.make()
        self._make = None


@dataclass
class Gaussians:
    """Raw parameters, all float32 on one device; activations happen inside the renderer.

    covariance = R(quats / |quats|) diag(exp(log_scales))^2 R^T, opacity = sigmoid(opacity_logits),
    colour = max(SH(direction) + 0.5, 0).
    """

    means: Tensor  # [N, 3] world
    quats: Tensor  # [N, 4] w, x, y, z; any positive norm
    log_scales: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    sh0: Tensor  # [N, 3] coefficient of the constant harmonic
    sh_rest: Tensor  # [N, (D + 1)^2 - 1, 3] the others, D = largest degree (0 to 3)
    _: KW_ONLY
    # [N, ...] further tensors of a method, by name; density control copies and drops their rows too
    attributes: Mapping[str, Tensor] = field(default_factory=dict)

    # Updates that an optimiser has pending for rows that no view saw; None = `sh_rest` is up to date. The
    # renderer applies them to the rows that it is about to draw. `dataclasses.replace` keeps them; copies are
    # up to date.
    pending_steps: PendingSteps | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {
            "means": (n, 3),
            "quats": (n, 4),
            "log_scales": (n, 3),
            "opacity_logits": (n,),
            "sh0": (n, 3),
        }
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise AwError(f"{name} must be {list(shape)}, got {list(getattr(self, name).shape)}")
        rest = tuple(self.sh_rest.shape)
        if len(rest) != 3 or rest[0] != n or rest[1] not in (0, 3, 8, 15) or rest[2] != 3:
            raise AwError(f"sh_rest must be [{n}, 0|3|8|15, 3], got {list(rest)}")
        for name, tensor in self.attributes.items():
            if name in PARAMETERS or tensor.shape[:1] != (n,):
                raise AwError(
                    f"attribute {name!r} must be [{n}, ...] under a name of its own, got {list(tensor.shape)}"
                )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def sh_degree(self) -> int:
        """Largest SH degree that the parameters can hold."""
        return round((self.sh_rest.shape[1] + 1) ** 0.5) - 1

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """Yield name and tensor of what the renderer reads, in the order of `PARAMETERS`."""
        for name in PARAMETERS:
            yield name, getattr(self, name)

    def named_tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Yield name and tensor of everything that a Gaussian has: `items`, then `attributes`."""
        yield from self.items()
        yield from self.attributes.items()

    def flush(self) -> None:
        """Make the updates that an optimiser has pending, so that `sh_rest` may be read."""
        if self.pending_steps is not None:
            self.pending_steps.make()

    def share_pending_updates(self, source: Gaussians) -> Gaussians:
        """Let these Gaussians, made of `source` with its `sh_rest`, ask for its updates; returns them."""
        if self.pending_steps is None:
            self.pending_steps = source.pending_steps
        return self

    def select(self, rows: Tensor) -> Gaussians:
        """Copy the rows of a bool mask [N] or an index tensor; the copy is up to date."""
        return self._each(lambda name, tensor: tensor[rows].contiguous())

    def with_sh_degree(self, degree: int) -> Gaussians:
        """Return a copy with this SH degree: higher harmonics are dropped, missing ones are 0."""
        rest = (degree + 1) ** 2 - 1
        padding = (0, 0, 0, rest - self.sh_rest.shape[1])  # negative: cuts
        return replace(self, sh_rest=torch.nn.functional.pad(self.sh_rest, padding).contiguous())

    def cat(self, other: Gaussians) -> Gaussians:
        """Return these rows followed by those of `other`.

        Raises:
            AwError: the two have different attributes.
        """
        if self.attributes.keys() != other.attributes.keys():
            differing = ", ".join(sorted(self.attributes.keys() ^ other.attributes.keys()))
            raise AwError(f"cannot join Gaussians: only one side has the attributes {differing}")
        other.flush()
        theirs = dict(other.named_tensors())
        return self._each(lambda name, tensor: torch.cat([tensor, theirs[name]]).contiguous())

    def to(self, device: torch.device | str) -> Gaussians:
        """Return the Gaussians on a device; tensors that lie there already are shared."""
        return self._each(lambda name, tensor: tensor.to(device).contiguous())

    def clone(self) -> Gaussians:
        """Return a copy whose `sh_rest` is up to date."""
        return self._each(lambda name, tensor: tensor.clone())

    def with_attributes(self, attributes: Mapping[str, Tensor]) -> Gaussians:
        """Return the Gaussians with further attributes."""
        return replace(self, attributes={**self.attributes, **attributes})

    def _each(self, change: Callable[[str, Tensor], Tensor]) -> Gaussians:
        self.flush()
        changed = [change(name, tensor) for name, tensor in self.items()]
        attributes = {name: change(name, tensor) for name, tensor in self.attributes.items()}
        shared = changed[-1] is self.sh_rest  # it lay on that device already: no copy was made
        return Gaussians(
            *changed, attributes=attributes, pending_steps=self.pending_steps if shared else None
        )

    @classmethod
    def from_points(
        cls,
        xyz: np.ndarray,  # [M, 3]
        rgb: np.ndarray,  # [M, 3] uint8
        *,
        sh_degree: int = 3,
        opacity: float = 0.1,
        device: torch.device | str = "cpu",
    ) -> Gaussians:
        """Start as 3DGS: one isotropic Gaussian at each point, as large as its three neighbours are far.

        Args:
            xyz: points in the world.
            rgb: colours of the points, uint8.
            sh_degree: largest SH degree to hold, 0 to 3.
            opacity: opacity of every Gaussian.
            device: device of the Gaussians.

        Raises:
            AwError: fewer than 4 points.
        """
        if len(xyz) < MIN_POINTS:
            raise AwError(
                f"cannot start from {len(xyz)} points: at least {MIN_POINTS} are needed; "
                "check the sparse model"
            )
        from scipy.spatial import cKDTree

        distances = cKDTree(xyz).query(xyz, k=4)[0][:, 1:]  # distances to the three nearest other points
        scale = np.sqrt((distances**2).mean(axis=1)).clip(min=1e-7)  # coincident points stay finite
        n = len(xyz)
        quats = torch.zeros(n, 4)
        quats[:, 0] = 1.0
        rest = (sh_degree + 1) ** 2 - 1
        return cls(
            means=torch.from_numpy(np.ascontiguousarray(xyz, dtype=np.float32)),
            quats=quats,
            log_scales=torch.from_numpy(np.log(scale).astype(np.float32))[:, None].repeat(1, 3).contiguous(),
            opacity_logits=torch.full((n,), float(np.log(opacity / (1 - opacity)))),
            sh0=torch.from_numpy(((rgb.astype(np.float64) / 255.0 - 0.5) / SH_C0).astype(np.float32)),
            sh_rest=torch.zeros(n, rest, 3),
        ).to(device)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return rotation matrices [N, 3, 3] of quaternions [N, 4] (w, x, y, z), which are normalised here."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)
