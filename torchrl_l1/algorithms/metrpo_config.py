"""Settings of METRPO."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from torchrl_l1.algorithms.config import LABELS, ModelConfig
from torchrl_l1.checks import (
    check_choice,
    check_counts,
    check_optional_count,
    check_positive,
    check_widths,
    check_within,
)
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.objectives import TRPOConfig
from torchrl_l1.planning import resolve_precision


@dataclass
class PolicyConfig:
    """The policy.

    Attributes:
        hidden: widths of the hidden layers.
        std: initial standard deviation, in action units.
        reset_std: whether to return to it at the start of each outer iteration.
        normalize: whether the network sees normalised observations; the statistics are those
            of all real data and are updated in each outer iteration.
    """

    hidden: list[int] = field(default_factory=lambda: [32, 32])
    std: float = 1.0
    reset_std: bool = True
    normalize: bool = False

    def __post_init__(self) -> None:
        check_widths("policy.hidden", self.hidden)
        check_positive("policy.std", self.std)


@dataclass
class METRPOConfig:
    """Settings of :class:`~torchrl_l1.algorithms.METRPO`.

    Attributes:
        outer_iterations: rounds of fit, policy improvement and collection.
        episodes_per_iteration: real episodes per round (and of random data before the first),
            run side by side. If episodes end early, others follow until each environment has
            taken as many steps as a full episode has.
        episode_steps: steps of a collected episode; the task's horizon if null. If early policies
            fail early, shorter episodes are more informative. If set, returns are measured on full
            episodes that do not join the data.
        evaluation_episodes: full episodes with the mean action after each round (and with
            sampled actions if those collected are shorter than the task's, or ended early).
        trpo_iterations: TRPO steps per round.
        imagined_steps: imagined transitions per TRPO step.
        imagined_horizon: length of an imagined trajectory.
        imagined_from_data: share of the imagined trajectories that start from states in the
            real data; the others start as the task does. Without it, later states are never
            imagined if the imagined horizon is shorter than the task's.
        imagined_termination: whether imagined trajectories end where the task's episodes do, with
            the recipe's ``termination=builtin``; any other ``termination`` decides by itself. In
            the published code they do not: a fallen walker continues on the ground.
        box_exit: value of an imagined trajectory after it leaves the box around the data: zero
            (``fail``, the paper's MDP), or the baseline's value of its last state inside
            (``truncate``).
        bootstrap: whether the baseline's estimate continues an imagined trajectory after its last
            step; the baseline then ignores time. If the imagined horizon is shorter than the
            task's, a policy whose imagined world ends there learns to risk everything in its last
            steps.
        discount: gamma.
        gae_lambda: lambda of the generalized advantage estimate.
        clip_actions: whether the policy's actions are clipped to their bounds before they act and
            are stored. In the authors' runs without L1 they probably were not; ``false`` is
            refused with L1.
        label: action that the model is fitted to: ``nominal`` is the policy's (the paper's
            choice), ``executed`` what L1 sends to the actuators.
        model: see :class:`ModelConfig`.
        policy: see :class:`PolicyConfig`.
        fit: see :class:`~torchrl_l1.dynamics.FitConfig`.
        trpo: see :class:`~torchrl_l1.objectives.TRPOConfig`.
        precision: precision of the hidden layers in imagination: ``float32``, ``bfloat16``, or
            ``auto`` for the faster one on this machine, see
            :func:`~torchrl_l1.planning.resolve_precision`. For fits there is ``fit.precision``.
    """

    outer_iterations: int = 33
    episodes_per_iteration: int = 6
    episode_steps: int | None = None
    evaluation_episodes: int = 6
    trpo_iterations: int = 20
    imagined_steps: int = 50_000
    imagined_horizon: int = 200
    imagined_from_data: float = 0.0
    imagined_termination: bool = False
    box_exit: str = "truncate"
    bootstrap: bool = False
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip_actions: bool = True
    label: str = "nominal"
    model: ModelConfig = field(default_factory=ModelConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    trpo: TRPOConfig = field(default_factory=TRPOConfig)
    precision: str = "float32"

    def __post_init__(self) -> None:
        check_improvement(self)
        check_optional_count("episode_steps", self.episode_steps)
        check_counts(self, "outer_iterations", "episodes_per_iteration", "evaluation_episodes")

    def collected_episodes(self, iterations: int) -> int:
        """Number of real episodes in so many outer iterations; random data do not count."""
        return iterations * self.episodes_per_iteration


class ImprovementConfig(Protocol):
    """Settings of the policy's improvement in imagination, see :class:`METRPOConfig`."""

    label: str
    trpo_iterations: int
    imagined_steps: int
    imagined_horizon: int
    imagined_from_data: float
    imagined_termination: bool
    box_exit: str
    bootstrap: bool
    discount: float
    gae_lambda: float
    trpo: TRPOConfig
    precision: str


def check_improvement(settings: ImprovementConfig) -> None:
    """Refuse settings with which no policy can be improved in imagination.

    Raises:
        ValueError: naming the setting.
    """
    resolve_precision(settings.precision)
    check_choice("label", settings.label, tuple(LABELS))
    check_choice("box_exit", settings.box_exit, ("truncate", "fail"))
    check_counts(settings, "trpo_iterations", "imagined_horizon", "imagined_steps")
    if not settings.imagined_steps >= settings.imagined_horizon:
        raise ValueError(
            f"imagined_steps ({settings.imagined_steps}) must hold at least one trajectory of "
            f"imagined_horizon ({settings.imagined_horizon}) steps"
        )
    for name in ("imagined_from_data", "discount", "gae_lambda"):
        check_within(name, getattr(settings, name), "[0, 1]")


def check_clipping(clip_actions: bool, with_l1: bool) -> None:
    """Refuse unclipped actions if L1 acts.

    Raises:
        ValueError: naming the remedy.
    """
    if with_l1 and not clip_actions:
        raise ValueError(
            "clip_actions=false is for runs without L1: the adaptive controller always keeps "
            "the action within its bounds (use l1=off)"
        )
