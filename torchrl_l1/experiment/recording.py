"""Data of three qualities from a trained policy, for offline learning."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_l1.algorithms.collection import Collection, episode_returns
from torchrl_l1.envs import AnyTask, Perturbation, action_bounds
from torchrl_l1.experiment.episodes import Episode, split_episodes
from torchrl_l1.experiment.evaluate import TrainedRun

QUALITIES = ("random", "medium", "expert")
"""``random`` actions; the final policy with noise that makes its return ``medium``; or itself."""

MEDIUM = (1 / 3, 1 / 2)
"""Return of ``medium`` data, as a share of the way from ``random`` to ``expert``."""

_MEASURED, _TRIALS, _MOST_NOISE = 16, 12, 4.0


@dataclass(frozen=True)
class Recording:
    """Recorded data, and the quality of the policy that made them.

    Attributes:
        episodes: the data.
        quality: one of ``QUALITIES``.
        noise: standard deviation of the noise added to the policy's action, as a fraction of half
            the action range.
        returns: mean returns of full episodes with random actions, at this quality, and of the
            policy.
    """

    episodes: list[Episode]
    quality: str
    noise: float
    returns: tuple[float, float, float]

    @property
    def transitions(self) -> int:
        """Number of steps of all episodes."""
        return sum(map(len, self.episodes))

    @property
    def share(self) -> float:
        """Its return on a scale from random actions, 0, to the policy, 1."""
        low, own, high = self.returns
        return (own - low) / (high - low) if high != low else math.nan


class NoisyPolicy(TensorDictModuleBase):
    """A policy with Gaussian noise on its action, clipped to the bounds.

    Args:
        policy: writes ``action``.
        task: for the bounds.
        noise: standard deviation as a fraction of half the action range.
    """

    def __init__(self, policy: TensorDictModuleBase, task: AnyTask, noise: float) -> None:
        super().__init__()
        self.policy = policy
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.bounds = low, high = action_bounds(task)
        self.deviation = noise * (high - low) / 2
        primer = getattr(policy, "make_tensordict_primer", None)
        if primer is not None:
            self.make_tensordict_primer = primer

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the policy's action with noise added."""
        tensordict = self.policy(tensordict)
        action = tensordict.get("action")
        noisy = action + self.deviation * torch.randn_like(action)
        return tensordict.set("action", noisy.clamp(*self.bounds))


def record(
    trained: TrainedRun,
    quality: str = "expert",
    steps: int = 20_000,
    seed: int = 0,
    say: Callable[[str], object] = lambda line: None,
) -> Recording:
    """Record undisturbed real episodes of a run's last policy, without L1, at a chosen quality.

    The policy's actions are sampled, as in training. For ``medium``, the added noise is found by
    bisection.

    Args:
        trained: the run.
        quality: one of ``QUALITIES``.
        steps: minimum number of steps: whole episodes, or as many steps as in one if they end
            early.
        seed: seed of everything random.
        say: receives lines on the progress.

    Raises:
        ValueError: for an unknown quality, or if no noise gives a medium return.
    """
    if quality not in QUALITIES:
        raise ValueError(f"quality must be one of {', '.join(QUALITIES)}, got {quality!r}")
    if steps < 1:
        raise ValueError(f"steps must be positive, got {steps}")
    task = trained.algorithm.task
    policy = trained.algorithm.policies[trained.stage(None)]
    horizon = trained.algorithm.horizon

    def collection(noise: float, rows: int) -> Collection:
        return Collection(
            task,
            rows,
            NoisyPolicy(policy, task, noise) if noise else policy,
            trained.algorithm.acting_dynamics,
            None,
            Perturbation(),
            horizon,
        )

    def measured(noise: float) -> float:
        data = collection(noise, _MEASURED).evaluate(seed, deterministic=False)
        return float(episode_returns(data).mean())

    low = float(episode_returns(collection(0.0, _MEASURED).random(seed)).mean())
    high = measured(0.0)
    say(f"mean returns: random actions {low:.4g}, the policy {high:.4g}")
    noise = _medium_noise(measured, low, high, say) if quality == "medium" else 0.0
    rows = -(-steps // horizon)
    source = collection(noise, rows)
    data = source.random(seed) if quality == "random" else source.collect(seed, 0)
    own = float(episode_returns(data).mean())
    return Recording(split_episodes(data), quality, noise, (low, own, high))


def _medium_noise(
    measured: Callable[[float], float], low: float, high: float, say: Callable[[str], object]
) -> float:
    """The noise for which the return is a third to a half of the way up."""
    if not high > low:
        raise ValueError(
            f"the policy is no better than random actions (returns {high:.4g} and {low:.4g}): "
            "there is no medium quality between them"
        )
    weak, strong = 0.0, _MOST_NOISE
    for _ in range(_TRIALS):
        noise = (weak + strong) / 2
        share = (measured(noise) - low) / (high - low)
        say(f"noise {noise:.3g}: {share:.2f} of the way from random to expert")
        if MEDIUM[0] <= share <= MEDIUM[1]:
            return noise
        weak, strong = (noise, strong) if share > MEDIUM[1] else (weak, noise)
    raise ValueError(
        f"no noise gives a return between {MEDIUM[0]:.2f} and {MEDIUM[1]:.2f} of the way from "
        f"random actions to the policy: at {weak:.3g} it is above, at {strong:.3g} below"
    )
