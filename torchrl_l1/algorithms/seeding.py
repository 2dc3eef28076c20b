"""Random streams that are derived from a seed and a name, so that none depends on another."""

from __future__ import annotations

import hashlib

import torch


def stream_seed(seed: int, *names: str | int) -> int:
    """A 63-bit seed for the stream of that name.

    Examples:
        >>> stream_seed(0, "iteration", 3) == stream_seed(0, "iteration", 3)
        True
        >>> stream_seed(0, "iteration", 3) == stream_seed(0, "iteration", 4)
        False
    """
    digest = hashlib.sha256(repr((seed, *names)).encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def seed_streams(seed: int, *names: str | int) -> None:
    """Start torch's global generator on the stream of that name."""
    torch.manual_seed(stream_seed(seed, *names))
