"""Imagined rollouts: a policy in a learned model, as a plain torch loop."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_l1.dynamics.model import EnsembleDynamics


@torch.no_grad()
def imagine(
    dynamics: EnsembleDynamics,
    policy: Callable[[Tensor], Tensor],
    reward: Callable[[Tensor, Tensor, Tensor], Tensor],
    start: Tensor,
    horizon: int,
    action_low: Tensor,
    action_high: Tensor,
    terminated: Callable[[Tensor], Tensor] | None = None,
) -> TensorDict:
    """Roll a policy out in the ensemble, one random member per step for the whole batch.

    A trajectory that leaves the box around the data ends there: the model knows nothing
    outside, and rewards imagined there grow without bound. Model and reward see the clipped
    action; what is stored is the policy's sample, whose likelihood the policy gradient needs.

    Args:
        dynamics: the model; one of its elites is drawn at each step (arXiv 1802.10592), and its
            mean taken.
        policy: maps observations ``(B, n)`` to sampled actions ``(B, m)``.
        reward: maps observation, clipped action and next observation to ``(B,)``.
        start: first observations ``(B, n)``.
        horizon: number of steps, T.
        action_low: lower bounds ``(m,)``.
        action_high: upper bounds ``(m,)``.
        terminated: whether the task ends in a next observation, ``(B, n)`` to ``(B,)``; by
            default it never does.

    Returns:
        trajectories of batch size ``[B, T]`` with ``observation``, ``action``, ``step``
        ``(B, T, 1)``, ``valid`` ``(B, T, 1)`` (not ended before the step) and ``next``:
        ``observation``, ``reward``, ``done``, ``left_box`` and ``terminated``. What follows a
        step that is ``done`` is not valid and means nothing.
    """
    batch, device = start.shape[0], start.device
    elites = dynamics.elites.tolist()
    members = [elites[i] for i in torch.randint(len(elites), (horizon,)).tolist()]
    observations = start.new_empty(horizon + 1, batch, start.shape[-1])
    actions = start.new_empty(horizon, batch, action_low.shape[-1])
    rewards = start.new_empty(horizon, batch)
    inside = torch.empty(horizon, batch, dtype=torch.bool, device=device)
    fallen = torch.zeros_like(inside)
    observations[0] = observation = start
    for t, member in enumerate(members):
        actions[t] = action = policy(observation)
        clipped = action.clamp(action_low, action_high)
        successor = observation + dynamics.member_change(observation, clipped, member)
        inside[t] = within = dynamics.box.contains(successor)
        # A trajectory that left stays where it last was inside, so that nothing overflows, and is
        # rewarded for that: outside, neither state nor reward mean anything.
        successor = torch.where(within[:, None], successor, observation)
        rewards[t] = reward(observation, clipped, successor)
        if terminated is not None:
            fallen[t] = terminated(successor)
        observation = successor
        observations[t + 1] = observation
    ended = (~inside | fallen).long()
    valid = (ended.cumsum(0) - ended) == 0
    done = valid & ended.bool()
    left, fell = done & ~inside, done & inside
    done[-1] = True
    columns = {
        "observation": observations[:-1],
        "action": actions,
        "step": torch.arange(horizon, device=device)[:, None, None].expand(-1, batch, 1),
        "valid": valid[..., None],
        "next": {
            "observation": observations[1:],
            "reward": rewards[..., None],
            "done": done[..., None],
            "left_box": left[..., None],
            "terminated": fell[..., None],
        },
    }
    return TensorDict(columns, batch_size=[horizon, batch]).transpose(0, 1)
