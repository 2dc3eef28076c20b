"""Policy improvement of METRPO: TRPO on trajectories imagined in the ensemble."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.objectives.value.functional import generalized_advantage_estimate

from torchrl_l1.algorithms.metrpo_config import ImprovementConfig
from torchrl_l1.algorithms.outcomes import Outcomes
from torchrl_l1.algorithms.policy import GaussianPolicy, make_actor
from torchrl_l1.dynamics import EnsembleDynamics, imagine
from torchrl_l1.envs import AnyTask, StartStates, Task, action_bounds
from torchrl_l1.objectives import (
    LinearFeatureBaseline,
    TRPOConfig,
    TRPOReport,
    gaussian_trpo_step,
    trpo_step,
)
from torchrl_l1.objectives.trpo import fisher_stride

POLICY_METRICS: dict[str, str] = {
    "imagined/return_first": "Mean imagined return before the first TRPO step.",
    "imagined/return_last": "Mean imagined return before the last TRPO step.",
    "imagined/left_box": "Share of imagined trajectories that left the box around the data, in "
    "the last TRPO step. High values mean that the policy exploits the model.",
    "trpo/kl": "Mean KL divergence per TRPO step, nats.",
    "trpo/improvement": "Mean gain of the surrogate per TRPO step.",
    "trpo/accepted": "Share of TRPO steps whose line search succeeded.",
}
"""Metrics of the policy's improvement: all TRPO steps of an outer iteration."""


@dataclass
class PolicyStep:
    """One TRPO step: its report, and properties of the trajectories that it learned from."""

    report: TRPOReport
    imagined_return: float
    left_box: float


class SeenStarts:
    """Start states seen so far, for a task that tells none without stepping its environment.

    Attributes:
        observations: first observations of real episodes ``(K, n)``, float32, as L1 and policies
            saw them.

    Examples:
        >>> starts = SeenStarts()
        >>> done = torch.tensor([[[False], [True], [False]]])
        >>> observation = torch.arange(3.0).reshape(1, 3, 1)
        >>> starts.see(TensorDict({"observation": observation, "next": {"done": done}}, [1, 3]))
        >>> starts.observations.tolist()
        [[0.0], [2.0]]
    """

    def __init__(self) -> None:
        self.observations = torch.zeros(0, 0)

    def see(self, data: TensorDictBase) -> None:
        """Remember the start states of episodes ``[N, T]``."""
        done, observation = data["next", "done"].squeeze(-1), data["observation"].float()
        first = torch.ones_like(done)
        first[:, 1:] = done[:, :-1]
        fresh = observation[first]
        known = self.observations if len(self.observations) else fresh[:0]
        self.observations = torch.cat([known, fresh])

    def __call__(self, count: int) -> Tensor:
        """Some of them ``(count, n)``, drawn with torch's global generator."""
        if not count:
            return torch.zeros(0)
        return self.observations[torch.randint(len(self.observations), (count,))]


class PolicyImprovement:
    """TRPO steps of a policy in a learned model (arXiv 1802.10592).

    Args:
        task: start states and action bounds.
        dynamics: the model.
        policy: changed in place, on the model's device.
        config: settings.
        outcomes: rewards and terminations of imagined trajectories.
        penalize: changes the imagined trajectories before they are learned from.
    """

    def __init__(
        self,
        task: AnyTask,
        dynamics: EnsembleDynamics,
        policy: GaussianPolicy,
        config: ImprovementConfig,
        outcomes: Outcomes,
        penalize: Callable[[TensorDict], TensorDict] | None = None,
    ) -> None:
        self.penalize = penalize
        self.task, self.dynamics, self.policy, self.config = task, dynamics, policy, config
        self.outcomes = outcomes
        self.device = next(policy.parameters()).device
        self.baseline = LinearFeatureBaseline(task.observation_dim).to(self.device)
        self.start_states = StartStates(task) if isinstance(task, Task) else SeenStarts()
        self.action_low, self.action_high = action_bounds(task, self.device)

    def see(self, data: TensorDictBase) -> None:
        """Remember the start states of episodes ``[N, T]``, if the task does not tell them."""
        if isinstance(self.start_states, SeenStarts):
            self.start_states.see(data)

    def step(self, buffer: ReplayBuffer) -> PolicyStep:
        """One TRPO step on fresh imagined trajectories; the baseline is refitted after it."""
        config = self.config
        trajectories = imagine(
            self.dynamics,
            self.policy.sampler(),
            self.outcomes.reward,
            self.starts(config.imagined_steps // config.imagined_horizon, buffer),
            config.imagined_horizon,
            self.action_low,
            self.action_high,
            self.outcomes.termination(config.imagined_termination),
            precision=config.precision,  # type: ignore[arg-type]
        )
        if self.penalize is not None:
            trajectories = self.penalize(trajectories)
        observation, step = trajectories["observation"], trajectories["step"]
        if config.bootstrap:
            step = torch.zeros_like(step)
        with torch.no_grad():
            value = self.baseline(observation, step)
            last_value = torch.zeros_like(value[:, :1])
            if config.bootstrap:
                last = trajectories["next", "observation"][:, -1:]
                last_value = self.baseline(last, step[:, -1:])
        advantage, target = imagined_advantages(
            trajectories, value, last_value, config.discount, config.gae_lambda, config.box_exit
        )
        valid = trajectories["valid"].squeeze(-1)
        seen = observation[valid]
        report = self._improve(seen, trajectories["action"][valid], _standardize(advantage[valid]))
        self.baseline.fit(seen, step[valid], target[valid])
        rewards = trajectories["next", "reward"] * trajectories["valid"]
        return PolicyStep(
            report,
            imagined_return=rewards.sum(1).mean().item(),
            left_box=trajectories["next", "left_box"].any(1).float().mean().item(),
        )

    def _improve(self, observation: Tensor, action: Tensor, advantage: Tensor) -> TRPOReport:
        policy = self.policy
        config = spread_fisher(self.config.trpo, self.config.imagined_horizon)
        if policy.is_plain and all(part.requires_grad for part in policy.parameters()):
            inputs = policy.normalizer.normalize(observation)
            return gaussian_trpo_step(
                policy.mean, policy.log_std, inputs, action, advantage, config
            )
        columns = {"observation": observation, "action": action, "advantage": advantage}
        samples = TensorDict(columns, batch_size=observation.shape[:1])
        return trpo_step(make_actor(policy), samples, config)

    def starts(self, count: int, buffer: ReplayBuffer) -> Tensor:
        """First observations of imagined trajectories ``(count, n)``."""
        from_data = round(self.config.imagined_from_data * count)
        starts = [self.start_states(count - from_data)]
        if from_data:
            index = torch.randint(len(buffer), (from_data,))
            starts.append(buffer[index]["observation"])
        return torch.cat(starts).to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """The state that a step leaves besides the policy."""
        state = self.baseline.state_dict()
        if isinstance(self.start_states, SeenStarts):
            return {"baseline": state, "starts": self.start_states.observations}
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        if isinstance(self.start_states, SeenStarts):
            self.start_states.observations, state = state["starts"], state["baseline"]
        self.baseline.load_state_dict(state)


def policy_metrics(steps: list[PolicyStep]) -> dict[str, float]:
    """Metrics of the policy's improvement: all TRPO steps of an outer iteration.

    They are NaN if no step could be taken.
    """
    if not steps:
        return dict.fromkeys(POLICY_METRICS, math.nan)
    reports = [step.report for step in steps]
    return {
        "imagined/return_first": steps[0].imagined_return,
        "imagined/return_last": steps[-1].imagined_return,
        "imagined/left_box": steps[-1].left_box,
        "trpo/kl": fmean(report.kl for report in reports),
        "trpo/improvement": fmean(report.improvement for report in reports),
        "trpo/accepted": fmean(report.accepted for report in reports),
    }


# Minimum number of different steps of each trajectory in the estimate of the Fisher matrix.
_LEAST_STEPS = 5


def spread_fisher(config: TRPOConfig, horizon: int) -> TRPOConfig:
    """Settings such that the Fisher matrix is estimated on all steps of short trajectories.

    Samples are ordered by trajectory. With trajectories of ten steps, every tenth sample is a first
    step, whose states are alike: the step length would be that of another policy.

    Args:
        config: settings.
        horizon: steps of a trajectory.

    Examples:
        >>> [1 / spread_fisher(TRPOConfig(fisher_fraction=0.1), steps).fisher_fraction
        ...  for steps in (1, 10, 20, 50)]
        [10.0, 11.0, 11.0, 10.0]
    """
    stride = fisher_stride(config)
    if horizon >= _LEAST_STEPS * stride:
        return config
    while math.gcd(stride, horizon) > 1:
        stride += 1
    return replace(config, fisher_fraction=1 / stride)


def imagined_advantages(
    trajectories: TensorDictBase,
    value: Tensor,
    last_value: Tensor,
    discount: float,
    gae_lambda: float,
    box_exit: str,
) -> tuple[Tensor, Tensor]:
    """Generalized advantage estimate (arXiv 1506.02438) of trajectories that may end early.

    The value after an exit from the data's box is unknown. Taking it as zero (``box_exit="fail"``)
    rewards leaving wherever rewards are negative; ``"truncate"`` uses the value of the last state
    inside instead. After the task itself ends, the value is zero.

    Args:
        trajectories: from :func:`~torchrl_l1.dynamics.imagine`, batch size ``[B, T]``.
        value: the baseline's value of each ``observation`` ``(B, T, 1)``.
        last_value: value after the last step ``(B, 1, 1)``: zero if the task ends there.
        discount: gamma.
        gae_lambda: lambda.
        box_exit: ``"truncate"`` or ``"fail"``.

    Returns:
        advantages and value targets ``(B, T, 1)``, meaningless where ``valid`` is false.
    """
    done = trajectories["next", "done"]
    terminated = trajectories["next", "terminated"]
    if box_exit == "fail":
        terminated = terminated | trajectories["next", "left_box"]
    # After an exit the observation remains that of the last state inside, and so does its value.
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


def _standardize(advantage: Tensor) -> Tensor:
    # A single sample has no standard deviation and gives no direction.
    spread = advantage.std() if advantage.numel() > 1 else 0.0
    return (advantage - advantage.mean()) / (spread + 1e-8)
