"""MBMF: random shooting in a learned model, distilled into a policy that PPO then improves.

Three stages (arXiv 1708.02596): the model is fitted to real data that a random-shooting planner
collects with it; a policy network clones the planner with DAgger; model-free reinforcement learning
improves the policy on real data. With L1 on, the adaptive controller augments the planner's actions
in the first stage (arXiv 2403.14860, technical remarks on MBMF in its appendix); the other two
stages do not use it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any, Unpack

from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_l1.algorithms.algorithm import (
    COMMON_METRICS,
    Algorithm,
    IterationResult,
    Surroundings,
)
from torchrl_l1.algorithms.cloning import CLONING_METRICS, Cloning
from torchrl_l1.algorithms.collection import (
    L1_METRICS,
    policy_returns,
    returns_of_one_way,
    signal_metrics,
)
from torchrl_l1.algorithms.config import episode_length, make_sampler
from torchrl_l1.algorithms.facts import AlgorithmFacts, Phase
from torchrl_l1.algorithms.fine_tuning import FINE_TUNING_METRICS, FineTuning, exploring
from torchrl_l1.algorithms.mbmf_config import STAGES, MBMFConfig
from torchrl_l1.algorithms.policy import GaussianPolicy, acting
from torchrl_l1.control import L1Config
from torchrl_l1.envs import AnyTask, Perturbation, action_bounds
from torchrl_l1.planning import ModelPredictiveController, ShootingConfig


class MBMF(Algorithm):
    """The algorithm and its state; :meth:`iterate` is the loop.

    Args:
        task: a task, or its name, see :func:`torchrl_l1.envs.get_task`.
        config: settings.
        l1: the adaptive controller around the planner; ``None`` for none.
        perturbation: noise and disturbances of the real environments.
        **surroundings: see :class:`~torchrl_l1.algorithms.Algorithm`.

    Attributes:
        start: random data.
        shooting: episodes of the planner that join the data.
        shooting_measured: full episodes of the planner beside the data.
        visits: episodes of the policy whose states are labelled.
        clone_measured: full episodes of the clone.
        practice: episodes that PPO learns from.
        policy_measured: full episodes of the policy beside them.
    """

    config_class = MBMFConfig
    policy_settings = "cloning.learning_rate and fine_tuning.learning_rate"
    config: MBMFConfig
    facts = AlgorithmFacts(
        name="MBMF",
        stages=STAGES,
        phases={
            "random": Phase("random data"),
            "fit": Phase("fit", "fit"),
            "clone": Phase("cloning", "cloning"),
            "tune": Phase("PPO", "PPO"),
            "collect": Phase("collecting", "collection"),
            "evaluate": Phase("evaluating", "measuring returns"),
        },
        metrics={
            **COMMON_METRICS,
            "stage": "Stage of the iteration: 1 random shooting, 2 cloning (DAgger), "
            "3 fine-tuning (PPO).",
            "return_mean": "Mean return of full real episodes. Stage 1: of the planner, with L1 if "
            "it is on; they join the data, unless `episode_steps` makes those shorter. Stage 2: of "
            "the cloned policy's mean action, without L1, on `evaluation_episodes` episodes beside "
            "the data. Stage 3: of sampled actions, without L1, in the episodes that PPO learns "
            "from, or in `evaluation_episodes` beside them if those are shorter or ended early.",
            "return_deterministic": "The same in stages 1 and 2; in stage 3, of the policy's mean "
            "action, on `evaluation_episodes` episodes beside the data.",
            "plan/promised_return": "Stages 1 and 2: mean imagined return of the best sequence of "
            "each plan, over collected steps or over the states that the planner labels.",
            **CLONING_METRICS,
            **FINE_TUNING_METRICS,
            "policy/std": "Stage 3: mean standard deviation of the policy, action units.",
            **L1_METRICS,
        },
        color="#E69F00",
        tables={"training": "4"},
    )

    def __init__(
        self,
        task: str | AnyTask,
        config: MBMFConfig,
        l1: L1Config | None = None,
        perturbation: Perturbation | None = None,
        **surroundings: Unpack[Surroundings],
    ) -> None:
        super().__init__(task, config, l1, perturbation, **surroundings)
        n, m = self.task.observation_dim, self.task.action_dim
        self.planner = self._planner(config.shooting)
        # States visited by the policy have no previous plan; the middle of the bounds must not
        # replace it: where doing nothing is good, it would beat every draw.
        self.labeller = self._planner(replace(config.shooting, warm_start=False))
        self.initial = GaussianPolicy(n, m, config.policy.hidden, config.cloning.std)
        self.clone, self.policy = deepcopy(self.initial), deepcopy(self.initial)
        self.fine_tuning = FineTuning(self.policy, config.fine_tuning)
        self._open_environments()
        collected = config.collected_episodes(
            config.shooting_iterations + config.cloning.iterations
        )
        collected *= self.episode_steps
        capacity = self.start.frames + collected
        self.learning = self.make_learning(capacity)
        low, high = action_bounds(self.task)
        half = (high - low) / 2
        self.cloning = Cloning(self.clone, config.cloning, half, collected)

    def _open_environments(self) -> None:
        """The collecting and measuring parts of each stage, with L1 where it acts."""
        config, steps = self.config, self.episode_steps
        shooting, cloning, fine_tuning = (
            self.real if stage.with_l1 else partial(self.real, l1=None) for stage in STAGES
        )
        random_steps = episode_length(config.random_steps or steps, self.horizon)
        planned = partial(shooting, policy=self.planner)
        self.start = planned(episodes=config.random_episodes, horizon=random_steps)
        self.shooting = planned(episodes=config.shooting_episodes, horizon=steps)
        self.shooting_measured = planned(episodes=config.shooting_episodes, horizon=self.horizon)

        visiting = self.clone if config.cloning.label_states == "current" else self.initial
        full = {"episodes": config.evaluation_episodes, "horizon": self.horizon}
        self.visits = cloning(
            policy=acting(visiting, self.task), episodes=config.cloning.episodes, horizon=steps
        )
        self.clone_measured = cloning(policy=acting(self.clone, self.task), **full)

        explored = partial(fine_tuning, policy=exploring(self.policy, self.task))
        self.practice = explored(episodes=config.fine_tuning.episodes, horizon=steps)
        self.policy_measured = explored(**full)

    def iterate(self) -> Iterator[IterationResult]:
        """Run the remaining outer iterations of all stages, reporting after each."""
        stages = {"shooting": self._shoot, "cloning": self._clone, "fine_tuning": self._fine_tune}
        for iteration in self.rounds():
            name, number = self.config.stage(iteration)
            metrics = stages[name](number)
            collected = self.config.collected_episodes(iteration + 1) * self.episode_steps
            stage = {"stage": self.facts.position(name) + 1}
            yield self.complete(self.start.frames + collected, {**stage, **metrics})

    def _shoot(self, number: int) -> dict[str, float]:
        """Stage 1: fit the model, let the planner act, with L1 around it if it is on."""
        if number == 0:
            with self.phase("random"):
                self.learning.store(self.start.random(self.seed, self._bounds()))
        fit = self.fit()
        with self.phase("collect", "planning and collecting"):
            data = self.shooting.collect(self.seed, self.iteration)
            self.check_plans(data)
            self.learning.store(data)
            # Later actions of an older plan are not a response to the state.
            planned = data[(data["plan", "step"] % self.config.replan_every == 0).squeeze(-1)]
            self.cloning.store(planned["observation"], planned["action"])
        full = data
        if self.shooting.horizon < self.shooting_measured.horizon:
            with self.phase("evaluate"):
                full = self.shooting_measured.evaluate(self.seed, self.iteration)
        return {
            **returns_of_one_way(full),
            **signal_metrics(data),
            **fit,
            "plan/promised_return": _finite_mean(data["next", "plan", "best_return"]),
        }

    def _clone(self, number: int) -> dict[str, float]:
        """Stage 2: the policy visits states, the planner labels them, and the policy is fitted."""
        metrics = self.fit()
        if number > 0:
            with self.phase("collect", "visiting states and labelling them"):
                data = self.visits.collect(self.seed, self.iteration)
                self.learning.store(data)
                states = data["observation"].flatten(0, 1)
                plans = self.labeller.plan(states)
                found = plans.best_return.isfinite().cpu()
                self.cloning.store(states[found], plans.actions[:, 0].cpu()[found])
            metrics |= signal_metrics(data)
            metrics["plan/promised_return"] = _finite_mean(plans.best_return)
        with self.phase("clone"):
            report = self.cloning.fit(lambda epoch: self.on_phase(f"cloning, epoch {epoch}"))
        with self.phase("evaluate"):
            measured = self.clone_measured.evaluate(self.seed, self.iteration)
        return {
            **returns_of_one_way(measured),
            **metrics,
            **report.metrics(len(self.cloning.buffer)),
        }

    def _fine_tune(self, number: int) -> dict[str, float]:
        """Stage 3: the policy acts without a model, and PPO learns from its data."""
        config = self.config.fine_tuning
        if number == 0:
            self.policy.load_state_dict(self.clone.state_dict())
            self.policy.reset_std(config.std)
        with self.phase("collect"):
            data = self.practice.collect(self.seed, self.iteration)
        done = number * self.practice.frames / (config.anneal_steps or math.inf)
        with self.phase("tune"):
            try:
                learned = self.fine_tuning.step(data, min(done, 1.0)).metrics()
            except ValueError as error:
                self.diverged(str(error), "fine_tuning.value_learning_rate")
                learned = dict.fromkeys(FINE_TUNING_METRICS, math.nan)
            self._check_weights("policy", self.policy)
        with self.phase("evaluate"):
            practice, measured = self.practice, self.policy_measured
            returns = policy_returns(data, practice, measured, self.seed, self.iteration)
        return {
            **returns,
            **signal_metrics(data),
            **learned,
            "policy/std": self.policy.log_std.detach().exp().mean().item(),
        }

    def _planner(self, shooting: ShootingConfig) -> ModelPredictiveController:
        config = self.config
        sampler = make_sampler(config, self.dynamics, self.outcomes, discount=config.plan_discount)
        return ModelPredictiveController(
            sampler, shooting, *self._bounds(), replan_every=config.replan_every
        )

    def _bounds(self) -> tuple[Tensor, Tensor]:
        """Bounds of random and planned actions ``(m,)``."""
        own = math.inf if self.config.action_bound is None else self.config.action_bound
        low, high = action_bounds(self.task)
        return low.clamp(min=-own), high.clamp(max=own)

    @property
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """The policies after each stage that has begun."""
        last, _ = self.config.stage(max(self.iteration - 1, 0))
        every = (self.shooting, self.clone_measured, self.policy_measured)
        named = zip(self.facts.stage_names, every, strict=True)
        policies = {name: collection.policy for name, collection in named}
        return dict(list(policies.items())[: self.facts.position(last) + 1])

    def choices(self) -> dict[str, str]:
        """Device and precision of planning, and whether it is compiled."""
        return {**super().choices(), **self.planner.sampler.choices()}

    def weights(self) -> dict[str, dict[str, Any]]:
        """State dicts of the model, the cloned policy and the one that PPO improves.

        A policy is included once its stage has begun.
        """
        networks = {"clone": self.clone, "policy": self.policy}
        reached = list(networks.items())[: len(self.policies) - 1]
        return {**super().weights(), **{name: net.state_dict() for name, net in reached}}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        return {
            **super().state_dict(),
            "initial": self.initial.state_dict(),
            "clone": self.clone.state_dict(),
            "policy": self.policy.state_dict(),
            "cloning": self.cloning.state_dict(),
            "fine_tuning": self.fine_tuning.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        super().load_state_dict(state)
        # Older checkpoints lack it; it is drawn from the seed.
        self.initial.load_state_dict(state.get("initial", self.initial.state_dict()))
        self.clone.load_state_dict(state["clone"])
        self.policy.load_state_dict(state["policy"])
        self.cloning.load_state_dict(state["cloning"])
        self.fine_tuning.load_state_dict(state["fine_tuning"])


def _finite_mean(values: Tensor) -> float:
    """Mean of the finite values; NaN if there are none."""
    return values[values.isfinite()].mean().item()
