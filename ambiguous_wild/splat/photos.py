"""Train photos: all on the device, or in the host's memory and copied to the device ahead of time.

Photos that fit into `RESIDENT` of a GPU's free memory stay there for the whole run. Others stay in pinned
memory of the host, as 8-bit codes if their files have 8 bits: a quarter of the bytes. The loop announces the
next view (`prefetch`), its photo is copied while the GPU computes, and the GPU, not the host, waits for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, overload

import torch
from torch import Tensor

RESIDENT = 0.25  # of a GPU's free memory; Gaussians, their moments and gsplat's lists need the rest
READY = 3  # photos on the device at a time: of this step, of the next, and one more for comparisons


class Copies(Protocol):
    """Sends tensors to a device without making the host wait."""

    def hold(self, tensor: Tensor) -> Tensor:
        """The tensor in memory that it can be sent from."""

    def begin(self, tensor: Tensor) -> Any:
        """Start to send it; returns what `finish` needs."""

    def finish(self, sent: Any) -> Tensor:
        """The tensor on the device, for what is launched from now on."""


class CudaCopies:
    """Copies on a stream of their own."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.stream = device, torch.cuda.Stream(device)

    def hold(self, tensor: Tensor) -> Tensor:
        try:
            return tensor.pin_memory()
        except RuntimeError:  # the system pins no more: the host waits for such a copy
            return tensor

    def begin(self, tensor: Tensor) -> tuple[Tensor, Any]:
        with torch.cuda.stream(self.stream):
            there = tensor.to(self.device, non_blocking=True)
        return there, self.stream.record_event()

    def finish(self, sent: tuple[Tensor, Any]) -> Tensor:
        there, arrived = sent
        current = torch.cuda.current_stream(self.device)
        current.wait_event(arrived)
        there.record_stream(current)  # its memory is not given away before `current` has read it
        return there


class Photos(Sequence[Tensor]):
    """Photos [H, W, 3] float32 in [0, 1] on the device, of which a few lie there at a time."""

    def __init__(self, held: Sequence[Tensor], device: torch.device, copies: Copies) -> None:
        """
        Args:
            held: [H, W, 3] each, in the host's memory: uint8 codes, or float32.
            device: where they are read.
            copies: sends them there.
        """
        self._held, self._device, self._copies = held, device, copies
        # On the device: by a number of the host, torch's division there multiplies by its reciprocal.
        self._most = torch.tensor(255.0, device=device)
        self._coming: dict[int, Any] = {}
        self._ready: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._held)

    @overload
    def __getitem__(self, index: int) -> Tensor: ...
    @overload
    def __getitem__(self, index: slice) -> Photos: ...
    def __getitem__(self, index: int | slice) -> Tensor | Photos:
        if isinstance(index, slice):
            return Photos(self._held[index], self._device, self._copies)
        index = range(len(self._held))[index]
        photo = self._ready.pop(index, None)
        if photo is None:
            self.prefetch(index)
            photo = self._copies.finish(self._coming.pop(index))
            photo = photo if photo.dtype == torch.float32 else photo.float() / self._most
        self._ready[index] = photo  # last: read most recently
        while len(self._ready) > READY:
            del self._ready[next(iter(self._ready))]
        return photo

    def prefetch(self, index: int) -> None:
        """Start to send this photo, unless it is there or on its way."""
        if index not in self._ready and index not in self._coming:
            while len(self._coming) >= READY:  # announced and never read
                del self._coming[next(iter(self._coming))]
            self._coming[index] = self._copies.begin(self._held[index])


def fit(needed: int, device: torch.device) -> bool:
    """Whether so many bytes of photos may lie on the device for the whole run."""
    return device.type != "cuda" or needed <= RESIDENT * torch.cuda.mem_get_info(device)[0]


def on_device(photos: Sequence[Tensor], device: torch.device) -> Sequence[Tensor]:
    """Photos [H, W, 3] float32 of the host where the training reads them, all there or a few at a time."""
    if fit(sum(4 * photo.numel() for photo in photos), device):
        return [photo.to(device) for photo in photos]
    copies = CudaCopies(device)
    return Photos([copies.hold(photo) for photo in photos], device, copies)
