"""How particles travel through an ensemble: which member predicts, and for which rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from torchrl_l1.planning.network import ForwardPass, PlanningNetwork
from torchrl_l1.planning.particle_draws import Draws

Propagation = Literal["ts1", "tsinf", "mean"]

Predict = Callable[[Tensor, int], Tensor]
"""Normalised change ``(B, n)`` from raw inputs ``(B, n + m)`` at a step."""


def member_shares(network: PlanningNetwork, particles: int, propagation: Propagation) -> list[int]:
    """Particles of each member; of no member in particular unless it is kept."""
    if propagation == "tsinf":
        return [len(range(member, particles, network.members)) for member in range(network.members)]
    return [1 if propagation == "mean" else particles]


def predictor(
    network: PlanningNetwork,
    propagation: Propagation,
    shares: list[int],
    count: int,
    draws: Draws,
) -> Predict:
    """The prediction for B = ``count`` trajectories, sorted as their draws are."""
    k = network.members
    if propagation == "mean":
        everyone = ForwardPass(network, [count] * k, shared=True)

        def mean(inputs: Tensor, step: int) -> Tensor:
            changes = everyone(inputs)[:, : network.observation_dim]
            return changes.unflatten(0, (k, count)).mean(0)

        return mean
    if propagation == "tsinf":
        candidates = count // sum(shares)
        keeping = ForwardPass(network, [candidates * share for share in shares])
        return lambda inputs, step: network.sample(keeping(inputs), draws.noise(step))
    drawn = draws.members()
    order = drawn.argsort(1)
    sizes = torch.stack([(drawn == member).sum(1) for member in range(k)], 1).tolist()
    memory: dict[tuple[torch.dtype, int], Tensor] = {}

    def switching(inputs: Tensor, step: int) -> Tensor:
        # Rows of the same member next to each other, for as long as the products take.
        raw = ForwardPass(network, sizes[step], memory=memory)(inputs[order[step]])
        result = torch.empty_like(inputs[:, : network.observation_dim])
        result[order[step]] = network.sample(raw, draws.noise(step, order[step]))
        return result

    return switching
