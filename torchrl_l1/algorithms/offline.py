"""Offline model-based learning: a dataset, a model, and a policy that is improved in it alone.

The ensemble is fitted once to the data. A policy, cloned from the data's actions, is improved by
TRPO on imagined trajectories that are short, start in the data and are penalized for the model's
uncertainty: MOPO subtracts it from the reward (arXiv 2005.13239), MOReL ends the trajectory (arXiv
2005.05951). The real system is used only to measure the policy, and L1, which needs nothing but the
model, augments its actions there: the future work of arXiv 2403.14860.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Unpack

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import ReplayBuffer

from torchrl_l1.algorithms.algorithm import (
    COMMON_METRICS,
    Algorithm,
    IterationResult,
    Surroundings,
)
from torchrl_l1.algorithms.cloning import Cloning
from torchrl_l1.algorithms.collection import (
    L1_METRICS,
    episode_returns,
    first_episodes,
    return_metrics,
    seed_streams,
    signal_metrics,
)
from torchrl_l1.algorithms.facts import AlgorithmFacts, Phase, Stage
from torchrl_l1.algorithms.offline_config import OfflineConfig
from torchrl_l1.algorithms.outcomes import OUTCOME_METRICS
from torchrl_l1.algorithms.pessimism import PENALTY_METRICS, Pessimism
from torchrl_l1.algorithms.policy import GaussianPolicy, acting
from torchrl_l1.algorithms.policy_improvement import (
    POLICY_METRICS,
    PolicyImprovement,
    policy_metrics,
)
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import read_transitions
from torchrl_l1.dynamics.functions import one_each
from torchrl_l1.dynamics.network import model_precision
from torchrl_l1.dynamics.transitions import Data, check_time_step
from torchrl_l1.envs import AnyTask, Perturbation, action_bounds
from torchrl_l1.objectives import NonFiniteAdvantages

OFFLINE_METRICS: dict[str, str] = {
    "data/transitions": "Transitions of the dataset.",
    "data/dropped": "Rows of it that are not transitions: non-finite values, steps across a reset.",
    "data/reward": "Mean of the task's reward over the transitions.",
    "clone/validation_loss": "Mean squared difference between the cloned policy's mean action and "
    "the data's, in halves of the action range, on states held out of training; 0 without cloning.",
    "clone/return": "Mean return of `evaluation_episodes` real episodes with the mean action of "
    "the first policy, cloned or random: what imagination has to improve.",
}
"""Metrics of the data and the first policy; the same in all outer iterations."""


class Offline(Algorithm):
    """The algorithm and its state; :meth:`iterate` is the loop.

    Args:
        task: a task, or its name, see :func:`torchrl_l1.envs.get_task`: it provides rewards,
            bounds, and the real system on which policies are measured.
        config: settings.
        l1: the adaptive controller used in measurements; ``None`` for none.
        perturbation: noise and disturbances of the real environments.
        data: transitions with ``observation``, ``action`` and ``("next", "observation")``, see
            :func:`~torchrl_l1.dynamics.read_transitions`, or a function that reads them.
            ``executed`` actions are used if there are any and ``config.label`` says so.
        **surroundings: see :class:`~torchrl_l1.algorithms.Algorithm`.

    Raises:
        ValueError: if a reward or a termination is to be learned.

    Attributes:
        pessimism: the penalty on imagined trajectories for the model's uncertainty.

    Examples:
        >>> from torchrl_l1.envs import make_env
        >>> data = make_env("inverted_pendulum", 4, max_steps=50).rollout(50)
        >>> config = OfflineConfig(
        ...     outer_iterations=1, trpo_iterations=1, imagined_steps=500, evaluation_episodes=2
        ... )
        >>> offline = Offline("inverted_pendulum", config, data=data, horizon=50)
        >>> [result] = offline.iterate()
        >>> result.metrics["data/transitions"]
        200
    """

    config_class = OfflineConfig
    policy_settings = "cloning.learning_rate, policy.std and trpo.max_kl"
    config: OfflineConfig
    facts = AlgorithmFacts(
        name="Offline",
        stages=(Stage("policy"),),
        phases={
            "fit": Phase("fit", "fit"),
            "clone": Phase("cloning", "cloning"),
            "trpo": Phase("TRPO", "TRPO"),
            "evaluate": Phase("evaluating", "measuring returns"),
        },
        metrics={
            **{
                name: words for name, words in COMMON_METRICS.items() if name not in OUTCOME_METRICS
            },
            "real_steps": "Transitions of the dataset; those of measurements do not count.",
            "return_mean": "Mean return of `evaluation_episodes` real episodes with sampled "
            "actions, with L1 if it is on. Nothing is learned from them.",
            "return_deterministic": "The same with the policy's mean action.",
            **OFFLINE_METRICS,
            **POLICY_METRICS,
            "imagined/return_first": "Mean imagined return before the first TRPO step, penalty "
            "included.",
            "imagined/return_last": "The same before the last TRPO step.",
            **PENALTY_METRICS,
            "policy/std": "Mean standard deviation of the policy, action units.",
            **L1_METRICS,
        },
        color="#56B4E9",
        offline=True,
    )

    def __init__(
        self,
        task: str | AnyTask,
        config: OfflineConfig,
        l1: L1Config | None = None,
        perturbation: Perturbation | None = None,
        *,
        data: Data | Callable[[], Data] | None = None,
        **surroundings: Unpack[Surroundings],
    ) -> None:
        super().__init__(task, config, l1, perturbation, **surroundings)
        if self.outcomes.models:
            raise ValueError(
                f"{' and '.join(self.outcomes.models)}: offline learning needs known rewards and "
                "terminations; choose builtin or MODULE:FUNCTION instead of learned"
            )
        self.data = data
        n, m = self.task.observation_dim, self.task.action_dim
        self.policy = GaussianPolicy(n, m, config.policy.hidden, config.policy.std).to(self.device)
        self.pessimism = Pessimism(self.dynamics, config, *action_bounds(self.task, self.device))
        self.improvement = PolicyImprovement(
            self.task, self.dynamics, self.policy, config, self.outcomes, self.pessimism
        )
        self.acting_policy = self._on_cpu(self.policy)
        self.evaluation = self.real(
            policy=acting(self.acting_policy, self.task),
            episodes=config.evaluation_episodes,
            horizon=self.horizon,
        )
        self.learning = self.make_learning(capacity=1)
        # What the first outer iteration finds out for all.
        self.known: dict[str, float] = {}

    def prepare(self) -> None:
        """Read the dataset, unless it has been read.

        Raises:
            KeyError: if it lacks an entry of a transition.
            OSError: if it cannot be read.
            ValueError: if there is none, or it does not fit the task.
        """
        if len(self.learning.buffer):
            return
        if self.data is None:
            raise ValueError("offline learning needs a dataset: set dataset=...")
        data = self.data() if callable(self.data) else self.data
        if isinstance(data, ReplayBuffer):
            data = data[:] if len(data) else []
        parts = [data] if isinstance(data, TensorDictBase) else list(data)
        check_time_step(parts, self.task.dt, f"the task {self.task.name}")
        told = all("executed" in part.keys() for part in parts)  # noqa: SIM118
        executed = self.config.label == "executed" and told
        read = read_transitions(
            parts,
            action_key="executed" if executed else "action",
            dtype=torch.get_default_dtype(),
        )
        self._check(read.data)
        rows = read.data.shape[0]
        observation, action, following = (
            read.data[key] for key in ("observation", "action", ("next", "observation"))
        )
        reward = one_each(self.outcomes.reward, "reward", observation, action, following)
        flat = TensorDict(
            {
                "observation": observation,
                "action": action,
                "executed": action,
                "next": {
                    "observation": following,
                    "reward": reward[:, None],
                    "non_finite": torch.zeros(rows, 1, dtype=torch.bool),
                },
            },
            batch_size=[rows],
        ).cpu()
        # Drawn from its own stream: the data may be read before or within the loop.
        seed_streams(self.seed, "dataset")
        self.learning.reserve(rows)
        self.learning.store(flat)
        self.known = {
            "data/transitions": rows,
            "data/dropped": read.dropped,
            "data/reward": float(flat["next", "reward"].double().mean()),
        }

    def _check(self, data: TensorDictBase) -> None:
        task = self.task
        found = [data[key].shape[-1] if data.shape[0] else 0 for key in ("observation", "action")]
        if not data.shape[0]:
            raise ValueError("the dataset holds no transitions")
        if found != [task.observation_dim, task.action_dim]:
            raise ValueError(
                f"the dataset has observations of {found[0]} and actions of {found[1]} entries, "
                f"the task {task.name} of {task.observation_dim} and {task.action_dim}: choose "
                "another dataset, or another task"
            )

    def iterate(self) -> Iterator[IterationResult]:
        """Run the remaining outer iterations, reporting after each."""
        config = self.config
        if self.iteration == 0:
            self.prepare()
        for iteration in self.rounds():
            if iteration == 0:
                self.known |= self.fit()
                self._calibrate_penalty()
                self.known |= self._first_policy()
                with self.phase("evaluate"):
                    self.acting_policy.load_state_dict(self.policy.state_dict())
                    first = self.evaluation.evaluate(self.seed, iteration)
                    self.known["clone/return"] = episode_returns(first).mean().item()
                    # An external environment does not tell how its episodes start.
                    self.improvement.see(first[:, :1])
                # The evaluation has begun another stream.
                seed_streams(self.seed, "improvement")

            with self.phase("trpo"):
                if config.policy.reset_std:
                    self.policy.reset_std(config.policy.std)
                steps = []
                for step in range(config.trpo_iterations):
                    self.on_phase(f"TRPO {step + 1}/{config.trpo_iterations}")
                    try:
                        steps.append(self.improvement.step(self.learning.buffer))
                    except NonFiniteAdvantages as error:
                        self.diverged(str(error), "penalty_coefficient, discount and policy.std")
                self._check_weights("policy", self.policy)

            with self.phase("evaluate"):
                self.acting_policy.load_state_dict(self.policy.state_dict())
                sampled = self.evaluation.evaluate(self.seed, iteration, deterministic=False)
                mean_action = self.evaluation.evaluate(self.seed, iteration)

            metrics = {
                **return_metrics(sampled),
                "return_deterministic": episode_returns(mean_action).mean().item(),
                **signal_metrics(first_episodes(sampled)),
                **self.known,
                **policy_metrics(steps),
                **self.pessimism.metrics(),
                "policy/std": self.policy.log_std.detach().exp().mean().item(),
            }
            yield self.complete(len(self.learning.buffer), metrics)

    def _calibrate_penalty(self) -> None:
        with self.phase("fit", "uncertainty of the data"):
            data = self.learning.buffer[:].to(self.device)
            reward = data["next", "reward"].squeeze(-1)
            self.pessimism.calibrate(data["observation"], data["action"], reward)

    def _first_policy(self) -> dict[str, float]:
        """The phase that fits the policy to the data's actions, if settings say so."""
        config, data = self.config.cloning, self.learning.buffer[:]
        normalize = self.config.policy.normalize
        with self.phase("clone"):
            if not config.enabled:
                if normalize:
                    self.policy.normalizer.fit(data["observation"].to(self.device))
                return {"clone/validation_loss": 0.0}
            low, high = action_bounds(self.task)
            cloning = Cloning(self.policy, config, (high - low) / 2, len(data), normalize)
            cloning.store(data["observation"], data["action"])
            report = cloning.fit(lambda epoch: self.on_phase(f"cloning, epoch {epoch}"))
            self._check_weights("policy", self.policy)
        return {"clone/validation_loss": report.validation_loss}

    @property
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """The policy that acts in real environments, with clipped actions."""
        return {"policy": self.evaluation.policy}

    def choices(self) -> dict[str, str]:
        """Device and precision of fits and imagined trajectories."""
        imagination = model_precision(self.dynamics, self.config.precision)
        return {**super().choices(), "imagination": imagination}

    def weights(self) -> dict[str, dict[str, Any]]:
        """State dicts of model and policy."""
        return {**super().weights(), "policy": self.policy.state_dict()}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, including the data, as plain tensors and numbers."""
        return {
            **super().state_dict(),
            "policy": self.policy.state_dict(),
            "improvement": self.improvement.state_dict(),
            "pessimism": self.pessimism.state_dict(),
            "known": self.known,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        rows = state["buffer"].get("observation", ())
        self.learning.reserve(max(1, len(rows)))
        super().load_state_dict(state)
        self.policy.load_state_dict(state["policy"])
        self.acting_policy.load_state_dict(state["policy"])
        self.improvement.load_state_dict(state["improvement"])
        self.pessimism.load_state_dict(state["pessimism"])
        self.known = state["known"]
