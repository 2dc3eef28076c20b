"""PETS and DETS: planning by trajectory sampling in an ensemble, with or without L1 in the loop.

Each outer iteration fits an ensemble to all real transitions so far and collects real episodes by
receding-horizon control: at every step, or every few, the cross-entropy method looks for the
action sequence with the highest imagined return (arXiv 1805.12114). There is no policy network:
what is learned is the model. With L1 on, the adaptive controller augments the planned actions
(arXiv 2403.14860, section "Comparison with probabilistic models").
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from functools import partial
from itertools import pairwise
from time import perf_counter
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_l1.algorithms.algorithm import IterationResult, resolve_device, seed_streams
from torchrl_l1.algorithms.collection import (
    Collection,
    episode_returns,
    return_metrics,
    signal_metrics,
)
from torchrl_l1.algorithms.metrics import COMMON, L1, fit_metrics
from torchrl_l1.algorithms.model_learning import ModelLearning
from torchrl_l1.algorithms.pets_config import PETSConfig
from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import make_dynamics
from torchrl_l1.envs import Perturbation, get_task
from torchrl_l1.planning import ModelPredictiveController, TrajectorySampler

METRICS: dict[str, str] = {
    **COMMON,
    "return_mean": "Mean return of full real episodes, with L1 if it is on: those that join the "
    "data, or `evaluation_episodes` beside them if these are asked for or the data's are shorter.",
    "return_deterministic": "The same: the planner acts in one way only.",
    "plan/promised_return": "Mean over the collected steps of the imagined return of the best "
    "sequence that the last plan has seen. Far above what comes, it says that plans exploit the "
    "model.",
    **L1,
}
"""Every metric of :class:`PETS`; ``l1/...`` only with L1 on."""


class PETS:
    """The algorithm and its state; :meth:`iterate` is the loop.

    Args:
        task: name of a task, see :data:`torchrl_l1.envs.TASKS`.
        config: settings.
        l1: the adaptive controller used in collection; ``None`` for none.
        perturbation: noise and disturbances of the real environment.
        seed: seed of every random stream. Streams are derived anew from the seed and the
            iteration's number, so that a resumed run draws what an unbroken one would have.
        horizon: steps per real episode; the task's own by default.
        device: where models are fitted and plans are made: ``cpu``, ``cuda`` or ``auto``. Real
            environments, and the copy of the model that L1 uses in them, are on the CPU.
        compile_l1: whether to compile the controller's step, see
            :class:`~torchrl_l1.control.L1Transform`.
        on_phase: called with a word on what is going on, for progress bars.
    """

    def __init__(
        self,
        task: str,
        config: PETSConfig,
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
        sampler = TrajectorySampler(
            self.dynamics,
            self.task.imagined_reward,
            self.task.terminated if self.task.terminates else None,
            config.particles,
            config.propagation,  # type: ignore[arg-type]
            config.precision,  # type: ignore[arg-type]
            config.common_noise,
            compile=config.compile_plans,  # type: ignore[arg-type]
        )
        self.policy = ModelPredictiveController(
            sampler,
            config.cem,
            self.task.action_low,
            self.task.action_high,
            replan_every=config.replan_every,
        )
        real = partial(
            Collection,
            self.task,
            policy=self.policy,
            dynamics=self.acting_dynamics,
            l1=l1,
            perturbation=perturbation or Perturbation(),
            compile_l1=compile_l1,
        )
        full = horizon or self.task.horizon
        steps = min(config.episode_steps or full, full)
        self.start = real(
            episodes=config.random_episodes, horizon=min(config.random_steps or steps, full)
        )
        self.collection = real(episodes=config.episodes_per_iteration, horizon=steps)
        self.evaluation = real(episodes=max(config.evaluation_episodes, 1), horizon=full)
        capacity = self.start.frames + config.outer_iterations * self.collection.frames
        self.learning = ModelLearning(self.dynamics, config.fit, config.label, capacity)
        self.fit_report: dict[str, float] = {}
        self.iteration = 0

    def iterate(self) -> Iterator[IterationResult]:
        """Run the outer iterations that are left, reporting after each."""
        config = self.config
        while self.iteration < config.outer_iterations:
            seed_streams(self.seed, "iteration", self.iteration)
            clock = [perf_counter()]
            if len(self.learning.buffer) == 0:
                self.on_phase("random data")
                self.learning.store(self.start.random(self.seed))
            clock.append(perf_counter())

            if self.iteration % config.fit_every == 0:
                report = self.learning.fit(lambda epoch: self.on_phase(f"fit, epoch {epoch}"))
                self.fit_report = fit_metrics(report)
                self.acting_dynamics.load_state_dict(self.dynamics.state_dict())
            clock.append(perf_counter())

            self.on_phase("planning and collecting")
            data = self.collection.collect(self.seed, self.iteration)
            self.learning.store(data)
            clock.append(perf_counter())
            self.on_phase("evaluating")
            returns = self.evaluate(data)
            clock.append(perf_counter())

            metrics = {
                "iteration": self.iteration,
                "real_steps": self.start.frames + (self.iteration + 1) * self.collection.frames,
                **returns,
                **signal_metrics(data),
                **self.fit_report,
                "plan/promised_return": data["next", "plan", "best_return"].mean().item(),
            }
            self.iteration += 1
            phases = ("random", "fit", "collect", "evaluate")
            seconds = [after - before for before, after in pairwise(clock)]
            yield IterationResult(metrics, dict(zip(phases, seconds, strict=True)))

    def evaluate(self, data: TensorDictBase) -> dict[str, float]:
        """Returns of the collected episodes if they are full, else of others beside the data.

        The planner acts the same in both, so both kinds of return come from the same episodes.
        """
        shorter = self.collection.horizon < self.evaluation.horizon
        if shorter or self.config.evaluation_episodes:
            data = self.evaluation.evaluate(self.seed, self.iteration)
        returns = return_metrics(data)
        return {**returns, "return_deterministic": episode_returns(data).mean().item()}

    @property
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """What acts in real environments: the planner."""
        return {"planner": self.policy}

    def choices(self) -> dict[str, str]:
        """Where plans are made, in which precision, and whether compiled."""
        return {"device": str(self.device), **self.policy.sampler.choices()}

    def weights(self) -> dict[str, dict[str, Any]]:
        """State dict of the model: there is nothing else."""
        return {"model": self.dynamics.state_dict()}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        return {
            "iteration": self.iteration,
            "fit_report": self.fit_report,
            **self.learning.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.iteration = state["iteration"]
        self.fit_report = state["fit_report"]
        self.learning.load_state_dict(state)
        self.acting_dynamics.load_state_dict(self.dynamics.state_dict())
