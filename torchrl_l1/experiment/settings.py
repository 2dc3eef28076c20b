"""Settings of every recipe, and the typed schemas behind the YAML files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache, partial
from typing import Any, ClassVar

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from torchrl_l1.algorithms import (
    MBMF,
    METRPO,
    PETS,
    Algorithm,
    MBMFConfig,
    METRPOConfig,
    Offline,
    OfflineConfig,
    OutcomeConfig,
    Perturbation,
    PETSConfig,
)
from torchrl_l1.algorithms.algorithm import DEVICES
from torchrl_l1.algorithms.metrpo_config import check_clipping
from torchrl_l1.algorithms.outcomes import check_outcome
from torchrl_l1.checks import check_choice, check_count, check_optional_count, check_positive
from torchrl_l1.compilation import check_mode
from torchrl_l1.control import L1Config
from torchrl_l1.envs import AnyTask, get_task
from torchrl_l1.experiment.checkpoints import CheckpointSettings
from torchrl_l1.experiment.datasets import read_dataset
from torchrl_l1.experiment.files import bounded_overrides, path_text


@dataclass
class L1Settings:
    """The adaptive controller of a recipe: the settings of :class:`L1Config`, and two more.

    Attributes:
        enabled: whether L1 acts during collection.
        epsilon: tolerance of the switching law, in raw state units.
        alpha: smoothing factor of the low-pass filter per step; or give ``cutoff``.
        cutoff: cutoff frequency of the low-pass filter, rad/s.
        a_s: diagonal of the predictor's Hurwitz matrix, 1/s.
        on_switch: ``keep`` or ``reset`` predictor and filter at a switch.
        switch_on: the switching law looks at the ``policy`` action or the ``executed`` input.
        filter_input: the filter takes the ``current`` or the ``previous`` estimate.
        project: clip the estimate that enters the filter to the range of the action.
        estimator: ``least_squares``, or ``weighted`` by the covariance of the residuals.
        filter: ``low_pass``, or ``kalman``, which needs no ``alpha`` or ``cutoff``.
        covariance: source of the covariance: ``residuals``, ``heads``, ``disagreement`` or ``sum``.
        dead_zone: posterior standard deviations within which the Kalman filter does nothing.
        process_noise: change of the disturbance per step that the Kalman filter expects, as a
            fraction of half the action range; if null, the model's calibrated value, or else 0.01.
        inflation: factor on the covariance; if null, the model's calibrated value, or else 1.
        initial_deviation: standard deviation of the disturbance at a reset, in the same units.
        forgetting: factor per step of the running estimate of each state's noise; 1 for none.
        skill_forgetting: factor per step of the record of what its forecasts have gained, by which
            the input is scaled; 1 for none.
        compile: compile the controller's step: ``true``, ``false``, or ``auto`` if a compiler
            works. Compiling takes some tens of seconds and pays off in long collections.
    """

    enabled: bool = False
    epsilon: float = 1.0
    alpha: float | None = None
    cutoff: float | None = None
    a_s: float = -1.0
    on_switch: str = "keep"
    switch_on: str = "executed"
    filter_input: str = "previous"
    project: bool = True
    estimator: str = "least_squares"
    filter: str = "low_pass"
    covariance: str = "residuals"
    dead_zone: float = 2.0
    process_noise: float | None = None
    inflation: float | None = None
    initial_deviation: float = 0.3
    forgetting: float = 0.97
    skill_forgetting: float = 1.0
    compile: bool | str = False


# The settings of L1Settings that are not in L1Config.
_BESIDE_L1_CONFIG = ("enabled", "compile")

# A time step in seconds that is short enough for any rate.
_SHORT_STEP = 1e-12


@dataclass
class WandbSettings:
    """Logging to Weights & Biases.

    Attributes:
        mode: ``auto`` (online when logged in, else offline), ``online``, ``offline``,
            ``disabled``.
        project: name of the project.
        entity: user or team; W&B's default if null.
        group: group of the run.
        name: name of the run; if null, the recipe, its overrides and the seed.
        tags: tags to find it by.
        notes: a longer text.
    """

    mode: str = "auto"
    project: str = "torchrl_l1"
    entity: str | None = None
    group: str | None = None
    name: str | None = None
    tags: list[str] = field(default_factory=list)
    notes: str | None = None


@dataclass
class RunSettings(ABC):
    """Settings of every recipe; subclasses add those of their algorithm.

    Attributes:
        algorithm: the algorithm's name, fixed by the recipe's schema.
        outer_iterations: rounds of the algorithm.
        recipe: the recipe's name, as given on the command line.
        task: a task of :data:`torchrl_l1.envs.TASKS`, or any environment by name, see
            :func:`torchrl_l1.envs.environment_source`.
        dt: seconds per step, if an external environment does not tell.
        observation_keys: parts of the observation, if an environment's comes in parts.
        search_path: folders for files and modules that the recipe names; set when it is composed.
        seed: seed of every random stream.
        run_dir: folder for the run's files; a long list of overrides is shortened in its name.
        resume: continue the run in ``run_dir`` from its last checkpoint.
        threads: CPU threads of torch.
        device: ``cpu``, ``cuda`` or ``auto`` (CUDA if available).
        horizon: steps per real episode; the task's own if null.
        reward: reward of imagined trajectories: ``builtin``, the task's own; ``learned``, by a
            model that is fitted with the dynamics; or ``MODULE:FUNCTION`` or ``FILE.py:FUNCTION``.
        termination: termination of imagined trajectories, likewise, or ``none``. If it is
            ``builtin``, METRPO follows ``imagined_termination``.
        outcome_model: see :class:`~torchrl_l1.algorithms.OutcomeConfig`.
        on_divergence: ``stop`` or ``warn`` when losses, weights or plans are no longer finite.
        loggers: any of ``wandb`` and ``tensorboard``; none if empty.
        l1: see :class:`L1Settings`.
        perturbation: noise and disturbances of the real environment.
        wandb: see :class:`WandbSettings`.
        checkpoint: see :class:`CheckpointSettings`.
    """

    algorithm: str = MISSING
    outer_iterations: int = MISSING
    recipe: str = MISSING
    task: str = MISSING
    dt: float | None = None
    observation_keys: list[str] = field(default_factory=list)
    search_path: list[str] = field(default_factory=list)
    seed: int = 0
    run_dir: str = "runs/${recipe}/${bounded:${hydra:job.override_dirname}}/seed_${seed}"
    resume: bool = False
    threads: int = 1
    device: str = "cpu"
    horizon: int | None = None
    reward: str = "builtin"
    termination: str = "builtin"
    outcome_model: OutcomeConfig = field(default_factory=OutcomeConfig)
    on_divergence: str = "stop"
    loggers: list[str] = field(default_factory=lambda: ["wandb"])
    l1: L1Settings = field(default_factory=L1Settings)
    perturbation: Perturbation = field(default_factory=Perturbation)
    wandb: WandbSettings = field(default_factory=WandbSettings)
    checkpoint: CheckpointSettings = field(default_factory=CheckpointSettings)

    builds: ClassVar[type[Algorithm]]

    def check(self) -> None:
        """Refuse settings that would only fail later, including the algorithm's own.

        The presence of a CUDA device is not checked here: a run trained on one may be read
        anywhere.

        Raises:
            ValueError: naming the setting.
        """
        self.builds.config_class.__post_init__(self)
        fixed = type(self).algorithm
        if self.algorithm != fixed:
            raise ValueError(
                f"algorithm is {fixed!r} by the recipe's schema, got {self.algorithm!r}; choose "
                f"a recipe of {self.algorithm} instead"
            )
        check_choice("device", self.device, DEVICES)
        check_count("threads", self.threads)
        check_optional_count("horizon", self.horizon)
        if self.dt is not None:
            check_positive("dt", self.dt)
        check_choice("on_divergence", self.on_divergence, ("stop", "warn"))
        check_optional_count("checkpoint.every", self.checkpoint.every)
        check_outcome("reward", self.reward)
        check_outcome("termination", self.termination)

    @abstractmethod
    def collected_episodes(self, iterations: int) -> int:
        """Number of real episodes in so many outer iterations; random data do not count."""

    def stages(self) -> tuple[str, ...]:
        """Names of the stages that ``outer_iterations`` reaches."""
        return self.builds.facts.stage_names

    def real_task(self) -> AnyTask:
        """The task of the recipe.

        Raises:
            KeyError: if there is no task of that name.
            ValueError: for an unsuitable environment, or one that does not tell what is needed.
        """
        return get_task(
            self.task,
            dt=self.dt,
            horizon=self.horizon,
            observation_keys=self.observation_keys,
            search_path=self.search_path,
        )

    def build(self) -> Algorithm:
        """A fresh instance of the algorithm that the recipe describes.

        Raises:
            ValueError: if settings contradict each other.
        """
        config, task = self.builds.config_class, self.real_task()
        algorithm = self.builds(
            task,
            config(**{part.name: getattr(self, part.name) for part in fields(config)}),
            l1_config(self.l1, task),
            perturbation=self.perturbation,
            seed=self.seed,
            horizon=self.horizon,
            device=self.device,
            compile_l1=check_mode(self.l1.compile, "l1.compile"),
            reward=self.reward,
            termination=self.termination,
            outcome_model=self.outcome_model,
            search_path=self.search_path,
        )
        algorithm.stops_on_divergence = self.on_divergence == "stop"
        return algorithm

    def build_on_cpu(self) -> Algorithm:
        """As :meth:`build`, for reading a run on any machine: on the CPU and not compiled."""
        here: dict[str, Any] = {"device": "cpu"}
        if hasattr(self, "compile_plans"):
            here["compile_plans"] = False  # as "auto" decides on the CPU
        return replace(self, **here).build()


# Not in ``register``: launchers resolve them in separate processes.
OmegaConf.register_new_resolver("bounded", bounded_overrides, replace=True)
OmegaConf.register_new_resolver("path_text", path_text, replace=True)

# Keys that may differ between a run and its continuation: they do not affect the result.
VOLATILE_KEYS = (
    *("run_dir", "resume", "wandb", "on_divergence", "loggers", "checkpoint", "search_path"),
)

NAMING_KEYS = ("task", "reward", "termination")
"""Keys that may name the user's code, which is found by the search path."""


def flatten(node: Any, prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted key.

    Examples:
        >>> flatten({"l1": {"alpha": 0.1}, "seed": 3})
        {'l1.alpha': 0.1, 'seed': 3}
    """
    if not isinstance(node, Mapping):
        return {prefix: node}
    flat: dict[str, Any] = {}
    for key, value in node.items():
        flat.update(flatten(value, f"{prefix}.{key}" if prefix else str(key)))
    return flat


def check_known(config: DictConfig) -> None:
    """Make sure that a composed recipe has a schema and no key that is not in it.

    Hydra lets ``+key=value`` add one, which would be ignored.

    Raises:
        ValueError: naming the key.
    """
    kind = OmegaConf.get_type(config)
    if not (isinstance(kind, type) and issubclass(kind, RunSettings)):
        raise ValueError(
            "the recipe has no schema; put that of its algorithm, such as metrpo_recipe, first in "
            "its defaults"
        )
    known: list[str] = []
    for key in _unknown(config, "", known):
        close = get_close_matches(key, known, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        raise ValueError(f"there is no key {key!r}, and + cannot add one{hint}")


def _unknown(node: DictConfig, prefix: str, known: list[str]) -> list[str]:
    kind = OmegaConf.get_type(node)
    named = {part.name for part in fields(kind)} if is_dataclass(kind) else None
    found = []
    known += [prefix + name for name in named or ()]
    for key in map(str, node):
        if named is not None and key not in named and not (key == "hydra" and not prefix):
            found.append(f"{prefix}{key}")
        elif isinstance(part := node._get_node(key), DictConfig) and key != "hydra":
            found += _unknown(part, f"{prefix}{key}.", known)
    return found


def l1_config(settings: L1Settings, task: str | AnyTask) -> L1Config | None:
    """The controller that a recipe asks for on a task; ``None`` if it is off.

    Raises:
        ValueError: for settings that contradict each other, see :class:`L1Config`; if the
            controller is off, only for those that do so at any time step.
    """
    own = {name: value for name, value in vars(settings).items() if name not in _BESIDE_L1_CONFIG}
    if not settings.enabled:
        # The filter is not known while L1 is off: settings of another filter are no contradiction.
        of_kalman = {name: own.pop(name) for name in ("process_noise", "inflation")}
        L1Config(_SHORT_STEP, **own)
        L1Config.robust(_SHORT_STEP, **of_kalman)
        return None
    task = get_task(task)
    return L1Config(task.dt, **own, action_low=task.action_low, action_high=task.action_high)


# The algorithm's settings come first: they set the number of outer iterations.
@dataclass
class METRPORecipe(METRPOConfig, RunSettings):
    """A METRPO recipe: run settings and the algorithm's own, side by side.

    Attributes:
        published_horizon: imagined horizon of the published runs, for ``preset=paper``.
    """

    algorithm: str = "metrpo"
    published_horizon: int = 1000
    builds: ClassVar[type[Algorithm]] = METRPO

    def __post_init__(self) -> None:
        self.check()
        check_clipping(self.clip_actions, self.l1.enabled)
        check_count("published_horizon", self.published_horizon)


@dataclass
class PETSRecipe(PETSConfig, RunSettings):
    """A recipe of PETS or DETS: run settings and the algorithm's own, side by side.

    The two differ in what a member of the ensemble predicts: a distribution, or a point.
    """

    algorithm: str = "pets"
    builds: ClassVar[type[Algorithm]] = PETS

    def __post_init__(self) -> None:
        self.check()


@dataclass
class MBMFRecipe(MBMFConfig, RunSettings):
    """An MBMF recipe: run settings and the algorithm's own, side by side."""

    algorithm: str = "mbmf"
    builds: ClassVar[type[Algorithm]] = MBMF

    def __post_init__(self) -> None:
        self.check()


@dataclass
class OfflineRecipe(OfflineConfig, RunSettings):
    """A recipe of offline learning: run settings and the algorithm's own, side by side."""

    algorithm: str = "offline"
    builds: ClassVar[type[Algorithm]] = Offline

    def __post_init__(self) -> None:
        self.check()

    def build(self) -> Algorithm:
        """The algorithm, which reads the dataset only when it starts: evaluations need none."""
        algorithm = super().build()
        assert isinstance(algorithm, Offline)
        algorithm.data = partial(read_dataset, self.dataset, self.columns)
        return algorithm


SCHEMAS: dict[str, type[RunSettings]] = {
    "metrpo": METRPORecipe,
    "pets": PETSRecipe,
    "mbmf": MBMFRecipe,
    "offline": OfflineRecipe,
}
"""Schema of the recipes of each algorithm. In a recipe's defaults it is ``<name>_recipe``."""


@cache
def register() -> None:
    """Make the schemas known to Hydra."""
    for name, schema in SCHEMAS.items():
        ConfigStore.instance().store(name=f"{name}_recipe", node=schema)


def schema_of(config: Mapping[str, Any]) -> type[RunSettings]:
    """The schema of a stored configuration; METRPO's if it is too old to name an algorithm.

    Raises:
        ValueError: for an unknown algorithm.
    """
    name = str(config.get("algorithm", "metrpo"))
    if name not in SCHEMAS:
        raise ValueError(f"unknown algorithm {name!r}; there are {', '.join(SCHEMAS)}")
    return SCHEMAS[name]


def schema_defaults(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Defaults of a configuration's schema by dotted key."""
    return _defaults(schema_of(config).algorithm)


@cache
def _defaults(algorithm: str) -> Mapping[str, Any]:
    node = OmegaConf.to_container(OmegaConf.structured(SCHEMAS[algorithm]))
    return {key: value for key, value in flatten(node).items() if value != MISSING}
