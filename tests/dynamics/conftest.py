from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict

KEYS = {"observation": ["angle", "rate"], "action": ["torque"]}


def transitions(count: int, noise: float = 0.0) -> TensorDict:
    """A known plant: x' = x + A x + B u, with constants in raw units of different scale."""
    x = torch.randn(count, 2) * torch.tensor([1.0, 100.0])
    u = torch.randn(count, 1)
    change = x @ torch.tensor([[-0.1, 3.0], [0.001, -0.05]]) + u @ torch.tensor([[0.5, 20.0]])
    change = change + noise * torch.randn_like(change)
    held_out = torch.arange(count) % 5 == 0
    return TensorDict(
        {
            "observation": x,
            "action": u,
            "executed": 2 * u,
            "next": {"observation": x + change},
            "validation": held_out,
        },
        batch_size=[count],
    )


def write(file: Path, *lines: str) -> Path:
    """A file of lines."""
    file.write_text("\n".join(lines), encoding="utf-8")
    return file
