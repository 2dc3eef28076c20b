"""The common interface of algorithms: running, saving and evaluating them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, ClassVar, Protocol, TypedDict, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_l1.algorithms.collection import RETURN_METRICS, Collection, seed_streams
from torchrl_l1.algorithms.config import ModelConfig, check_covariance, episode_length
from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.algorithms.model_learning import FIT_METRICS, ModelLearning, fit_metrics
from torchrl_l1.algorithms.outcomes import OUTCOME_METRICS, OutcomeConfig, Outcomes
from torchrl_l1.checks import check_optional_count
from torchrl_l1.compilation import CompileMode
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import FitConfig, calibrate_filter, make_dynamics
from torchrl_l1.dynamics.network import model_precision
from torchrl_l1.envs import AnyTask, BadAction, Perturbation, get_task

_Module = TypeVar("_Module", bound=nn.Module)

DEVICES = ("cpu", "cuda", "auto")
"""Devices on which models may be fitted and trajectories imagined."""


def resolve_device(name: str) -> torch.device:
    """The device; ``auto`` is CUDA if available. A missing device is a ``ValueError``."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name not in DEVICES:
        raise ValueError(f"device must be {' or '.join(DEVICES)}, got {name!r}")
    device = torch.device(name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda was requested, but torch finds no CUDA device; use cpu")
    return device


COMMON_METRICS: dict[str, str] = {
    "iteration": "Outer iteration, from 0.",
    "real_steps": "Real environment steps so far, including the initial random ones.",
    **RETURN_METRICS,
    **FIT_METRICS,
    **OUTCOME_METRICS,
}
"""Metrics that every algorithm logs."""


class Diverged(ValueError):
    """A value that training cannot continue from has become infinite or NaN.

    Attributes:
        iteration: the outer iteration in which this happened.
        may_go_on: whether ``on_divergence=warn`` would have continued.
    """

    def __init__(
        self, iteration: int, phase: str, what: str, setting: str, may_go_on: bool = True
    ) -> None:
        super().__init__(
            f"training diverged in iteration {iteration}, {phase}: {what}; look at {setting}"
        )
        self.iteration = iteration
        self.may_go_on = may_go_on


# Number of transitions for which predictions must be finite.
_PROBED = 64

# Metrics of all algorithms, by prefix, that are finite in every round of a healthy training, and
# the settings to look at otherwise.
_FINITE = {
    "model/": "fit.learning_rate, model.std_floor and the data's scale",
    "reward_model/": "fit.learning_rate, model.std_floor and the rewards' scale",
    "termination_model/": "fit.learning_rate and model.std_floor",
    "clone/": "cloning.learning_rate",
    "ppo/kl": "fine_tuning.learning_rate",
    "ppo/value_loss": "fine_tuning.value_learning_rate",
    "trpo/": "trpo.max_kl and policy.std",
    "imagined/return": "imagined_horizon and model.box_margin",
    "policy/": "policy.std",
    "return_": "policy.std and the environment's rewards",
}


@dataclass
class IterationResult:
    """The result of an outer iteration.

    Attributes:
        metrics: metrics by name.
        seconds: wall-clock time by phase.
        diverged: what went wrong in it, if the algorithm continues all the same, see
            :class:`Algorithm`.
    """

    metrics: dict[str, float]
    seconds: dict[str, float]
    diverged: list[Diverged] = field(default_factory=list)


class AlgorithmConfig(Protocol):
    """Settings common to all algorithms."""

    outer_iterations: int
    label: str
    model: ModelConfig
    fit: FitConfig

    @property
    def episode_steps(self) -> int | None:
        """Steps of a collected episode; those of a full one if `None`."""


class Surroundings(TypedDict, total=False):
    """Arguments of an algorithm besides its settings, see :class:`Algorithm`."""

    seed: int
    horizon: int | None
    device: str
    compile_l1: CompileMode
    on_phase: Callable[[str], None] | None
    reward: str
    termination: str
    outcome_model: OutcomeConfig | None
    search_path: Sequence[str]


class Algorithm(ABC):
    """Base of model-based algorithms: task, model, data, random streams, phases and state.

    A loop goes over :meth:`rounds`, does its work in one :meth:`phase` after another, and yields
    the result of :meth:`complete` for each round. A subclass sets ``learning``, since it knows the
    number of real steps, and provides what acts (:attr:`policies`).

    Args:
        task: a task, or its name, see :func:`torchrl_l1.envs.get_task`.
        config: settings.
        l1: the adaptive controller of real environments; ``None`` for none.
        perturbation: noise and disturbances of the real environments.
        seed: seed of every random stream. Streams are derived from the seed and the number of the
            iteration, so that a resumed run draws the same numbers as an uninterrupted one.
        horizon: steps per full real episode; the task's own by default.
        device: device for fitting models, imagining trajectories and planning: ``cpu``, ``cuda`` or
            ``auto``. Real environments, and copies of what acts in them, are on the CPU.
        compile_l1: whether to compile the controller's step, see
            :class:`~torchrl_l1.control.L1Transform`.
        on_phase: called with a description of the current work, for progress bars.
        reward: reward of imagined trajectories, see :class:`~torchrl_l1.algorithms.Outcomes`.
        termination: termination of imagined trajectories, likewise.
        outcome_model: settings of a learned reward and a learned termination.
        search_path: folders for files and modules that reward and termination name.

    Attributes:
        facts: what is known about the algorithm without running it.
        policy_settings: settings to look at if a policy returns non-finite actions.
        config_class: the class of its settings.
        iteration: number of completed outer iterations.
        stops_on_divergence: whether to raise :class:`Diverged` when something is no longer
            finite, or to note it in the result of the iteration.
        dynamics: the model.
        acting_dynamics: the model that L1 uses in real environments, on the CPU.
        outcomes: rewards and terminations of imagined trajectories.
        learning: the model's data and fits.
        real: makes real environments, see :class:`~torchrl_l1.algorithms.collection.Collection`.
        horizon: steps per full real episode.
        episode_steps: steps of a collected episode.
    """

    facts: ClassVar[AlgorithmFacts]
    policy_settings: ClassVar[str] = "policy.std and trpo.max_kl"
    config_class: ClassVar[type[Any]]
    config: AlgorithmConfig
    learning: ModelLearning

    def __init__(
        self,
        task: str | AnyTask,
        config: AlgorithmConfig,
        l1: L1Config | None = None,
        perturbation: Perturbation | None = None,
        *,
        seed: int = 0,
        horizon: int | None = None,
        device: str = "cpu",
        compile_l1: CompileMode = False,
        on_phase: Callable[[str], None] | None = None,
        reward: str = "builtin",
        termination: str = "builtin",
        outcome_model: OutcomeConfig | None = None,
        search_path: Sequence[str] = (),
    ) -> None:
        check_optional_count("horizon", horizon)
        check_covariance(l1, config.model, config.fit.elites)
        self.config, self.l1, self.seed = config, l1, seed
        self.device = resolve_device(device)
        self.on_phase = on_phase or (lambda phase: None)
        self.task = get_task(task)
        self.horizon = horizon or self.task.horizon
        self.episode_steps = episode_length(config.episode_steps, self.horizon)
        self.iteration = 0
        self._seconds: dict[str, float] = {}
        self._phase = ""
        self._diverged: list[Diverged] = []
        self.stops_on_divergence = True

        seed_streams(self.seed, "initialisation")
        model = vars(config.model)
        self.dynamics = make_dynamics(self.task.observation_dim, self.task.action_dim, **model)
        self.dynamics.to(self.device)
        self.outcomes = Outcomes(
            self.task,
            reward,
            termination,
            outcome_model,
            config.fit,
            std_floor=config.model.std_floor,
            margin=config.model.box_margin,
            seed=seed,
            device=self.device,
            search_path=search_path,
        )
        self.acting_dynamics = self._on_cpu(self.dynamics)
        self.real = partial(
            Collection,
            self.task,
            dynamics=self.acting_dynamics,
            l1=l1,
            perturbation=perturbation or Perturbation(),
            compile_l1=compile_l1,
        )

    def _on_cpu(self, module: _Module) -> _Module:
        """The module that acts in real environments: itself, or a copy if on another device."""
        return module if self.device.type == "cpu" else deepcopy(module).cpu()

    def make_learning(self, capacity: int) -> ModelLearning:
        """Data with the given capacity of real transitions, and fits of the model to them."""
        fit, label = self.config.fit, self.config.label
        terminations = self.outcomes.learns_terminations
        return ModelLearning(self.dynamics, fit, label, capacity, terminations)

    @abstractmethod
    def iterate(self) -> Iterator[IterationResult]:
        """Run the remaining outer iterations, reporting after each."""

    def prepare(self) -> None:  # noqa: B027, most algorithms need nothing
        """Read external data, and refuse unusable ones, before work starts."""

    @property
    @abstractmethod
    def policies(self) -> Mapping[str, TensorDictModuleBase]:
        """The policies that act in real environments, by the stage that they come from.

        In the order of their stages, and only those learned so far; the last one is the algorithm's
        result.
        """

    def rounds(self) -> Iterator[int]:
        """The remaining outer iterations, each with its own random streams and clock."""
        while self.iteration < self.config.outer_iterations:
            seed_streams(self.seed, "iteration", self.iteration)
            self._seconds = dict.fromkeys(self.facts.phases, 0.0)
            self._diverged = []
            yield (iteration := self.iteration)
            if self.iteration == iteration:
                raise RuntimeError("an outer iteration was not completed: call complete()")

    @contextmanager
    def phase(self, name: str, words: str = "") -> Iterator[None]:
        """Measure a phase of an outer iteration, and report that it has begun.

        Args:
            name: one of ``facts.phases``.
            words: description of the work; that of the phase by default.

        Raises:
            Diverged: if a policy returns non-finite actions, even with ``on_divergence=warn``.
        """
        self._phase = self.facts.phases[name].words
        self.on_phase(words or self._phase)
        start = perf_counter()
        try:
            yield
        except BadAction as error:
            settings = self.policy_settings
            raise Diverged(self.iteration, self._phase, str(error), settings, False) from error
        self._seconds[name] += perf_counter() - start

    def fit(self) -> dict[str, float]:
        """The phase in which the model is fitted to all real data; returns its metrics."""
        with self.phase("fit"):
            report = self.learning.fit(lambda epoch: self.on_phase(f"fit, epoch {epoch}"))
            self._check_finite(fit_metrics(report))
            self._check_weights("model", self.dynamics)
            self._check_predictions()
            self.acting_dynamics.load_state_dict(self.dynamics.state_dict())
            self._calibrate_filter()
            learned = self._fit_outcomes()
        return {**fit_metrics(report), **learned}

    def _fit_outcomes(self) -> dict[str, float]:
        """Fit learned rewards and terminations to the same data as the model."""
        if not self.outcomes.models:
            return {}
        self.on_phase(f"fit, {' and '.join(self.outcomes.models).replace('_model', '')}")
        metrics = self.outcomes.fit(self.learning.buffer, self.learning.action_key, self.iteration)
        self._check_finite(metrics)
        for name, model in self.outcomes.models.items():
            self._check_weights(name.replace("_", " "), model)
        return metrics

    def _calibrate_filter(self) -> None:
        """If a Kalman filter acts, calibrate it on the current errors of the model."""
        if self.l1 is None or not self.l1.needs_calibration:
            return
        residuals = self.acting_dynamics.residuals
        config = replace(
            self.l1, action_low=self.task.action_low, action_high=self.task.action_high
        )
        calibrate_filter(
            residuals,
            self.acting_dynamics.value_and_jacobian,
            self.learning.buffer[:],
            config,
            self.learning.action_key,
            self.acting_dynamics.residual_covariance,
        )
        self.dynamics.residuals.load_state_dict(residuals.state_dict())

    def diverged(self, what: str, setting: str) -> None:
        """Stop the training, or note the problem and continue, see ``stops_on_divergence``.

        Args:
            what: what has happened.
            setting: the setting that is the likely cause.

        Raises:
            Diverged: if the training stops.
        """
        error = Diverged(self.iteration, self._phase, what, setting)
        if self.stops_on_divergence:
            raise error
        # What a phase has noted is not repeated at the end of the iteration.
        if not any(f": {what}; " in str(noted) for noted in self._diverged):
            self._diverged.append(error)

    def _check_finite(self, metrics: Mapping[str, float]) -> None:
        for name, value in metrics.items():
            for beginning, setting in _FINITE.items():
                if name.startswith(beginning) and not math.isfinite(value):
                    self.diverged(f"{name} is {value}", setting)

    def _check_weights(self, name: str, module: nn.Module) -> None:
        if not all(bool(part.isfinite().all()) for part in module.parameters()):
            setting = self.policy_settings if name == "policy" else _FINITE["model/"]
            self.diverged(f"weights of the {name} are not finite", setting)

    def _check_predictions(self) -> None:
        """Weights may be finite but predictions not, while imagination moves along its bounds."""
        data = self.learning.buffer[:][:_PROBED].to(self.device)
        with torch.no_grad():
            action = data[self.learning.action_key]
            found = self.dynamics.mean_change(data["observation"], action)
        if not bool(found.isfinite().all()):
            self.diverged("predictions of the model are not finite", _FINITE["model/"])

    def check_plans(self, data: TensorDictBase) -> None:
        """Report divergence if a plan from a finite observation had no finite return.

        Args:
            data: data collected by a planner, see ``ModelPredictiveController``.
        """
        plan = data["next", "plan", "best_return"].squeeze(-1)
        lost = ~plan.isfinite() & data["observation"].isfinite().all(-1)
        if bool(lost.any()):
            self.diverged(
                f"every sequence of a plan has an infinite imagined return, in {int(lost.sum())} "
                f"of {lost.numel()} steps",
                "fit.learning_rate, the planner's horizon and model.std_floor",
            )

    def complete(self, real_steps: int, metrics: Mapping[str, float]) -> IterationResult:
        """End the outer iteration.

        Args:
            real_steps: total number so far.
            metrics: those of ``facts.metrics`` except the first two; runs and reports need
                ``return_mean`` and ``return_deterministic`` of every iteration.

        Raises:
            Diverged: if a metric that should be finite is not.
        """
        self._check_finite(metrics)
        head = {"iteration": self.iteration, "real_steps": real_steps}
        self.iteration += 1
        return IterationResult({**head, **metrics}, self._seconds, self._diverged)

    def choices(self) -> dict[str, str]:
        """The values that ``auto`` settings have taken on this machine."""
        fit = model_precision(self.dynamics, self.config.fit.precision)
        return {"device": str(self.device), "fit": fit}

    def weights(self) -> dict[str, dict[str, Any]]:
        """State dicts of what has been learned, by the names of their files."""
        return {"model": self.dynamics.state_dict(), **self.outcomes.weights()}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers.

        As in torch, they are references: use ``copy.deepcopy`` for a snapshot.
        """
        state = {"iteration": self.iteration, **self.learning.state_dict()}
        learned = self.outcomes.state_dict()
        return {**state, "outcomes": learned} if learned else state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.iteration = state["iteration"]
        self.learning.load_state_dict(state)
        self.outcomes.load_state_dict(state.get("outcomes", {}))
        self.acting_dynamics.load_state_dict(self.dynamics.state_dict())
