"""METRPO, model-ensemble trust region policy optimisation, with or without L1 in the loop.

Each outer iteration fits an ensemble to all real transitions so far, improves the policy by TRPO
on imagined trajectories, and collects real trajectories with the new policy (arXiv 1802.10592).
With L1 on, the adaptive controller augments the policy's action during collection; the rest of
the algorithm does not depend on it (arXiv 2403.14860, algorithm 2).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, Unpack

from tensordict.nn import TensorDictModuleBase

from torchrl_l1.algorithms.algorithm import (
    COMMON_METRICS,
    Algorithm,
    IterationResult,
    Surroundings,
)
from torchrl_l1.algorithms.collection import L1_METRICS, policy_returns, signal_metrics
from torchrl_l1.algorithms.facts import AlgorithmFacts, Phase, Stage
from torchrl_l1.algorithms.metrpo_config import METRPOConfig, check_clipping
from torchrl_l1.algorithms.policy import GaussianPolicy, acting
from torchrl_l1.algorithms.policy_improvement import (
    POLICY_METRICS,
    PolicyImprovement,
    policy_metrics,
)
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics.network import model_precision
from torchrl_l1.envs import AnyTask, Perturbation
from torchrl_l1.objectives import NonFiniteAdvantages


class METRPO(Algorithm):
    """The algorithm and its state; :meth:`iterate` is the loop.

    Args:
        task: a task, or its name, see :func:`torchrl_l1.envs.get_task`.
        config: settings.
        l1: the adaptive controller used in collection; ``None`` for none.
        perturbation: noise and disturbances of the real environments.
        **surroundings: see :class:`~torchrl_l1.algorithms.Algorithm`.

    Raises:
        ValueError: if L1 is on and ``clip_actions`` is off.
    """

    config_class = METRPOConfig
    config: METRPOConfig
    facts = AlgorithmFacts(
        name="METRPO",
        stages=(Stage("policy"),),
        phases={
            "random": Phase("random data"),
            "fit": Phase("fit", "fit"),
            "trpo": Phase("TRPO", "TRPO"),
            "collect": Phase("collecting", "collection"),
            "evaluate": Phase("evaluating", "measuring returns"),
        },
        metrics={
            **COMMON_METRICS,
            "return_mean": "Mean return of real episodes of the stochastic policy, with L1 if it "
            "is on; the paper's figure of merit. They are the episodes that join the data, unless "
            "`episode_steps` makes those shorter than the task or one of them ended early; then "
            "they are `evaluation_episodes` full ones beside the data.",
            "return_deterministic": "Mean return of `evaluation_episodes` full episodes with the "
            "policy's mean action (and L1 if it is on). They do not join the data and are not "
            "counted as real steps.",
            **POLICY_METRICS,
            "policy/std": "Mean standard deviation of the policy at collection, action units.",
            **L1_METRICS,
        },
        color="#000000",
        tables={"training": "1", "sim_to_real": "2", "ablation": "5"},
        compares_models=True,
        reference_logs=True,
    )

    def __init__(
        self,
        task: str | AnyTask,
        config: METRPOConfig,
        l1: L1Config | None = None,
        perturbation: Perturbation | None = None,
        **surroundings: Unpack[Surroundings],
    ) -> None:
        check_clipping(config.clip_actions, l1 is not None)
        super().__init__(task, config, l1, perturbation, **surroundings)
        n, m = self.task.observation_dim, self.task.action_dim
        self.policy = GaussianPolicy(n, m, config.policy.hidden, config.policy.std).to(self.device)
        self.improvement = PolicyImprovement(
            self.task, self.dynamics, self.policy, config, self.outcomes
        )
        self.acting_policy = self._on_cpu(self.policy)
        real = partial(self.real, policy=acting(self.acting_policy, self.task, config.clip_actions))
        self.collection = real(episodes=config.episodes_per_iteration, horizon=self.episode_steps)
        self.evaluation = real(episodes=config.evaluation_episodes, horizon=self.horizon)
        capacity = (config.outer_iterations + 1) * self.collection.frames
        self.learning = self.make_learning(capacity)

    def iterate(self) -> Iterator[IterationResult]:
        """Run the remaining outer iterations, reporting after each."""
        config = self.config
        for iteration in self.rounds():
            if len(self.learning.buffer) == 0:
                with self.phase("random"):
                    data = self.collection.random(self.seed)
                    self.learning.store(data)
                    self.improvement.see(data)

            fit = self.fit()

            with self.phase("trpo"):
                if config.policy.normalize:
                    self.policy.normalizer.fit(self.learning.buffer[:]["observation"])
                if config.policy.reset_std:
                    self.policy.reset_std(config.policy.std)
                steps = []
                for step in range(config.trpo_iterations):
                    self.on_phase(f"TRPO {step + 1}/{config.trpo_iterations}")
                    try:
                        steps.append(self.improvement.step(self.learning.buffer))
                    except NonFiniteAdvantages as error:
                        self.diverged(str(error), "imagined_horizon, discount and policy.std")
                improvement = policy_metrics(steps)
                self._check_finite(improvement)
                self._check_weights("policy", self.policy)

            with self.phase("collect"):
                self.acting_policy.load_state_dict(self.policy.state_dict())
                data = self.collection.collect(self.seed, iteration)
                self.learning.store(data)
                self.improvement.see(data)

            with self.phase("evaluate"):
                returns = policy_returns(
                    data, self.collection, self.evaluation, self.seed, iteration
                )

            metrics = {
                **returns,
                **signal_metrics(data),
                **fit,
                **improvement,
                "policy/std": self.policy.log_std.detach().exp().mean().item(),
            }
            # There are as many random data as in an iteration.
            yield self.complete((iteration + 2) * self.collection.frames, metrics)

    @property
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """The policy that acts in real environments, with clipped actions if settings say so."""
        return {"policy": self.collection.policy}

    def choices(self) -> dict[str, str]:
        """Device and precision of fits and imagined trajectories."""
        imagination = model_precision(self.dynamics, self.config.precision)
        return {**super().choices(), "imagination": imagination}

    def weights(self) -> dict[str, dict[str, Any]]:
        """State dicts of model and policy."""
        return {**super().weights(), "policy": self.policy.state_dict()}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        return {
            **super().state_dict(),
            "policy": self.policy.state_dict(),
            "improvement": self.improvement.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        super().load_state_dict(state)
        self.policy.load_state_dict(state["policy"])
        self.acting_policy.load_state_dict(state["policy"])
        self.improvement.load_state_dict(state["improvement"])
