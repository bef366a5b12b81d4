"""Devices: whether what lies on one is left to a GPU, and waiting for it; `backend.py` is what differs."""

from __future__ import annotations

import torch


def accelerated(device: torch.device | str) -> bool:
    """Whether what lies there is left to torch and gsplat; reading it back makes the host wait."""
    return torch.device(device).type != "cpu"


def wait(device: torch.device | str) -> None:
    """Until what was launched there is done; elsewhere than on a GPU it is already."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
