"""Choosing the device on which models are fitted and trajectories imagined."""

from __future__ import annotations

import torch

DEVICES = ("cpu", "cuda", "auto")
"""Where models may be fitted and trajectories imagined."""


def resolve_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is one; a device that is not there is a ``ValueError``."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name not in DEVICES:
        raise ValueError(f"device must be {' or '.join(DEVICES)}, got {name!r}")
    device = torch.device(name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda was asked for, but torch finds no CUDA device; use cpu")
    return device
