"""Facts about an algorithm without running it: its stages, phases, ways to act and metrics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

KINDS = ("stochastic", "deterministic")
"""The ways to act: with sampled actions, and with mean actions."""

MEASURING = "evaluate"
"""The phase that only measures returns and is not part of the training."""

WINDOW = 3
"""Final outer iterations over which a training's return is averaged, as in the paper."""

_WORDS = {"stochastic": "sampled actions", "deterministic": "mean action"}


@dataclass(frozen=True)
class Stage:
    """A stage of an algorithm.

    Attributes:
        name: its name as users type it; also that of what acts in it.
        words: its name in headings.
        window: final outer iterations over which its return is averaged.
        kinds: ways to act whose returns a run logs in it.
        is_planner: whether a planner acts in it, whose sampled and mean actions are the same.
        with_l1: whether L1 augments the actions in it, if it is on.
    """

    name: str
    words: str = ""
    window: int = WINDOW
    kinds: tuple[str, ...] = KINDS
    is_planner: bool = False
    with_l1: bool = True


@dataclass(frozen=True)
class Phase:
    """A phase of an outer iteration.

    Attributes:
        words: text of its progress bar.
        heading: heading of its column in a report's table of times; without a column if empty.
    """

    words: str
    heading: str = ""


@dataclass(frozen=True)
class Variant:
    """A form of an algorithm that reports show as a separate algorithm.

    Attributes:
        name: its name in headings and tables.
        color: colour of its lines in comparisons of algorithms.
        settings: values of the dotted keys that identify its runs.
    """

    name: str
    color: str
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class AlgorithmFacts:
    """What runs, evaluations and reports know about an algorithm.

    Attributes:
        name: its name in headings and tables.
        stages: its stages in order; if there are several, ``stage`` in the metrics counts from 1.
        phases: columns of ``timing.csv``, in the order of an outer iteration.
        metrics: columns of ``metrics.csv`` with their meaning; ``l1/...`` only with L1 on.
        color: colour of its lines in comparisons of algorithms.
        tables: numbers of the paper's tables on it: for the returns of the ``training``, and for
            the evaluations ``sim_to_real`` and ``ablation``.
        compares_models: whether the paper compares forms of the model with it (Figure 2).
        reference_logs: whether the authors have released logs of it.
        offline: whether real steps stay the same from one outer iteration to the next.
        variants: its forms that count as separate algorithms, by name.
    """

    name: str
    stages: tuple[Stage, ...]
    phases: Mapping[str, Phase]
    metrics: Mapping[str, str]
    color: str
    tables: Mapping[str, str] = field(default_factory=dict)
    compares_models: bool = False
    reference_logs: bool = False
    offline: bool = False
    variants: Mapping[str, Variant] = field(default_factory=dict)

    @property
    def stage_names(self) -> tuple[str, ...]:
        """The names of the stages in order."""
        return tuple(stage.name for stage in self.stages)

    @property
    def named_stages(self) -> tuple[Stage, ...]:
        """The stages that metrics and evaluations name: none if there is only one."""
        return self.stages if len(self.stages) > 1 else ()

    @property
    def samples(self) -> bool:
        """Whether sampled and mean actions differ, at least in the last stage."""
        return not self.stages[-1].is_planner

    @property
    def kinds(self) -> Mapping[str, str]:
        """The ways to act whose returns differ, and their words; one without words if only one."""
        return _WORDS if self.samples else {KINDS[0]: ""}

    @property
    def l1_words(self) -> str:
        """The stages in which L1 augments the actions, in words."""
        return " and ".join(stage.words for stage in self.stages if stage.with_l1)

    @property
    def timed_phases(self) -> Mapping[str, str]:
        """The phases in a report's table of times, with the headings of their columns."""
        return {name: phase.heading for name, phase in self.phases.items() if phase.heading}

    @property
    def mean_action_stages(self) -> tuple[int, ...]:
        """Positions of the stages in which a run logs the returns of both ways to act."""
        return tuple(i for i, stage in enumerate(self.stages) if len(stage.kinds) > 1)

    def of_variant(self, name: str) -> AlgorithmFacts:
        """The facts of a variant: everything else is as for the algorithm."""
        variant = self.variants[name]
        return replace(self, name=variant.name, color=variant.color, variants={})

    def acts_in_one_way(self, stage: str = "") -> bool:
        """Whether sampled and mean actions are the same in a stage; any name is accepted."""
        return not self.samples or any(one.is_planner for one in self.stages if one.name == stage)

    def position(self, stage: str) -> int:
        """Position of a stage, from 0; -1 for any other name."""
        return next((i for i, one in enumerate(self.stages) if one.name == stage), -1)

    def actions(self, policy: str, stage: str = "") -> str:
        """How a kind of policy acts, in words; empty if there is no choice."""
        return "" if self.acts_in_one_way(stage) else _WORDS[policy]

    def acting(self, policy: str, stage: str = "") -> str:
        """What acts, in words: the stage's words, and how it acts if there is a choice."""
        words = [one.words for one in self.stages if one.name == stage]
        return ", ".join(filter(None, [*words, self.actions(policy, stage)]))
