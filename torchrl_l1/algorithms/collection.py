"""Real data: the perturbed environment, with or without L1, and random streams."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvBase, RewardSum, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, RandomPolicy, set_exploration_type

from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import L1Config, L1Transform, OracleTransform
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import AnyTask, Perturbation, make_env

RETURN_METRICS: dict[str, str] = {
    "return_mean": "Mean return of full real episodes, with L1 if it is on.",
    "return_std": "Standard deviation over these episodes.",
    "return_min": "Lowest return among them.",
    "return_max": "Highest return among them.",
    "return_deterministic": "Mean return of full real episodes with mean actions.",
    "episodes": "Number of episodes behind `return_mean`.",
    "non_finite_steps": "Real steps on which the simulator's state, the observation or the reward "
    "became non-finite; they end the episode and are left out of the data.",
}
"""Metrics of the episodes of a round, whatever collected them."""

L1_METRICS: dict[str, str] = {
    "l1/switch_rate": "Switches of the operating point per real step; about 1 with a Kalman "
    "filter, whose operating point follows the executed input.",
    "l1/affinization_error": "Mean distance between model and affine model at the tested input, "
    "raw state units, before switching.",
    "l1/affinization_error_max": "Largest such distance.",
    "l1/prediction_error": "Mean norm of the predictor's error x_hat - x, raw state units.",
    "l1/prediction_error_max": "Largest such norm.",
    "l1/matched": "Mean norm of the matched part of the estimate, state units per second.",
    "l1/matched_max": "Largest such norm.",
    "l1/unmatched": "Mean norm of the unmatched estimate, state units per second. It is "
    "estimated, not cancelled.",
    "l1/unmatched_max": "Largest such norm.",
    "l1/u_a": "Mean norm of the adaptive input, action units.",
    "l1/u_a_max": "Largest such norm.",
    "l1/saturation": "Share of action entries cut by a bound.",
    "l1/forecast_skill": "Mean share of its estimate that a controller with a record of forecasts "
    "acts on; 1 without.",
    "l1/ill_conditioned": "Share of steps with a rank-deficient or ill-conditioned Jacobian.",
    "l1/non_finite": "Steps on which an input of L1 was not finite, so that L1 did not act.",
}
"""Metrics of the adaptive controller in these episodes; only with L1 on."""

_L1_MEANS = {
    "switch": "switch_rate",
    "saturation": "saturation",
    "forecast_skill": "forecast_skill",
    "ill_conditioned": "ill_conditioned",
}
_L1_MEANS_AND_MAXIMA = ("affinization_error", "prediction_error", "matched", "unmatched", "u_a")

ORACLE: Literal["oracle"] = "oracle"
"""Stands for the oracle, which is told the matched disturbances, instead of L1's settings."""


def make_pipeline(
    task: AnyTask,
    num_envs: int,
    perturbation: Perturbation,
    dynamics: EnsembleDynamics,
    l1: L1Config | Literal["oracle"] | None,
    horizon: int | None = None,
    compile_l1: CompileMode = False,
    extra: Sequence[Transform] = (),
) -> TransformedEnv:
    """The perturbed environment, augmented by L1 unless ``l1`` is ``None``, and ``extra``.

    The order matters: on its way in, an action passes L1 first and the noise last; on its way
    out, an observation is noisy before L1 sees it. With :data:`ORACLE`, an
    :class:`~torchrl_l1.control.OracleTransform` replaces L1.
    """
    controller: list[Transform] = []
    if isinstance(l1, L1Config):
        controller = [L1Transform(dynamics, l1, compile=compile_l1)]
    elif l1 == ORACLE:
        controller = [OracleTransform()]
    return make_env(
        task,
        num_envs,
        **vars(perturbation),
        max_steps=horizon,
        extra_transforms=[RewardSum(), *controller, *extra],
    )


class Collection:
    """Collects episodes of ``horizon`` steps, ``episodes`` of them side by side.

    An environment whose episode ends early starts another, until each has taken ``horizon``
    steps. Every call starts from a fresh reset and a fresh seed, so that no state outlives it.

    Args:
        task: the task of the environments.
        episodes: number of episodes.
        policy: the policy that acts.
        dynamics: the model that L1 uses.
        l1: the controller; ``None`` for none, or :data:`ORACLE`.
        perturbation: noise and disturbances.
        horizon: steps per episode; the task's own if ``None``.
        compile_l1: whether to compile the controller's step.

    Attributes:
        horizon: steps of an episode.
        frames: total number of steps of all episodes.
        env: the environment with perturbation, L1 and what the policy needs.
    """

    def __init__(
        self,
        task: AnyTask,
        episodes: int,
        policy: TensorDictModuleBase,
        dynamics: EnsembleDynamics,
        l1: L1Config | Literal["oracle"] | None,
        perturbation: Perturbation,
        horizon: int | None = None,
        compile_l1: CompileMode = False,
    ) -> None:
        self.horizon = horizon or task.horizon
        self.frames = episodes * self.horizon
        self.policy = policy
        # A policy with a memory provides the transform that keeps it.
        primer = getattr(policy, "make_tensordict_primer", None)
        extra = [] if primer is None else [primer()]
        self.env = make_pipeline(
            task, episodes, perturbation, dynamics, l1, horizon, compile_l1, extra
        )
        # Random data never pass through L1: there is no model yet.
        self._bare_env = partial(
            make_pipeline, task, episodes, perturbation, dynamics, None, horizon
        )

    def __getstate__(self) -> dict[str, Any]:
        # A running iterator cannot be copied, and need not be: each call starts afresh.
        return {name: part for name, part in vars(self).items() if name != "_policy_batches"}

    @cached_property
    def _policy_batches(self) -> Iterator[TensorDictBase]:
        return self._batches(self.env, self.policy)

    def _batches(
        self, env: TransformedEnv, policy: TensorDictModuleBase
    ) -> Iterator[TensorDictBase]:
        collector = Collector(
            env,
            policy,
            frames_per_batch=self.frames,
            total_frames=-1,
            reset_at_each_iter=True,
            # Otherwise the device of every entry is checked twice per step.
            device=env.device,
            trust_policy=True,
            track_traj_ids=False,
            exploration_type=ExplorationType.RANDOM,
            auto_register_policy_transforms=False,
        )
        return iter(collector)

    def random(self, seed: int, bounds: tuple[Tensor, Tensor] | None = None) -> TensorDictBase:
        """Episodes ``[N, T]`` of actions uniform between ``bounds``, by default the task's."""
        env = self._bare_env()
        spec = env.full_action_spec
        if bounds is not None:
            low, high = (bound.expand(env.action_spec.shape) for bound in bounds)
            spec = Composite(action=Bounded(low, high, low.shape, dtype=torch.float32))
        batches = self._batches(env, RandomPolicy(spec))
        _seed(env, seed, "random")
        return _with_executed(next(batches))

    def collect(self, seed: int, iteration: int) -> TensorDictBase:
        """Episodes ``[N, T]`` of the stochastic policy, through L1 if it is on."""
        batches = self._policy_batches
        _seed(self.env, seed, "collect", iteration)
        return _with_executed(next(batches))

    def evaluate(
        self,
        seed: int,
        iteration: int = 0,
        deterministic: bool = True,
        steps: int | None = None,
        callback: Callable[[EnvBase, TensorDictBase], object] | None = None,
    ) -> TensorDictBase:
        """As many extra episodes ``[N, T]``, with the policy's mean or sampled actions.

        One episode per environment; rows that end early repeat their last step, see
        :func:`first_episodes`.

        ``callback`` is called after every step with the environment and the data so far.
        """
        _seed(self.env, seed, "evaluate", iteration)
        kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        with torch.no_grad(), set_exploration_type(kind):
            return self.env.rollout(
                steps or self.horizon,
                self.policy,
                callback=callback,
                break_when_any_done=False,
                break_when_all_done=True,
            )


def return_metrics(data: TensorDictBase) -> dict[str, float]:
    """Statistics of the returns of the environments' first episodes."""
    returns = episode_returns(data)
    return {
        "return_mean": returns.mean().item(),
        "return_std": returns.std(correction=0).item(),
        "return_min": returns.min().item(),
        "return_max": returns.max().item(),
        "episodes": returns.numel(),
    }


def returns_of_one_way(data: TensorDictBase) -> dict[str, float]:
    """Returns of a policy whose sampled and mean actions are the same."""
    deterministic = episode_returns(data).mean().item()
    return {**return_metrics(data), "return_deterministic": deterministic}


def policy_returns(
    data: TensorDictBase, collected: Collection, measured: Collection, seed: int, iteration: int
) -> dict[str, float]:
    """Returns of full episodes: with sampled actions and with the policy's mean action.

    If the collected episodes are full, they are used for the sampled actions.

    Args:
        data: episodes of ``collected``, of the stochastic policy.
        collected: the collection that they come from.
        measured: collection of full episodes of the same policy.
        seed: seed for the streams of the measured episodes.
        iteration: iteration for these streams.
    """
    shorter = collected.horizon < measured.horizon
    full = not shorter and not data["next", "terminated"].any()
    sampled = data if full else measured.evaluate(seed, iteration, deterministic=False)
    mean_action = episode_returns(measured.evaluate(seed, iteration, deterministic=True))
    return {**return_metrics(sampled), "return_deterministic": mean_action.mean().item()}


def signal_metrics(data: TensorDictBase) -> dict[str, float]:
    """Non-finite steps, and means and maxima of L1's signals if it is on."""
    metrics: dict[str, float] = {"non_finite_steps": int(data["next", "non_finite"].sum())}
    signals = data.get(("next", "l1"), None)
    if signals is not None and "non_finite" in signals:  # the oracle has none
        metrics["l1/non_finite"] = int(signals["non_finite"].sum())
        for name, label in _L1_MEANS.items():
            metrics[f"l1/{label}"] = signals[name].float().mean().item()
        for name in _L1_MEANS_AND_MAXIMA:
            metrics[f"l1/{name}"] = signals[name].mean().item()
            metrics[f"l1/{name}_max"] = signals[name].max().item()
    return metrics


def episode_returns(data: TensorDictBase) -> Tensor:
    """Undiscounted return of the first episode of every environment in ``[N, T]``: ``(N,)``.

    If episodes end early, others may follow in the same row. They would be a biased sample: the end
    of the data cuts off the long ones.
    """
    done = data["next", "done"].squeeze(-1)
    first = done & (done.cumsum(1) == 1)
    return data["next", "episode_reward"].squeeze(-1)[first]


def episode_lengths(data: TensorDictBase) -> Tensor:
    """Steps of the first episode of every environment in ``[N, T]``: ``(N,)``."""
    done = data["next", "done"].squeeze(-1)
    return (done.cumsum(1) - done.long() == 0).sum(1)


def first_episodes(data: TensorDictBase) -> TensorDictBase:
    """The steps of the first episode of every environment in ``[N, T]``, as one row."""
    done = data["next", "done"].squeeze(-1)
    return data[done.cumsum(1) - done.long() == 0]


def stream_seed(seed: int, *names: str | int) -> int:
    """A 63-bit seed for the stream with this name.

    Examples:
        >>> stream_seed(0, "iteration", 3) == stream_seed(0, "iteration", 3)
        True
        >>> stream_seed(0, "iteration", 3) == stream_seed(0, "iteration", 4)
        False
    """
    digest = hashlib.sha256(repr((int(seed), *names)).encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def seed_streams(seed: int, *names: str | int) -> None:
    """Start torch's global generator on the stream with this name."""
    torch.manual_seed(stream_seed(seed, *names))


def _with_executed(data: TensorDictBase) -> TensorDictBase:
    executed = data.get(("next", "l1", "u_exec"), None)
    return data.set("executed", data["action"] if executed is None else executed)


def _seed(env: EnvBase, seed: int, *names: str | int) -> None:
    """Start the resets and torch's global generator on an unused stream."""
    env.set_seed(stream_seed(seed, *names) % 2**31)
    seed_streams(seed, *names)
