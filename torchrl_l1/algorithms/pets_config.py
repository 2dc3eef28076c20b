"""Settings of PETS and DETS."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchrl_l1.algorithms.config import LABELS, ModelConfig, check_planning
from torchrl_l1.checks import (
    check_choice,
    check_counts,
    check_not_negative,
    check_optional_count,
)
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.planning import CEMConfig


@dataclass
class PETSConfig:
    """Settings of :class:`~torchrl_l1.algorithms.PETS`.

    With a Gaussian head and sampled trajectories the algorithm is PETS (arXiv 1805.12114); with a
    deterministic head it is DETS, as combined with L1 in arXiv 2403.14860.

    Attributes:
        outer_iterations: rounds of fit and collection.
        random_episodes: real episodes of random actions before the first round.
        random_steps: steps of each; those of a collected episode if null. On a task that random
            actions fail at once, many short episodes are more informative than a long one.
        episodes_per_iteration: real episodes per round, run side by side.
        episode_steps: steps of a collected episode; the task's horizon if null. If set, returns are
            measured on full episodes that do not join the data.
        evaluation_episodes: full episodes beside the data after each round; none by default,
            since they cost as much as those that join it.
        fit_every: rounds from one fit of the model to the next.
        replan_every: actions taken from a plan before the next.
        particles: imagined trajectories per candidate sequence.
        propagation: how they travel through the ensemble: ``tsinf``, ``ts1`` or ``mean``, see
            :func:`~torchrl_l1.planning.evaluate`.
        common_noise: whether the particles of all candidates share the same draws of members and
            noise in an iteration of the planner.
        precision: precision of the hidden layers in planning: ``float32``, ``bfloat16``, or
            ``auto`` for the one that the processor multiplies fastest.
        compile_plans: whether to compile the motion of the imagined trajectories: ``true``,
            ``false``, or ``auto`` for ``true`` on a GPU with a working compiler, see
            :func:`~torchrl_l1.planning.resolve_compilation`.
        label: action that the model is fitted to: ``nominal`` is the planner's, ``executed`` what
            L1 sends to the actuators.
        cem: see :class:`~torchrl_l1.planning.CEMConfig`.
        model: see :class:`ModelConfig`.
        fit: see :class:`~torchrl_l1.dynamics.FitConfig`.
    """

    outer_iterations: int = 20
    random_episodes: int = 1
    random_steps: int | None = None
    episodes_per_iteration: int = 1
    episode_steps: int | None = None
    evaluation_episodes: int = 0
    fit_every: int = 1
    replan_every: int = 1
    particles: int = 20
    propagation: str = "tsinf"
    common_noise: bool = True
    precision: str = "auto"
    compile_plans: bool | str = "auto"
    label: str = "executed"
    cem: CEMConfig = field(default_factory=CEMConfig)
    model: ModelConfig = field(default_factory=lambda: ModelConfig(head="gaussian"))
    fit: FitConfig = field(default_factory=FitConfig)

    def __post_init__(self) -> None:
        check_choice("label", self.label, tuple(LABELS))
        counts = ("outer_iterations", "random_episodes", "episodes_per_iteration", "fit_every")
        check_counts(self, *counts)
        check_not_negative("evaluation_episodes", self.evaluation_episodes)
        check_optional_count("episode_steps", self.episode_steps)
        check_optional_count("random_steps", self.random_steps)
        check_planning(self, "cem", self.cem.horizon)

    def collected_episodes(self, iterations: int) -> int:
        """Number of real episodes in so many outer iterations; random data do not count."""
        return iterations * self.episodes_per_iteration
