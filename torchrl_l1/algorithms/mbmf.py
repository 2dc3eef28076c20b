"""MBMF: random shooting in a learned model, distilled into a policy that PPO then improves.

Three stages (arXiv 1708.02596): the model is fitted to real data that a random-shooting planner
collects with it; a policy network clones the planner, by DAgger; model-free reinforcement learning
improves the policy on real data. With L1 on, the adaptive controller augments the planner's actions
in the first stage (arXiv 2403.14860, section "L1-MBMF"); the other two do not know of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from time import perf_counter
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_l1.algorithms.algorithm import IterationResult, resolve_device, seed_streams
from torchrl_l1.algorithms.cloning import Cloning
from torchrl_l1.algorithms.collection import (
    episode_returns,
    policy_returns,
    return_metrics,
    signal_metrics,
)
from torchrl_l1.algorithms.fine_tuning import FineTuning
from torchrl_l1.algorithms.mbmf_config import MBMFConfig
from torchrl_l1.algorithms.mbmf_environments import StageEnvironments
from torchrl_l1.algorithms.mbmf_metrics import STAGES, cloning_metrics, fine_tuning_metrics
from torchrl_l1.algorithms.metrics import fit_metrics
from torchrl_l1.algorithms.model_learning import ModelLearning
from torchrl_l1.algorithms.policy import GaussianPolicy
from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import make_dynamics
from torchrl_l1.envs import Perturbation, get_task
from torchrl_l1.planning import ModelPredictiveController, ShootingConfig, TrajectorySampler

_PHASES = ("random", "fit", "clone", "tune", "collect", "evaluate")


class MBMF:
    """The algorithm and its state; :meth:`iterate` is the loop.

    Args:
        task: name of a task, see :data:`torchrl_l1.envs.TASKS`.
        config: settings.
        l1: the adaptive controller around the planner; ``None`` for none.
        perturbation: noise and disturbances of the real environment, in all stages.
        seed: seed of every random stream. Streams are derived anew from the seed and the
            iteration's number, so that a resumed run draws what an unbroken one would have.
        horizon: steps per real episode; the task's own by default.
        device: where models are fitted and plans are made: ``cpu``, ``cuda`` or ``auto``. Real
            environments, the copy of the model that L1 uses in them, and the policy, which is
            small, are on the CPU.
        compile_l1: whether to compile the controller's step, see
            :class:`~torchrl_l1.control.L1Transform`.
        on_phase: called with a word on what is going on, for progress bars.
    """

    def __init__(
        self,
        task: str,
        config: MBMFConfig,
        l1: L1Config | None = None,
        perturbation: Perturbation | None = None,
        seed: int = 0,
        horizon: int | None = None,
        device: str = "cpu",
        compile_l1: CompileMode = False,
        on_phase: Callable[[str], None] | None = None,
    ) -> None:
        self.config, self.seed = config, seed
        self.device = resolve_device(device)
        self.on_phase = on_phase or (lambda phase: None)
        self.task = get_task(task)
        n, m = self.task.observation_dim, self.task.action_dim
        seed_streams(seed, "initialisation")
        self.dynamics = make_dynamics(n, m, **vars(config.model)).to(self.device)
        on_cpu = self.device.type == "cpu"
        self.acting_dynamics = self.dynamics if on_cpu else deepcopy(self.dynamics).cpu()
        self.planner = self._planner(config.shooting)
        # In a state that the policy has visited there is no previous plan; the middle of the
        # bounds must not stand for one: where doing nothing is good, it would beat every draw.
        self.labeller = self._planner(replace(config.shooting, warm_start=False))
        self.initial = GaussianPolicy(n, m, config.policy.hidden, config.cloning.std)
        self.clone, self.policy = deepcopy(self.initial), deepcopy(self.initial)
        self.fine_tuning = FineTuning(self.policy, config.fine_tuning)

        self.real = StageEnvironments(
            self.task,
            config,
            self.acting_dynamics,
            planner=self.planner,
            visiting=self.clone if config.cloning.label_states == "current" else self.initial,
            clone=self.clone,
            policy=self.policy,
            l1=l1,
            perturbation=perturbation or Perturbation(),
            horizon=horizon,
            compile_l1=compile_l1,
        )
        rounds = config.shooting_iterations + config.cloning.iterations
        collected = config.collected_episodes(rounds) * self.real.shooting.horizon
        capacity = self.real.start.frames + collected
        self.learning = ModelLearning(self.dynamics, config.fit, config.label, capacity)
        half = (self.task.action_high - self.task.action_low) / 2
        self.cloning = Cloning(self.clone, config.cloning, half, collected)
        self.iteration = 0

    def iterate(self) -> Iterator[IterationResult]:
        """Run the outer iterations that are left, of all stages, reporting after each."""
        rounds = {"shooting": self._shoot, "cloning": self._clone, "fine_tuning": self._fine_tune}
        while self.iteration < self.config.outer_iterations:
            seed_streams(self.seed, "iteration", self.iteration)
            self._seconds = dict.fromkeys(_PHASES, 0.0)
            name, number = self.stage(self.iteration)
            metrics = rounds[name](number)
            head = {
                "iteration": self.iteration,
                "real_steps": self.real.start.frames
                + self.config.collected_episodes(self.iteration + 1) * self.real.shooting.horizon,
                "stage": STAGES.index(name) + 1,
            }
            self.iteration += 1
            yield IterationResult({**head, **metrics}, self._seconds)

    def stage(self, iteration: int) -> tuple[str, int]:
        """Stage of an outer iteration, and its number within it."""
        shooting, cloning = self.config.shooting_iterations, self.config.cloning.iterations
        if iteration < shooting:
            return "shooting", iteration
        if iteration < shooting + cloning:
            return "cloning", iteration - shooting
        return "fine_tuning", iteration - shooting - cloning

    def _shoot(self, number: int) -> dict[str, float]:
        """Stage 1: fit the model, let the planner act, with L1 around it if it is on."""
        if number == 0:
            with self._phase("random", "random data"):
                self.learning.store(self.real.start.random(self.seed, self._bounds()))
        fit = self._fit()
        with self._phase("collect", "planning and collecting"):
            data = self.real.shooting.collect(self.seed, self.iteration)
            self.learning.store(data)
            # What follows in a plan that is a few steps old does not answer the state.
            planned = data[(data["plan", "step"] % self.config.replan_every == 0).squeeze(-1)]
            self.cloning.store(planned["observation"], planned["action"])
        full = data
        if self.real.shooting.horizon < self.real.shooting_measured.horizon:
            with self._phase("evaluate", "evaluating"):
                full = self.real.shooting_measured.evaluate(self.seed, self.iteration)
        return {
            **_returns(full),
            **signal_metrics(data),
            **fit,
            "plan/promised_return": _finite_mean(data["next", "plan", "best_return"]),
        }

    def _clone(self, number: int) -> dict[str, float]:
        """Stage 2: the policy visits states, the planner labels them, the policy is fitted."""
        metrics = self._fit()
        if number > 0:
            with self._phase("collect", "visiting states and labelling them"):
                data = self.real.visits.collect(self.seed, self.iteration)
                self.learning.store(data)
                states = data["observation"].flatten(0, 1)
                plans = self.labeller.plan(states)
                found = plans.best_return.isfinite().cpu()
                self.cloning.store(states[found], plans.actions[:, 0].cpu()[found])
            metrics |= signal_metrics(data)
            metrics["plan/promised_return"] = _finite_mean(plans.best_return)
        with self._phase("clone", "cloning"):
            report = self.cloning.fit(lambda epoch: self.on_phase(f"cloning, epoch {epoch}"))
        with self._phase("evaluate", "evaluating"):
            measured = self.real.clone_measured.evaluate(self.seed, self.iteration)
        return {
            **_returns(measured),
            **metrics,
            **cloning_metrics(report, len(self.cloning.buffer)),
        }

    def _fine_tune(self, number: int) -> dict[str, float]:
        """Stage 3: the policy acts without a model, and PPO learns from that."""
        config = self.config.fine_tuning
        if number == 0:
            self.policy.load_state_dict(self.clone.state_dict())
            self.policy.reset_std(config.std)
        with self._phase("collect", "collecting"):
            data = self.real.practice.collect(self.seed, self.iteration)
        done = number * self.real.practice.frames / (config.anneal_steps or math.inf)
        with self._phase("tune", "PPO"):
            report = self.fine_tuning.step(data, min(done, 1.0))
        with self._phase("evaluate", "evaluating"):
            practice, measured = self.real.practice, self.real.policy_measured
            returns = policy_returns(data, practice, measured, self.seed, self.iteration)
        return {
            **returns,
            **signal_metrics(data),
            **fine_tuning_metrics(report),
            "policy/std": self.policy.log_std.detach().exp().mean().item(),
        }

    def _fit(self) -> dict[str, float]:
        with self._phase("fit", "fit"):
            report = self.learning.fit(lambda epoch: self.on_phase(f"fit, epoch {epoch}"))
            self.acting_dynamics.load_state_dict(self.dynamics.state_dict())
        return fit_metrics(report)

    @contextmanager
    def _phase(self, name: str, words: str) -> Iterator[None]:
        self.on_phase(words)
        start = perf_counter()
        yield
        self._seconds[name] += perf_counter() - start

    def _planner(self, shooting: ShootingConfig) -> ModelPredictiveController:
        config, task = self.config, self.task
        sampler = TrajectorySampler(
            self.dynamics,
            task.imagined_reward,
            task.terminated if task.terminates else None,
            config.particles,
            config.propagation,  # type: ignore[arg-type]
            config.precision,  # type: ignore[arg-type]
            discount=config.plan_discount,
            compile=config.compile_plans,  # type: ignore[arg-type]
        )
        return ModelPredictiveController(
            sampler, shooting, *self._bounds(), replan_every=config.replan_every
        )

    def _bounds(self) -> tuple[float, float]:
        """Bounds of random and planned actions."""
        own = math.inf if self.config.action_bound is None else self.config.action_bound
        return max(self.task.action_low, -own), min(self.task.action_high, own)

    @property
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """What acts in real environments after each stage, those that have begun."""
        rounds = max(self.iteration - 1, 0)
        reached = STAGES.index(self.stage(rounds)[0]) + 1
        every = (self.real.shooting, self.real.clone_measured, self.real.policy_measured)
        return {
            name: collection.policy
            for name, collection in zip(STAGES[:reached], every[:reached], strict=True)
        }

    def choices(self) -> dict[str, str]:
        """Where plans are made, in which precision, and whether compiled."""
        return {"device": str(self.device), **self.planner.sampler.choices()}

    def weights(self) -> dict[str, dict[str, Any]]:
        """State dicts of the model, the cloned policy and the one that PPO improves.

        The policies are there once their stage has begun.
        """
        networks = {"model": self.dynamics, "clone": self.clone, "policy": self.policy}
        reached = list(networks.items())[: len(self.policies)]
        return {name: network.state_dict() for name, network in reached}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        return {
            "iteration": self.iteration,
            "clone": self.clone.state_dict(),
            "policy": self.policy.state_dict(),
            "cloning": self.cloning.state_dict(),
            "fine_tuning": self.fine_tuning.state_dict(),
            **self.learning.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.iteration = state["iteration"]
        self.clone.load_state_dict(state["clone"])
        self.policy.load_state_dict(state["policy"])
        self.cloning.load_state_dict(state["cloning"])
        self.fine_tuning.load_state_dict(state["fine_tuning"])
        self.learning.load_state_dict(state)
        self.acting_dynamics.load_state_dict(self.dynamics.state_dict())


def _finite_mean(values: Tensor) -> float:
    """Mean of the values that are finite; NaN if none is."""
    return values[values.isfinite()].mean().item()


def _returns(data: TensorDictBase) -> dict[str, float]:
    """Returns of what acts in one way only."""
    deterministic = episode_returns(data).mean().item()
    return {**return_metrics(data), "return_deterministic": deterministic}
