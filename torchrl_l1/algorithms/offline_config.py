"""Settings of offline learning: data, penalty, and the policy's improvement in imagination."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchrl_l1.algorithms.config import ModelConfig
from torchrl_l1.algorithms.metrpo_config import PolicyConfig, check_improvement
from torchrl_l1.checks import (
    check_choice,
    check_counts,
    check_not_negative,
    check_positive,
    check_within,
)
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.objectives import TRPOConfig

PENALTIES = ("mopo", "morel", "none")
"""Penalties for the model's uncertainty, see :class:`OfflineConfig`."""

MEASURES = ("auto", "deviation", "disagreement")
"""Measures of the model's uncertainty, see :class:`OfflineConfig`."""


@dataclass
class DatasetColumns:
    """Names of the contents of a dataset; empty lists and null for the usual ones.

    Attributes:
        observation: columns of a CSV file, arrays of an NPZ file, or the key of tensordicts and
            Minari's dictionaries; ``observation`` if empty, except for CSV files, which need it.
        action: likewise; ``action`` if empty.
        episode: column or array that numbers the episodes of a CSV or NPZ file; that of NPZ files
            is ``episode``, if there is one.
        time: column or array of the time there, in seconds.
    """

    observation: list[str] = field(default_factory=list)
    action: list[str] = field(default_factory=list)
    episode: str | None = None
    time: str | None = None


@dataclass
class OfflineCloningConfig:
    """The fit of the first policy to the actions in the data.

    Attributes:
        enabled: whether to clone; otherwise the first policy is random.
        learning_rate: Adam's step size.
        batch_size: states per gradient step.
        max_epochs: passes over the data.
        patience: epochs without a lower validation loss before it stops.
        validation_fraction: share of the states held out of training.
    """

    enabled: bool = True
    learning_rate: float = 1e-3
    batch_size: int = 500
    max_epochs: int = 30
    patience: int = 5
    validation_fraction: float = 0.1

    def __post_init__(self) -> None:
        check_counts(self, "batch_size", "max_epochs", "patience", prefix="cloning.")
        check_positive("cloning.learning_rate", self.learning_rate)
        check_within("cloning.validation_fraction", self.validation_fraction, "(0, 1)")


@dataclass
class OfflineConfig:
    """Settings of :class:`~torchrl_l1.algorithms.Offline`.

    Attributes:
        outer_iterations: rounds of policy improvement, each followed by a measurement.
        dataset: source of the data: a Minari dataset's name or folder, a run directory, a folder
            of a memory-mapped tensordict, or a file: ``.pt``, ``.safetensors``, ``.npz``, ``.csv``.
        columns: see :class:`DatasetColumns`.
        label: action to use from a run directory's data: ``nominal`` is the policy's,
            ``executed`` what L1 sent to the actuators. Other sources have one action.
        penalty: ``mopo`` subtracts ``penalty_coefficient`` times the uncertainty from the reward
            (arXiv 2005.13239); ``morel`` ends an imagined trajectory where the uncertainty is
            above a threshold, in a state that is worth ``penalty_coefficient`` less per step than
            the worst in the data (arXiv 2005.05951); ``none`` trusts the model.
        penalty_coefficient: see ``penalty``, in reward units.
        uncertainty: ``deviation``, the largest norm of the standard deviations that a member with
            a Gaussian head predicts; ``disagreement``, the largest distance between the means of
            two members; ``auto``, the former if there are such heads. In units of the standard
            deviation of an entry's one-step changes in the data.
        halt_deviations: the threshold is this many standard deviations above the mean uncertainty
            of the data.
        evaluation_episodes: real episodes after each round with the mean action, and as many with
            sampled actions. Nothing is learned from them.
        trpo_iterations: TRPO steps per round.
        imagined_steps: imagined transitions per TRPO step.
        imagined_horizon: length of an imagined trajectory.
        imagined_from_data: share of the imagined trajectories that start in the data; the others
            start as the task does.
        imagined_termination: whether imagined trajectories end where the task's episodes do.
        box_exit: value of an imagined trajectory that leaves the box around the data, see
            :class:`~torchrl_l1.algorithms.METRPOConfig`. With ``morel`` it is halted there.
        bootstrap: whether the baseline's estimate continues an imagined trajectory, likewise.
        discount: gamma.
        gae_lambda: lambda of the generalized advantage estimate.
        model: see :class:`ModelConfig`.
        policy: see :class:`PolicyConfig`. With ``normalize``, which is on here, the statistics are
            those of the states that cloning trains on, or of all data without cloning, and do not
            change.
        fit: see :class:`~torchrl_l1.dynamics.FitConfig`. There is only one fit.
        cloning: see :class:`OfflineCloningConfig`.
        trpo: see :class:`~torchrl_l1.objectives.TRPOConfig`.
        precision: precision of the hidden layers in imagination: ``float32``, ``bfloat16``, or
            ``auto``.
    """

    outer_iterations: int = 10
    dataset: str = ""
    columns: DatasetColumns = field(default_factory=DatasetColumns)
    label: str = "executed"
    penalty: str = "mopo"
    penalty_coefficient: float = 1.0
    uncertainty: str = "auto"
    halt_deviations: float = 5.0
    evaluation_episodes: int = 6
    trpo_iterations: int = 20
    imagined_steps: int = 20_000
    imagined_horizon: int = 50
    imagined_from_data: float = 1.0
    imagined_termination: bool = True
    box_exit: str = "truncate"
    bootstrap: bool = True
    discount: float = 0.99
    gae_lambda: float = 0.95
    model: ModelConfig = field(default_factory=ModelConfig)
    policy: PolicyConfig = field(default_factory=lambda: PolicyConfig(normalize=True))
    fit: FitConfig = field(default_factory=FitConfig)
    cloning: OfflineCloningConfig = field(default_factory=OfflineCloningConfig)
    trpo: TRPOConfig = field(default_factory=TRPOConfig)
    precision: str = "float32"

    def __post_init__(self) -> None:
        check_improvement(self)
        check_choice("penalty", self.penalty, PENALTIES)
        check_choice("uncertainty", self.uncertainty, MEASURES)
        check_not_negative("penalty_coefficient", self.penalty_coefficient)
        check_not_negative("halt_deviations", self.halt_deviations)
        check_counts(self, "outer_iterations", "evaluation_episodes")
        if self.uncertainty == "deviation" and self.model.head != "gaussian":
            raise ValueError(
                "uncertainty=deviation needs members that predict a distribution: set "
                "model.head=gaussian, or uncertainty=disagreement"
            )
        # Only elites are used.
        counts = {"model.members": self.model.members, "fit.elites": self.fit.elites or 2}
        for name, count in counts.items():
            if self.penalty != "none" and self.measure == "disagreement" and count < 2:
                raise ValueError(
                    f"penalty={self.penalty} by disagreement needs two members or more, "
                    f"{name} is {count}"
                )
        if self.penalty == "morel" and self.bootstrap and self.discount == 1:
            raise ValueError(
                "penalty=morel with bootstrap=true needs a discount below 1: a halted trajectory "
                "would be worth minus infinity"
            )

    @property
    def episode_steps(self) -> None:
        """None, since measured episodes are full ones."""
        return None

    @property
    def measure(self) -> str:
        """The resolved ``uncertainty``: ``deviation`` or ``disagreement``."""
        if self.uncertainty != "auto":
            return self.uncertainty
        return "deviation" if self.model.head == "gaussian" else "disagreement"

    def collected_episodes(self, iterations: int) -> int:
        """Number of real episodes in so many outer iterations: the measured ones."""
        return iterations * self.evaluation_episodes
