r"""A model's uncertainty, and the penalty on imagined trajectories for it.

The uncertainty of a state and an action is a number in normalised units: the standard deviations of
each entry's one-step changes in the data. MOPO (arXiv 2005.13239) subtracts a multiple of it from
the reward. MOReL (arXiv 2005.05951) sends steps above a threshold to an absorbing state, HALT,
whose reward is lower than any other.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_l1.algorithms.offline_config import OfflineConfig
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.dynamics.network import ForwardPass, PlanningNetwork

PENALTY_METRICS: dict[str, str] = {
    "penalty/uncertainty": "Mean uncertainty of the imagined steps in the last TRPO step, "
    "normalised units.",
    "penalty/data_uncertainty": "Mean uncertainty of the steps in the dataset, same units.",
    "penalty/threshold": "Uncertainty above which MOReL halts, same units; "
    "`halt_deviations` standard deviations above the mean of the data's.",
    "penalty/halted": "Share of the imagined trajectories in the last TRPO step that were halted; "
    "0 with other penalties.",
}
"""Metrics of the model's uncertainty in each outer iteration."""

_CHUNK = 5_000


def disagreement(means: Tensor) -> Tensor:
    """The largest distance between the predictions of two members.

    Args:
        means: normalised changes ``(E, B, n)``.

    Returns:
        Euclidean distances ``(B,)``; zero for a single member.

    Examples:
        >>> disagreement(torch.tensor([[[0.0, 0.0]], [[3.0, 4.0]], [[0.0, 1.0]]]))
        tensor([5.])
    """
    rows = means.transpose(0, 1)
    return torch.cdist(rows, rows, compute_mode="donot_use_mm_for_euclid_dist").amax((1, 2))


def largest_deviation(deviations: Tensor) -> Tensor:
    """The largest norm of the standard deviations that a member predicts.

    Args:
        deviations: standard deviations of normalised changes ``(E, B, n)``.

    Returns:
        the largest Frobenius norm of the roots of the members' diagonal covariances ``(B,)``.

    Examples:
        >>> largest_deviation(torch.tensor([[[3.0, 4.0]], [[1.0, 1.0]]]))
        tensor([5.])
    """
    return torch.linalg.vector_norm(deviations, dim=-1).amax(0)


class Uncertainty:
    """The uncertainty of a fitted ensemble's elites with their current weights.

    Args:
        dynamics: the model.
        measure: ``disagreement``, or ``deviation`` for Gaussian heads.
        precision: precision of the hidden layers, see
            :class:`~torchrl_l1.planning.PlanningNetwork`.
    """

    def __init__(
        self, dynamics: EnsembleDynamics, measure: str, precision: str = "float32"
    ) -> None:
        network = PlanningNetwork.from_dynamics(dynamics, precision)  # type: ignore[arg-type]
        self._network, self._measure = network, measure

    @torch.no_grad()
    def __call__(self, observation: Tensor, action: Tensor) -> Tensor:
        """Uncertainty ``(B,)`` at observations ``(B, n)`` and actions ``(B, m)``, raw units."""
        inputs = torch.cat([observation, action], -1)
        parts = [self._of(part) for part in inputs.split(_CHUNK)]
        return torch.cat(parts) if parts else inputs.new_zeros(0)

    def _of(self, inputs: Tensor) -> Tensor:
        network = self._network
        rows = [len(inputs)] * network.members
        raw = ForwardPass(network, rows, shared=True)(inputs)
        if self._measure == "disagreement":
            means = raw[:, : network.observation_dim]
            return disagreement(means.unflatten(0, (network.members, -1)).contiguous())
        assert network.standard_deviation is not None
        return largest_deviation(
            network.standard_deviation(raw).unflatten(0, (network.members, -1))
        )


class Pessimism:
    """The penalty on imagined trajectories for the model's uncertainty.

    Args:
        dynamics: the model.
        config: the penalty, its coefficient, and the measure of uncertainty.
        action_low: lower bounds ``(m,)``; the model sees clipped actions.
        action_high: upper bounds ``(m,)``.

    Attributes:
        data_uncertainty: mean uncertainty over the data.
        threshold: uncertainty above which MOReL halts.
        halted_reward: reward per step in MOReL's absorbing state.
    """

    def __init__(
        self,
        dynamics: EnsembleDynamics,
        config: OfflineConfig,
        action_low: Tensor,
        action_high: Tensor,
    ) -> None:
        self.dynamics, self.config = dynamics, config
        self.action_low, self.action_high = action_low, action_high
        self.data_uncertainty = self.threshold = self.halted_reward = 0.0
        self._measured = {"penalty/uncertainty": 0.0, "penalty/halted": 0.0}
        self._uncertainty: Uncertainty | None = None

    def calibrate(self, observation: Tensor, action: Tensor, reward: Tensor) -> None:
        """Measure uncertainty and rewards in the data.

        Args:
            observation: ``(N, n)``, on the model's device.
            action: ``(N, m)``.
            reward: ``(N,)``.
        """
        self._uncertainty = None
        known = self.uncertainty(observation, action).double()
        self.data_uncertainty = float(known.mean())
        spread = float(known.std(correction=0))
        self.threshold = self.data_uncertainty + self.config.halt_deviations * spread
        self.halted_reward = float(reward.min()) - self.config.penalty_coefficient

    def uncertainty(self, observation: Tensor, action: Tensor) -> Tensor:
        """Uncertainty ``(B,)`` at observations ``(B, n)`` and actions ``(B, m)``."""
        # The model is fitted once: its weights are copied once.
        if self._uncertainty is None:
            config = self.config
            self._uncertainty = Uncertainty(self.dynamics, config.measure, config.precision)
        return self._uncertainty(observation, action.clamp(self.action_low, self.action_high))

    def __call__(self, trajectories: TensorDict) -> TensorDict:
        """Apply the penalty to trajectories ``[B, T]`` of :func:`~torchrl_l1.dynamics.imagine`.

        Those that MOReL halts end there, and their last reward includes all that follows.
        """
        config, valid = self.config, trajectories["valid"].squeeze(-1)
        unknown = self.uncertainty(
            trajectories["observation"].flatten(0, 1), trajectories["action"].flatten(0, 1)
        ).unflatten(0, valid.shape)
        halted = torch.zeros_like(valid[:, 0])
        if config.penalty == "mopo":
            reward = trajectories["next", "reward"]
            trajectories["next", "reward"] = (
                reward - config.penalty_coefficient * unknown[..., None]
            )
        elif config.penalty == "morel":
            left = trajectories["next", "left_box"].squeeze(-1)
            trajectories = halt(
                trajectories,
                ~(unknown <= self.threshold) | left,
                self.halted_reward,
                config.discount,
                config.bootstrap,
            )
            halted = trajectories["next", "halted"].any(1).squeeze(-1)
        # NaN is also a step into the unknown, but has no mean.
        seen = unknown[trajectories["valid"].squeeze(-1)]
        self._measured = {
            "penalty/uncertainty": float(seen.double().mean()),
            "penalty/halted": float(halted.double().mean()),
        }
        return trajectories

    def metrics(self) -> dict[str, float]:
        """Values of ``PENALTY_METRICS``."""
        return {
            **self._measured,
            "penalty/data_uncertainty": self.data_uncertainty,
            "penalty/threshold": self.threshold,
        }

    def state_dict(self) -> dict[str, Any]:
        """The values measured in the data."""
        names = ("data_uncertainty", "threshold", "halted_reward")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`; the model's weights may have changed."""
        for name, value in state.items():
            setattr(self, name, value)
        self._uncertainty = None


def halt(
    trajectories: TensorDict,
    unknown: Tensor,
    halted_reward: float,
    discount: float,
    bootstrap: bool,
) -> TensorDict:
    r"""Send imagined trajectories to an absorbing state at their first unknown step.

    The step keeps its own reward :math:`r_t`; every later one has the reward :math:`\rho` of the
    absorbing state (arXiv 2005.05951, definition 3), up to the end of the imagined trajectory of
    :math:`T` steps, or forever if the baseline's estimate continues it:

    .. math::
        r_t + \gamma \rho \frac{1 - \gamma^{T - 1 - t}}{1 - \gamma} \quad\text{or}\quad
        r_t + \frac{\gamma \rho}{1 - \gamma}.

    All of it goes into the reward of the step, which ends the trajectory.

    Args:
        trajectories: batch size ``[B, T]``; changed in place.
        unknown: which steps are unknown ``(B, T)``, bool.
        halted_reward: :math:`\rho`.
        discount: :math:`\gamma`.
        bootstrap: whether the baseline's estimate continues trajectories after their last step.

    Returns:
        the trajectories, with ``("next", "halted")`` ``(B, T, 1)``.
    """
    steps = trajectories.shape[1]
    valid = trajectories["valid"].squeeze(-1)
    ends = (valid & unknown).long()
    before = ends.cumsum(1) - ends
    halts = ends.bool() & (before == 0)
    valid = valid & (before == 0)
    worth = torch.zeros(steps, dtype=torch.float64)
    if bootstrap:
        worth[:] = discount * halted_reward / (1 - discount)
    else:
        powers = discount ** torch.arange(1, steps, dtype=torch.float64)
        worth[:-1] = halted_reward * powers.cumsum(0).flip(0)
    after = trajectories["next"]
    reward = after["reward"] + (halts * worth.to(after["reward"]))[..., None]
    # A NaN after the end would spread to steps before it: zero times NaN is NaN.
    reward = torch.where(valid[..., None] | reward.isfinite(), reward, 0.0)
    return trajectories.update(
        {
            "valid": valid[..., None],
            "next": {
                "reward": reward,
                "halted": halts[..., None],
                "terminated": (after["terminated"] & valid[..., None]) | halts[..., None],
                "left_box": after["left_box"] & (valid & ~halts)[..., None],
                "done": (after["done"] & valid[..., None]) | halts[..., None],
            },
        }
    )
