"""The returns of trajectories that are imagined together."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_l1.planning.network import PlanningNetwork
from torchrl_l1.planning.particle_motion import Predict

RewardFunction = Callable[[Tensor, Tensor, Tensor], Tensor]
Termination = Callable[[Tensor], Tensor]


def imagined_returns(
    network: PlanningNetwork,
    predict: Predict,
    x: Tensor,
    u: Tensor,
    reward: RewardFunction,
    terminated: Termination | None,
    discount: float,
) -> Tensor:
    """Returns ``(B,)`` of trajectories from ``(B, n)`` under actions ``(H, B, m)``.

    See :func:`torchrl_l1.planning.evaluate`, also for the errors.
    """
    horizon, n = u.shape[0], x.shape[1]
    # Column by column in memory: all that is done to a state is then done to whole columns.
    inputs = x.new_empty(horizon + 1, n + u.shape[2], x.shape[0]).transpose(1, 2)
    states = inputs[..., :n]
    states[0] = x
    inputs[:-1, :, n:] = u
    for t in range(horizon):
        change = predict(inputs[t], t)
        torch.addcmul(states[t], change, network.change_std, out=states[t + 1])
        states[t + 1] += network.change_mean
    rewards = _along(reward(states[:-1], u, states[1:]), u, "reward")
    if terminated is None:
        # A state that is not finite stays so: the last tells for all.
        sound = torch.isfinite(states[-1]).all(-1)
    else:
        ended = _along(terminated(states[1:]), u, "terminated").long()
        over = (ended.cumsum(0) - ended) > 0
        rewards = torch.where(over, 0.0, rewards)
        sound = (torch.isfinite(states[1:]).all(-1) | over).all(0)
    if discount != 1:
        rewards = rewards * rewards.new_tensor([[discount**t] for t in range(horizon)])
    returns = rewards.sum(0)
    return torch.where(sound & torch.isfinite(returns), returns, -torch.inf)


def _along(values: Tensor, u: Tensor, name: str) -> Tensor:
    if values.shape != u.shape[:2]:
        raise ValueError(
            f"the {name} function must return shape (...) for inputs of shape (..., width), got "
            f"{tuple(values.shape)} for inputs of shape {tuple(u.shape[:2])} + (width,)"
        )
    return values
