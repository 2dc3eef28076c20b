"""Advantages of imagined trajectories."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives.value.functional import generalized_advantage_estimate


def imagined_advantages(
    trajectories: TensorDictBase,
    value: Tensor,
    last_value: Tensor,
    discount: float,
    gae_lambda: float,
    box_exit: str,
) -> tuple[Tensor, Tensor]:
    """Generalized advantage estimate (arXiv 1506.02438) of trajectories that may end early.

    What follows an exit from the data's box is unknown. To call it zero (``box_exit="fail"``)
    rewards leaving wherever rewards are negative; ``"truncate"`` lets the value of the last state
    inside stand for it. Nothing follows where the task itself ends.

    Args:
        trajectories: from :func:`~torchrl_l1.dynamics.imagine`, batch size ``[B, T]``.
        value: the baseline's value of each ``observation`` ``(B, T, 1)``.
        last_value: what follows the last step ``(B, 1, 1)``: zero if the task ends there.
        discount: gamma.
        gae_lambda: lambda.
        box_exit: ``"truncate"`` or ``"fail"``.

    Returns:
        advantages and value targets ``(B, T, 1)``; they mean nothing where ``valid`` is false.
    """
    done = trajectories["next", "done"]
    terminated = trajectories["next", "terminated"]
    if box_exit == "fail":
        terminated = terminated | trajectories["next", "left_box"]
    # After an exit the observation stays that of the last state inside, and so does its value.
    next_value = torch.cat([value[:, 1:], last_value], dim=1)
    advantage, target = generalized_advantage_estimate(
        discount,
        gae_lambda,
        value,
        next_value,
        trajectories["next", "reward"],
        done=done,
        terminated=terminated,
    )
    return advantage, target
