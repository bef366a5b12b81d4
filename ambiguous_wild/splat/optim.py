"""Adam over the Gaussians that costs what a view sees and equals Adam over all of them, bit for bit.

Culling reads means, quats, scales and opacity (and every view reads sh0): these 14 floats a Gaussian step
at once, seen or not. The harmonics above the constant, 45 floats, are read only when a Gaussian is drawn:
a row nobody sees is put off and takes its steps with gradient zero when the renderer is about to draw it
(`Gaussians.postponed`), or at `flush`. On an accelerator torch's fused kernel steps every row, one
launch a tensor, and a flag there can call the step off without the host's knowing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians, Postponed
from ambiguous_wild.splat.rendered import Gradients

_LAZY = "sh_rest"


class SplatAdam:
    """Adam (Kingma and Ba) with one step count for all rows; new rows start with zero moments.

    Holds the tensors of one `Gaussians` and changes them in place. Whoever replaces the Gaussians tells
    the rows (`select`, `append`) and then hands over the new object (`bind`). Read `sh_rest` outside the
    CPU renderer only after `flush`.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        # one a tensor, names as Gaussians.rows(); what is carried (`extra`) and has none is not learnt
        learning_rates: Mapping[str, float],
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        *,
        lazy: bool = True,  # False steps every row of sh_rest at once: the same bits, more memory traffic
    ) -> None:
        self.betas, self.eps = betas, eps
        self._kernels = backend_of(gaussians.device).kernels
        self.steps = 0  # a GPU counts for itself, see `_count`
        self._count = torch.zeros((), device=gaussians.device)
        self._rates: dict[str, float] = {}
        self._moments = {
            name: (torch.zeros_like(tensor), torch.zeros_like(tensor))
            for name, tensor in gaussians.rows()
            if name in PARAMETERS or name in learning_rates
        }
        self._lazy = lazy and self._kernels
        self._taken = np.zeros(len(gaussians), np.int64)  # steps each row of sh_rest has taken
        self._history = np.zeros((2, 256), np.float32)  # a step's lr / bias1 of sh_rest, and 1 / sqrt(bias2)
        self._rows = len(gaussians)
        self._bound: Gaussians | None = None
        self._postponed: Postponed | None = None  # of the Gaussians bound now, where rows are put off
        self.bind(gaussians)
        self._set_rates(learning_rates)

    # -- rows -------------------------------------------------------------------------------------

    @property
    def gaussians(self) -> Gaussians:
        """What is optimised.

        Raises:
            RuntimeError: rows were selected or appended and no new Gaussians were bound since.
        """
        if self._bound is None:
            raise RuntimeError("rows changed: call bind(gaussians) with the new Gaussians first")
        return self._bound

    def bind(self, gaussians: Gaussians) -> None:
        """Go on with these tensors: the same rows as the moments, after `select` and `append`.

        Raises:
            RuntimeError: another number of rows than moments.
        """
        if len(gaussians) != self._rows:
            raise RuntimeError(f"{len(gaussians)} Gaussians but moments for {self._rows} rows")
        if gaussians is self._bound:
            return
        self._unbind()
        self._bound = gaussians
        if self._lazy:
            self._postponed = gaussians.postponed = Postponed(self.catch_up)

    def select(self, rows: Tensor) -> None:
        """Keep the moments of these rows (bool mask [N] or indices), in that order; `bind` comes next."""
        self._unbind()
        self._moments = {
            name: (m[rows].contiguous(), v[rows].contiguous()) for name, (m, v) in self._moments.items()
        }
        self._taken = np.full(len(self._moments["means"][0]), self.steps, np.int64)
        self._rows = len(self._taken)

    def append(self, n: int) -> None:
        """n rows of zero moments at the end; `bind` comes next."""
        self._unbind()

        def longer(moment: Tensor) -> Tensor:
            return torch.cat([moment, moment.new_zeros(n, *moment.shape[1:])])

        self._moments = {name: (longer(m), longer(v)) for name, (m, v) in self._moments.items()}
        self._rows += n
        self._taken = np.full(self._rows, self.steps, np.int64)

    @property
    def rates(self) -> Mapping[str, float]:
        """Learning rates of the last step, or of the first before it."""
        return self._rates

    def reset_moments(self, names: Iterable[str], rows: Tensor | None = None) -> None:
        """Zero the moments of these tensors, of all rows or of `rows` (mask or indices)."""
        for name in names:
            if name not in self._moments:
                raise unknown("parameter", name, self._moments)
            if name == _LAZY and self._bound is not None:
                self.flush()
            for moment in self._moments[name]:
                if rows is None:
                    moment.zero_()
                else:
                    moment[rows] = 0.0

    def _unbind(self) -> None:
        if self._postponed is not None:
            self._postponed.end()
        self._bound = self._postponed = None

    # -- steps ------------------------------------------------------------------------------------

    def prepare(self, camera: Any = None) -> None:
        """Before a render: nothing to do for the rows (the renderer asks), only the binding is checked."""
        _ = self.gaussians

    def step(
        self,
        grads: Gradients,
        visible: Tensor,  # [N] bool; rows of sh_rest outside have gradient zero
        learning_rates: Mapping[str, float] | None = None,  # for this step and on; None keeps the last
        *,
        called_off: Tensor | None = None,  # on an accelerator, [1] float32 there: 1 = change nothing
    ) -> None:
        """One step of every row.

        Raises:
            AwError: a learning rate is missing or has an unknown name.
        """
        if learning_rates is not None:
            self._set_rates(learning_rates)
        gaussians = self.gaussians
        if not self._kernels:
            self._step_fused(gaussians, grads, called_off)
            return
        now, self.steps = self.steps, self.steps + 1
        bias1 = 1 - self.betas[0] ** self.steps
        root = (1 - self.betas[1] ** self.steps) ** -0.5
        steps = {name: rate / bias1 for name, rate in self._rates.items()}
        self._step_cpu(gaussians, grads, visible, now, steps, root)

    def catch_up(self, rows: np.ndarray | None = None) -> None:
        """Let these rows of sh_rest (indices; None: all) take the steps they were put off."""
        if not self._lazy or self.steps == 0 or self.gaussians.sh_rest.shape[1] == 0:
            return
        from ambiguous_wild.splat.cpu import adam
        from ambiguous_wild.splat.cpu.compile import threads

        p = self.gaussians.sh_rest
        width = 3 * p.shape[1]
        tail = (
            self._taken,
            self.steps,
            self._history[0],
            self._history[1],
            *self._constants(),
            8 * threads(),
        )
        if rows is None:
            adam.catch_up_all(width, *self._flat(_LAZY, p), *tail)
        else:
            adam.catch_up(np.ascontiguousarray(rows), width, *self._flat(_LAZY, p), *tail)

    def flush(self) -> None:
        """Bring every row up to date."""
        self.catch_up(None)

    def _constants(self) -> tuple[np.float32, ...]:
        # 1 - beta is rounded after the difference: float32(0.999) alone is off by 5e-5 of 0.001.
        return tuple(np.float32(c) for c in (*(c for b in self.betas for c in (b, 1 - b)), self.eps))

    def _flat(self, name: str, parameter: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        m, v = self._moments[name]
        if not parameter.is_contiguous():
            raise RuntimeError(f"{name} is not contiguous: the optimiser changes it in place")
        return parameter.detach().numpy().reshape(-1), m.numpy().reshape(-1), v.numpy().reshape(-1)

    def _step_cpu(
        self,
        gaussians: Gaussians,
        grads: Gradients,
        visible: Tensor,
        now: int,
        steps: dict[str, float],
        root: float,
    ) -> None:
        from ambiguous_wild.splat.cpu import adam
        from ambiguous_wild.splat.cpu.compile import threads

        if now >= self._history.shape[1]:
            self._history = np.concatenate([self._history, np.zeros_like(self._history)], axis=1)
        self._history[:, now] = steps[_LAZY], root
        parts = 8 * threads()
        for name, tensor in self._learnt(gaussians):
            if name != _LAZY or not self._lazy:
                gradient = _of(grads, name, tensor).numpy().reshape(-1)
                rate, scale = np.float32(steps[name]), np.float32(root)
                adam.dense(*self._flat(name, tensor), gradient, rate, scale, *self._constants(), parts)
        if not self._lazy:
            self._taken[:] = self.steps
        elif gaussians.sh_rest.shape[1]:
            gradient = grads.sh_rest.detach().to(torch.float32).contiguous().numpy()
            adam.sparse(
                visible.numpy(), 3 * gaussians.sh_rest.shape[1], *self._flat(_LAZY, gaussians.sh_rest),
                gradient.reshape(-1), self._taken, now, self._history[0], self._history[1],
                *self._constants(), parts,
            )  # fmt: skip

    @torch.no_grad()
    def _step_fused(self, gaussians: Gaussians, grads: Gradients, called_off: Tensor | None) -> None:
        self._count += 1
        for name, tensor in self._learnt(gaussians):
            if tensor.numel() == 0:
                continue
            gradient = _of(grads, name, tensor)
            mean, square = self._moments[name]
            torch._fused_adam_(
                [tensor], [gradient], [mean], [square], [], [self._count],
                lr=self._rates[name], beta1=self.betas[0], beta2=self.betas[1], weight_decay=0.0,
                eps=self.eps, amsgrad=False, maximize=False, grad_scale=None, found_inf=called_off,
            )  # fmt: skip
        if called_off is not None:
            self._count -= called_off.reshape(())

    def _learnt(self, gaussians: Gaussians) -> Iterator[tuple[str, Tensor]]:
        return ((name, tensor) for name, tensor in gaussians.rows() if name in self._moments)

    def _set_rates(self, rates: Mapping[str, float]) -> None:
        for name in rates:
            if name not in self._moments:
                raise unknown("learning rate", name, self._moments)
        missing = [name for name in self._moments if name not in rates]
        if missing:
            raise AwError(f"learning rates lack {', '.join(missing)}; give one for every tensor")
        self._rates = {name: float(rates[name]) for name in self._moments}

    # -- state ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Steps and moments as plain tensors, every row up to date; the parameters are the caller's."""
        self.flush()
        return {
            "steps": self.steps if self._kernels else int(self._count),
            "rates": dict(self._rates),
            "first": {name: m for name, (m, _) in self._moments.items()},
            "second": {name: v for name, (_, v) in self._moments.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict` with the Gaussians bound now.

        Raises:
            AwError: moments of another shape than the Gaussians.
        """
        gaussians = self.gaussians
        moments = {}
        for name, tensor in self._learnt(gaussians):
            pair = tuple(
                state[key][name].to(tensor.device, torch.float32).clone() for key in ("first", "second")
            )
            if pair[0].shape != tensor.shape or pair[1].shape != tensor.shape:
                raise AwError(
                    f"moments of {name} are {list(pair[0].shape)}, the Gaussians {list(tensor.shape)}"
                )
            moments[name] = pair
        self._moments = moments
        self.steps = int(state["steps"])
        self._count.fill_(self.steps)
        self._rates = {name: float(rate) for name, rate in state["rates"].items()}
        self._taken = np.full(len(gaussians), self.steps, np.int64)
        size = 256
        while size <= self.steps:
            size *= 2
        self._history = np.zeros((2, size), np.float32)


def _of(gradients: Gradients, name: str, tensor: Tensor) -> Tensor:
    """float32 and contiguous; zero for what this render did not read."""
    found = gradients.extra.get(name) if name not in PARAMETERS else getattr(gradients, name)
    return torch.zeros_like(tensor) if found is None else found.detach().to(torch.float32).contiguous()
