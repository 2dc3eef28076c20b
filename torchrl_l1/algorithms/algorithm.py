"""What every algorithm is to those who run, save and evaluate it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict.nn import TensorDictModuleBase

from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import Task

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


@dataclass
class IterationResult:
    """What an outer iteration reports: metrics, and wall-clock seconds by phase."""

    metrics: dict[str, float]
    seconds: dict[str, float]


class Algorithm(Protocol):
    """A model-based algorithm and its state.

    Attributes:
        iteration: outer iterations that are complete.
        task: what it learns.
        acting_dynamics: the model that L1 uses in real environments, on the CPU.
        on_phase: called with a word on what is going on, for progress bars.
    """

    iteration: int
    task: Task
    acting_dynamics: EnsembleDynamics
    on_phase: Callable[[str], None]

    @property
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """What acts in real environments, by the names of the stages that they come from.

        In the order in which they come about, and only what has been learned so far; the last one
        is the algorithm's result.
        """
        ...

    def iterate(self) -> Iterator[IterationResult]:
        """Run the outer iterations that are left, reporting after each."""
        ...

    def choices(self) -> Mapping[str, str]:
        """What settings that say ``auto`` have become on this machine."""
        ...

    def weights(self) -> Mapping[str, dict[str, Any]]:
        """State dicts of what has been learned, by the names under which users look for them."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        ...
