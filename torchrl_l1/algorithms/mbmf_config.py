"""Settings of MBMF."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchrl_l1.algorithms.config import LABELS, ModelConfig, check_planning
from torchrl_l1.algorithms.facts import Stage
from torchrl_l1.checks import (
    check_choice,
    check_counts,
    check_not_negative,
    check_optional_count,
    check_positive,
    check_widths,
    check_within,
)
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.planning import ShootingConfig

STAGES = (
    Stage("shooting", "random shooting", kinds=("stochastic",), is_planner=True),
    # Each of its rounds fits the policy again to all data so far.
    Stage("cloning", "cloning", window=1, kinds=("deterministic",), with_l1=False),
    Stage("fine_tuning", "fine-tuning", with_l1=False),
)
"""The stages in order."""

STAGE_NAMES = tuple(stage.name for stage in STAGES)


@dataclass
class ClonedPolicyConfig:
    """The policy that clones the planner and is then fine-tuned.

    Attributes:
        hidden: widths of the hidden layers.
    """

    hidden: list[int] = field(default_factory=lambda: [64, 64])

    def __post_init__(self) -> None:
        check_widths("policy.hidden", self.hidden)


@dataclass
class CloningConfig:
    """The second stage: a policy network learns to imitate the planner (DAgger).

    Attributes:
        iterations: rounds. The first clones the planner's own data; before each of the others the
            policy visits states, and the planner labels them with its actions.
        episodes: real episodes per round, except the first, side by side.
        std: standard deviation of the policy's actions there, in action units.
        label_states: whose states the planner labels: those of the ``current`` policy, or of the
            ``initial`` one with its random weights, as in the published code, whose collecting
            workers never receive what has been learned.
        learning_rate: Adam's step size.
        batch_size: states per gradient step.
        max_epochs: passes over the training data in a round.
        patience: epochs without a lower validation loss before a round stops.
        validation_fraction: share of the states permanently held out of training.
    """

    iterations: int = 4
    episodes: int = 1
    std: float = 0.005
    label_states: str = "current"
    learning_rate: float = 1e-3
    batch_size: int = 500
    max_epochs: int = 100
    patience: int = 20
    validation_fraction: float = 0.1

    def __post_init__(self) -> None:
        counts = ("iterations", "episodes", "batch_size", "max_epochs", "patience")
        check_counts(self, *counts, prefix="cloning.")
        check_positive("cloning.std", self.std)
        check_positive("cloning.learning_rate", self.learning_rate)
        check_choice("cloning.label_states", self.label_states, ("current", "initial"))
        check_within("cloning.validation_fraction", self.validation_fraction, "(0, 1)")


@dataclass
class FineTuningConfig:
    """The third stage: the cloned policy is improved by PPO on real data (arXiv 1707.06347).

    Attributes:
        episodes: real episodes per round, side by side. If episodes end early, others follow
            until each environment has taken as many steps as a full episode has.
        std: initial standard deviation of the actions, in action units.
        value_hidden: widths of the value network's hidden layers.
        learning_rate: Adam's step size for the policy.
        value_learning_rate: Adam's step size for the value network.
        anneal_steps: real steps of this stage over which both fall linearly to zero; constant if
            null.
        epochs: passes of the policy over a round's data.
        value_epochs: passes of the value network.
        minibatches: gradient steps per pass.
        clip_epsilon: bound on the change of the likelihood ratio in the objective.
        entropy_coefficient: weight of the entropy bonus.
        discount: gamma.
        gae_lambda: lambda of the generalized advantage estimate.
        max_gradient_norm: gradients are scaled down to this norm.
    """

    episodes: int = 4
    std: float = 0.5
    value_hidden: list[int] = field(default_factory=lambda: [64, 64])
    learning_rate: float = 3e-4
    value_learning_rate: float = 1e-3
    anneal_steps: int | None = None
    epochs: int = 10
    value_epochs: int = 10
    minibatches: int = 16
    clip_epsilon: float = 0.2
    entropy_coefficient: float = 0.0
    discount: float = 0.99
    gae_lambda: float = 0.95
    max_gradient_norm: float = 1.0

    def __post_init__(self) -> None:
        counts = ("episodes", "epochs", "value_epochs", "minibatches")
        check_counts(self, *counts, prefix="fine_tuning.")
        check_widths("fine_tuning.value_hidden", self.value_hidden)
        for name in ("std", "learning_rate", "value_learning_rate", "max_gradient_norm"):
            check_positive(f"fine_tuning.{name}", getattr(self, name))
        check_within("fine_tuning.clip_epsilon", self.clip_epsilon, "(0, 1)")
        check_optional_count("fine_tuning.anneal_steps", self.anneal_steps)
        check_not_negative("fine_tuning.entropy_coefficient", self.entropy_coefficient)
        for name in ("discount", "gae_lambda"):
            check_within(f"fine_tuning.{name}", getattr(self, name), "[0, 1]")


@dataclass
class MBMFConfig:
    """Settings of :class:`~torchrl_l1.algorithms.MBMF`.

    Attributes:
        outer_iterations: rounds of all stages together: ``shooting_iterations``, then
            ``cloning.iterations``, and fine-tuning in the remaining ones.
        shooting_iterations: rounds of model fit and random shooting.
        random_episodes: real episodes of random actions before the first round.
        random_steps: steps of each; those of a shooting episode if null. On a task that random
            actions fail at once, many short episodes are more informative than a long one.
        shooting_episodes: real episodes per round of shooting, side by side.
        episode_steps: steps of a collected episode, in all stages; the task's horizon if null.
            If set, returns are measured on full episodes that do not join the data.
        evaluation_episodes: full episodes with the mean action after each round of cloning and
            fine-tuning (and with sampled actions if those collected are shorter than the task's,
            or ended early).
        replan_every: actions taken from a plan before the next.
        plan_discount: discount of imagined rewards per step.
        action_bound: random and planned actions are drawn from an interval of this half-width
            around zero, within the task's own bounds; from all of these if null. The published code
            draws from [-1, 1], whatever the bounds.
        particles: imagined trajectories per candidate sequence; with ``mean`` there is one.
        propagation: how they travel through the ensemble: ``tsinf``, ``ts1`` or ``mean``, see
            :func:`~torchrl_l1.planning.evaluate`.
        precision: precision of the hidden layers in planning: ``float32``, ``bfloat16``, or
            ``auto`` for the one that the processor multiplies fastest.
        compile_plans: whether to compile the motion of the imagined trajectories, see
            :func:`~torchrl_l1.planning.resolve_compilation`.
        label: action that the model is fitted to: ``nominal`` is the planner's, ``executed`` what
            L1 sends to the actuators.
        policy: see :class:`ClonedPolicyConfig`.
        shooting: see :class:`~torchrl_l1.planning.ShootingConfig`.
        model: see :class:`ModelConfig`.
        fit: see :class:`~torchrl_l1.dynamics.FitConfig`.
        cloning: see :class:`CloningConfig`.
        fine_tuning: see :class:`FineTuningConfig`.
    """

    outer_iterations: int = 59
    shooting_iterations: int = 7
    random_episodes: int = 1
    random_steps: int | None = None
    shooting_episodes: int = 1
    episode_steps: int | None = None
    evaluation_episodes: int = 4
    replan_every: int = 1
    plan_discount: float = 1.0
    action_bound: float | None = None
    particles: int = 1
    propagation: str = "mean"
    precision: str = "auto"
    compile_plans: bool | str = "auto"
    label: str = "executed"
    policy: ClonedPolicyConfig = field(default_factory=ClonedPolicyConfig)
    shooting: ShootingConfig = field(
        default_factory=lambda: ShootingConfig(horizon=20, candidates=1000)
    )
    model: ModelConfig = field(default_factory=lambda: ModelConfig(members=1))
    fit: FitConfig = field(default_factory=FitConfig)
    cloning: CloningConfig = field(default_factory=CloningConfig)
    fine_tuning: FineTuningConfig = field(default_factory=FineTuningConfig)

    def __post_init__(self) -> None:
        check_choice("label", self.label, tuple(LABELS))
        check_counts(
            self,
            "outer_iterations",
            "shooting_iterations",
            "random_episodes",
            "shooting_episodes",
            "evaluation_episodes",
        )
        check_optional_count("episode_steps", self.episode_steps)
        check_optional_count("random_steps", self.random_steps)
        check_within("plan_discount", self.plan_discount, "(0, 1]")
        if self.action_bound is not None:
            check_positive("action_bound", self.action_bound)
        check_planning(self, "shooting", self.shooting.horizon)

    def collected_episodes(self, iterations: int) -> int:
        """Number of real episodes in so many outer iterations; random data do not count."""
        shot = min(iterations, self.shooting_iterations)
        cloned = min(iterations - shot, self.cloning.iterations)
        # The first round of cloning learns from data that are already collected.
        return (
            shot * self.shooting_episodes
            + max(cloned - 1, 0) * self.cloning.episodes
            + (iterations - shot - cloned) * self.fine_tuning.episodes
        )

    def stage(self, iteration: int) -> tuple[str, int]:
        """Stage of an outer iteration, and its number within it."""
        shooting, cloning, fine_tuning = STAGE_NAMES
        if iteration < self.shooting_iterations:
            return shooting, iteration
        iteration -= self.shooting_iterations
        if iteration < self.cloning.iterations:
            return cloning, iteration
        return fine_tuning, iteration - self.cloning.iterations

    def stages(self) -> tuple[str, ...]:
        """The stages that ``outer_iterations`` reaches."""
        last, _ = self.stage(self.outer_iterations - 1)
        return STAGE_NAMES[: STAGE_NAMES.index(last) + 1]
