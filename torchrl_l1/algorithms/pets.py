"""PETS and DETS: planning by trajectory sampling in an ensemble, with or without L1 in the loop.

Each outer iteration fits an ensemble to all real transitions so far and collects real episodes by
receding-horizon control: at every step, or every few, the cross-entropy method searches for the
action sequence with the highest imagined return (arXiv 1805.12114). There is no policy network:
only the model is learned. With L1 on, the adaptive controller augments the planned actions
(arXiv 2403.14860, section "Comparison with probabilistic models").
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, Unpack

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_l1.algorithms.algorithm import (
    COMMON_METRICS,
    Algorithm,
    IterationResult,
    Surroundings,
)
from torchrl_l1.algorithms.collection import L1_METRICS, returns_of_one_way, signal_metrics
from torchrl_l1.algorithms.config import episode_length, make_sampler
from torchrl_l1.algorithms.facts import AlgorithmFacts, Phase, Stage, Variant
from torchrl_l1.algorithms.pets_config import PETSConfig
from torchrl_l1.control import L1Config
from torchrl_l1.envs import AnyTask, Perturbation
from torchrl_l1.planning import ModelPredictiveController


class PETS(Algorithm):
    """The algorithm and its state; :meth:`iterate` is the loop.

    Args:
        task: a task, or its name, see :func:`torchrl_l1.envs.get_task`.
        config: settings.
        l1: the adaptive controller used in collection; ``None`` for none.
        perturbation: noise and disturbances of the real environments.
        **surroundings: see :class:`~torchrl_l1.algorithms.Algorithm`.
    """

    config_class = PETSConfig
    config: PETSConfig
    facts = AlgorithmFacts(
        name="PETS",
        stages=(Stage("planner", kinds=("stochastic",), is_planner=True),),
        phases={
            "random": Phase("random data"),
            "fit": Phase("fit", "fit"),
            "collect": Phase("planning and collecting", "collection"),
            "evaluate": Phase("evaluating", "measuring returns"),
        },
        metrics={
            **COMMON_METRICS,
            "return_mean": "Mean return of full real episodes, with L1 if it is on: those that "
            "join the data, or `evaluation_episodes` beside them if requested or if the data's "
            "are shorter.",
            "return_deterministic": "The same: the planner acts in only one way.",
            "plan/promised_return": "Mean over the collected steps of the imagined return of the "
            "best sequence in the last plan. If it is far above the real return, plans exploit "
            "the model.",
            **L1_METRICS,
        },
        color="#CC79A7",
        # With members that predict points.
        variants={"dets": Variant("DETS", "#009E73", {"model.head": "deterministic"})},
    )

    def __init__(
        self,
        task: str | AnyTask,
        config: PETSConfig,
        l1: L1Config | None = None,
        perturbation: Perturbation | None = None,
        **surroundings: Unpack[Surroundings],
    ) -> None:
        super().__init__(task, config, l1, perturbation, **surroundings)
        self.policy = ModelPredictiveController(
            make_sampler(
                config,
                self.dynamics,
                self.outcomes,
                common_noise=config.common_noise,
            ),
            config.cem,
            self.task.action_low,
            self.task.action_high,
            replan_every=config.replan_every,
        )
        real = partial(self.real, policy=self.policy)
        random_steps = episode_length(config.random_steps or self.episode_steps, self.horizon)
        self.start = real(episodes=config.random_episodes, horizon=random_steps)
        self.collection = real(episodes=config.episodes_per_iteration, horizon=self.episode_steps)
        self.evaluation = real(episodes=max(config.evaluation_episodes, 1), horizon=self.horizon)
        capacity = self.start.frames + config.outer_iterations * self.collection.frames
        self.learning = self.make_learning(capacity)
        self.fit_report: dict[str, float] = {}

    def iterate(self) -> Iterator[IterationResult]:
        """Run the remaining outer iterations, reporting after each."""
        for iteration in self.rounds():
            if len(self.learning.buffer) == 0:
                with self.phase("random"):
                    self.learning.store(self.start.random(self.seed))

            if iteration % self.config.fit_every == 0:
                self.fit_report = self.fit()

            with self.phase("collect"):
                data = self.collection.collect(self.seed, iteration)
                self.check_plans(data)
                self.learning.store(data)

            with self.phase("evaluate"):
                returns = returns_of_one_way(self.measured(data))

            metrics = {
                **returns,
                **signal_metrics(data),
                **self.fit_report,
                "plan/promised_return": data["next", "plan", "best_return"].mean().item(),
            }
            yield self.complete(
                self.start.frames + (iteration + 1) * self.collection.frames, metrics
            )

    def measured(self, data: TensorDictBase) -> TensorDictBase:
        """The collected episodes if they are full, otherwise others beside the data."""
        shorter = self.collection.horizon < self.evaluation.horizon
        if shorter or self.config.evaluation_episodes:
            return self.evaluation.evaluate(self.seed, self.iteration)
        return data

    @property
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """The planner, which acts in real environments."""
        return {"planner": self.policy}

    def choices(self) -> dict[str, str]:
        """Device and precision of planning, and whether it is compiled."""
        return {**super().choices(), **self.policy.sampler.choices()}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        return {**super().state_dict(), "fit_report": self.fit_report}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        super().load_state_dict(state)
        self.fit_report = state["fit_report"]
