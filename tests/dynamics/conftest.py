from __future__ import annotations

import torch
from tensordict import TensorDict


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
