"""Adam over the Gaussians that costs only what a view sees, with the same bits as Adam over all of them.

Means, quats, scales and opacity are read by culling, and sh0 by every view: these 14 floats of a Gaussian are
stepped at once, seen or not. The higher harmonics, 45 floats, are read only when a Gaussian is drawn. Steps
of a row that no view sees are pending; it takes them, with gradient zero, when the renderer is about to draw
it (`Gaussians.pending_steps`), or at `flush`. On an accelerator torch's fused kernel steps every row, one
launch a tensor; there a flag on the device can skip the step without the host's knowledge.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import State
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians, PendingSteps
from ambiguous_wild.splat.rendered import Gradients

_LAZY = "sh_rest"


class SplatAdam:
    """Adam (Kingma and Ba) with one step count for all rows; new rows start with zero moments.

    It holds the tensors of one `Gaussians` and changes them in place. Code that replaces the Gaussians first
    changes the rows here (`select`, `append`) and then passes the new object (`bind`). Read `sh_rest` outside
    of the CPU renderer only after `flush`.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        # rates by name in Gaussians.named_tensors(); an attribute without a rate is not learnt
        learning_rates: Mapping[str, float],
        *,
        lazy: bool = True,  # False steps every row of sh_rest at once: the same bits, more memory traffic
    ) -> None:
        self._backend = backend_of(gaussians.device)
        self.steps: int | Tensor = self._counted(0, gaussians)
        self._rates: dict[str, float] = {}
        self._moments = {
            name: (torch.zeros_like(tensor), torch.zeros_like(tensor))
            for name, tensor in gaussians.named_tensors()
            if name in PARAMETERS or name in learning_rates
        }
        self._lazy = lazy and self._backend.kernels
        self._taken = np.zeros(len(gaussians), np.int64)  # steps each row of sh_rest has taken
        self._history = np.zeros((2, 256), np.float32)  # a step's lr / bias1 of sh_rest, and 1 / sqrt(bias2)
        self._rows = len(gaussians)
        self._bound: Gaussians | None = None
        self._pending_steps: PendingSteps | None = None  # of the Gaussians bound now
        self.bind(gaussians)
        self._set_rates(learning_rates)

    # -- rows -------------------------------------------------------------------------------------

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians that are optimised.

        Raises:
            RuntimeError: rows were selected or appended and no new Gaussians were bound since.
        """
        if self._bound is None:
            raise RuntimeError("rows changed: call bind(gaussians) with the new Gaussians first")
        return self._bound

    def bind(self, gaussians: Gaussians) -> None:
        """Optimise these Gaussians from now on; their rows match the moments after `select` and `append`.

        Raises:
            RuntimeError: the numbers of rows and of moments differ.
        """
        if len(gaussians) != self._rows:
            raise RuntimeError(f"{len(gaussians)} Gaussians but moments for {self._rows} rows")
        if gaussians is self._bound:
            return
        self._unbind()
        self._bound = gaussians
        if self._lazy:
            self._pending_steps = gaussians.pending_steps = PendingSteps(self.catch_up)

    def select(self, rows: Tensor) -> None:
        """Keep the moments of these rows (bool mask [N] or indices), in that order; `bind` comes next."""
        self._unbind()
        self._change_moments(lambda moment: moment[rows].contiguous())
        self._rows = len(self._moments["means"][0])
        self._mark_up_to_date()

    def append(self, n: int) -> None:
        """Append n rows of zero moments; `bind` comes next."""
        self._unbind()

        def longer(moment: Tensor) -> Tensor:
            return torch.cat([moment, moment.new_zeros(n, *moment.shape[1:])])

        self._change_moments(longer)
        self._rows += n
        self._mark_up_to_date()

    def _change_moments(self, change: Callable[[Tensor], Tensor]) -> None:
        """Replace the moments one by one, so that never all are there twice."""
        for name in list(self._moments):
            first, second = self._moments.pop(name)
            first = change(first)
            self._moments[name] = first, change(second)

    @property
    def rates(self) -> Mapping[str, float]:
        """Learning rates of the last step; before the first step, the initial ones."""
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
        if self._pending_steps is not None:
            self._pending_steps.end()
        self._bound = self._pending_steps = None

    # -- steps ------------------------------------------------------------------------------------

    def step(
        self,
        grads: Gradients,
        visible: Tensor,  # [N] bool; rows of sh_rest outside have gradient zero
        learning_rates: Mapping[str, float] | None = None,  # from this step on; None keeps the last
        *,
        skip_step: Tensor | None = None,  # on an accelerator, [1] float32 there: 1 = change nothing
    ) -> None:
        """Step every row once.

        Raises:
            AwError: a learning rate is missing or has an unknown name.
        """
        if learning_rates is not None:
            self._set_rates(learning_rates)
        gaussians = self.gaussians
        self.steps += 1
        for name, tensor in self._learnt(gaussians):
            gradient = _gradient_of(grads, name, tensor)
            if name == _LAZY and self._lazy:
                self._step_visible(tensor, gradient, visible)
            elif tensor.numel():
                self._backend.adam_step(
                    tensor, gradient, self._moments[name], self._rates[name], self.steps, skip_step
                )
        if skip_step is not None:
            self.steps -= skip_step.reshape(())

    def _step_visible(self, parameter: Tensor, gradient: Tensor, visible: Tensor) -> None:
        """Step the visible rows of sh_rest; steps of the others are pending."""
        from ambiguous_wild.splat.cpu import adam
        from ambiguous_wild.splat.cpu.compile import threads

        steps = int(self.steps)
        if steps > self._history.shape[1]:
            self._history = np.concatenate([self._history, np.zeros_like(self._history)], axis=1)
        self._history[:, steps - 1] = adam.step_size(self._rates[_LAZY], steps)
        if parameter.shape[1]:
            adam.sparse(
                visible.numpy(), 3 * parameter.shape[1], *adam.flat(parameter, self._moments[_LAZY]),
                gradient.numpy().reshape(-1), self._taken, steps - 1, *self._history, 8 * threads(),
            )  # fmt: skip

    def catch_up(self, rows: np.ndarray | None = None) -> None:
        """Take the steps of these rows of sh_rest (indices; None = all) that are pending."""
        if not self._lazy or self.steps == 0 or self.gaussians.sh_rest.shape[1] == 0:
            return
        from ambiguous_wild.splat.cpu import adam
        from ambiguous_wild.splat.cpu.compile import threads

        p = self.gaussians.sh_rest
        rows = np.arange(len(p), dtype=np.int32) if rows is None else np.ascontiguousarray(rows)
        adam.catch_up(
            rows, 3 * p.shape[1], *adam.flat(p, self._moments[_LAZY]), self._taken, self.steps,
            *self._history, 8 * threads(),
        )  # fmt: skip

    def flush(self) -> None:
        """Bring every row up to date."""
        self.catch_up(None)

    def _counted(self, steps: int, gaussians: Gaussians) -> int | Tensor:
        """Return a number of steps as this back end counts it: an int, or a tensor on a GPU."""
        if self._backend.reads_at_once:
            return steps
        return torch.full((), float(steps), device=gaussians.device)

    def _mark_up_to_date(self) -> None:
        """Note that no row of sh_rest has steps that are pending."""
        self._taken = np.full(self._rows, self.steps if self._lazy else 0, np.int64)

    def _learnt(self, gaussians: Gaussians) -> Iterator[tuple[str, Tensor]]:
        return ((name, tensor) for name, tensor in gaussians.named_tensors() if name in self._moments)

    def _set_rates(self, rates: Mapping[str, float]) -> None:
        for name in rates:
            if name not in self._moments:
                raise unknown("learning rate", name, self._moments)
        missing = [name for name in self._moments if name not in rates]
        if missing:
            raise AwError(f"learning rates lack {', '.join(missing)}; give one for every tensor")
        self._rates = {name: float(rates[name]) for name in self._moments}

    # -- state ------------------------------------------------------------------------------------

    def state_dict(self) -> State:
        """Return steps, rates and moments, with every row up to date; parameters are not part of it."""
        self.flush()
        return {
            "steps": int(self.steps),
            "rates": dict(self._rates),
            "first": {name: m for name, (m, _) in self._moments.items()},
            "second": {name: v for name, (_, v) in self._moments.items()},
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned, for the Gaussians bound now.

        Raises:
            AwError: moments and Gaussians differ in shape.
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
        steps = int(state["steps"])
        self.steps = self._counted(steps, gaussians)
        self._rates = {name: float(rate) for name, rate in state["rates"].items()}
        self._mark_up_to_date()
        size = 256
        while size <= steps:
            size *= 2
        self._history = np.zeros((2, size), np.float32)


def _gradient_of(gradients: Gradients, name: str, tensor: Tensor) -> Tensor:
    """Return the gradient of a tensor, float32 and contiguous; zeros for an attribute that was not read."""
    gradient = gradients.attributes.get(name) if name not in PARAMETERS else getattr(gradients, name)
    return torch.zeros_like(tensor) if gradient is None else gradient.detach().to(torch.float32).contiguous()
