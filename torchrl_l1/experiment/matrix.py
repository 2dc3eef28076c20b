"""What an evaluation varies: the source of options, keys of campaign files and table columns.

The fields of :class:`Condition` are the single description; :func:`axes` lists them together with
the disturbances of :class:`~torchrl_l1.envs.Perturbation`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from typing import Any

from torchrl_l1.algorithms.collection import ORACLE
from torchrl_l1.algorithms.facts import KINDS
from torchrl_l1.envs import DISTURBANCES, SUITES, suite
from torchrl_l1.experiment.l1_options import OFF, check_tuning, controller_label, is_tuned
from torchrl_l1.experiment.settings import SCHEMAS

_STAGES = [stage.name for one in SCHEMAS.values() for stage in one.builds.facts.named_stages]

SUITE_L1 = (OFF, "paper", "robust", ORACLE)
"""Options of ``l1`` that a suite is tested with by default."""

# Key of the metadata of a field.
_AXIS = "axis"
_DISTURBANCES = "disturbances"


@dataclass(frozen=True)
class Axis:
    """One of the things that an evaluation varies.

    Attributes:
        name: name of the option, of the key in campaign files, and of the column.
        kind: type of its values, ``str`` or ``float``.
        values: values tested by default; empty if the run has its own.
        help: what the values are, in words.
        choices: the only values allowed; empty if any may be tried.
        tunes: whether they are values of the controller, whose name then includes them.
    """

    name: str
    kind: type[str] | type[float]
    values: tuple[Any, ...]
    help: str
    choices: tuple[str, ...] = ()
    tunes: bool = False


def _axis(
    kind: type[str] | type[float],
    help: str,
    values: Iterable[Any] = (),
    choices: tuple[str, ...] = (),
    *,
    tunes: bool = False,
    **default: Any,
) -> Any:
    axis = {"kind": kind, "help": help, "values": tuple(values), "choices": choices, "tunes": tunes}
    return field(metadata={_AXIS: axis}, **default)


@dataclass(frozen=True)
class Condition:
    """One cell: controller, noise, disturbances, and the policy and how it acts.

    Attributes:
        l1: option of the ``l1`` group, or ``oracle``.
        noise: option of the ``noise`` group.
        disturbances: value of each of :data:`~torchrl_l1.envs.DISTURBANCES`, by name; neutral if
            not given.
        policy: ``stochastic`` or ``deterministic``.
        epsilon: tolerance of the switching law, in raw state units; the run's own if ``None``.
        alpha: gain of the filter per step; that of the option (or of the run's own controller)
            if ``None``.
        stage: the stage whose policy is tested, see :attr:`Algorithm.policies
            <torchrl_l1.algorithms.algorithm.Algorithm.policies>`; the last one if ``None``.

    Raises:
        ValueError: for an unknown disturbance.

    Examples:
        >>> columns = Condition("paper", disturbances={"bias": 0.5}, epsilon=0.3).columns()
        >>> [columns[name] for name in ("l1", "noise", "bias", "gain", "epsilon", "alpha")]
        ['paper', 'none', 0.5, 1.0, 0.3, None]
    """

    l1: str = _axis(
        str,
        f"settings of the l1 group, or {ORACLE}, which is told the matched disturbances",
        (OFF, "paper"),
    )
    noise: str = _axis(str, "settings of the noise group", ("none",), default="none")
    disturbances: Mapping[str, float] = field(default_factory=dict, hash=False)
    policy: str = _axis(
        str,
        "sampled or mean actions; both by default, or only sampled ones if they are the same",
        KINDS,
        choices=KINDS,
        default=KINDS[0],
    )
    epsilon: float | None = _axis(
        float, "tolerances of the switching law; the run's own by default", tunes=True, default=None
    )
    alpha: float | None = _axis(
        float,
        "gains of the filter per step; the controller's own by default",
        tunes=True,
        default=None,
    )
    stage: str | None = _axis(
        str,
        "stages whose policies are tested, for algorithms with several "
        f"({', '.join(_STAGES)}); "
        "the last one by default",
        default=None,
    )

    def __post_init__(self) -> None:
        _check_names(self.disturbances, DISTURBANCES, "disturbance")
        complete = {
            name: self.disturbances.get(name, entry.neutral) for name, entry in DISTURBANCES.items()
        }
        object.__setattr__(self, _DISTURBANCES, complete)

    @property
    def controller(self) -> str:
        """Name of the controller in tables and figures, see :func:`controller_label`."""
        return controller_label(self.l1, **self.tuning)

    @property
    def tuning(self) -> dict[str, float | None]:
        """The controller values that it sets, by the names of :data:`TUNING`; else ``None``."""
        return {name: getattr(self, name) for name in TUNING}

    def columns(self) -> dict[str, Any]:
        """Its values by the names of :func:`axes`, as in tables."""
        every = {**vars(self), **self.disturbances}
        return {axis.name: every[axis.name] for axis in axes()}


def axes() -> list[Axis]:
    """Everything that an evaluation varies, in the order of the columns of its tables.

    Examples:
        >>> [axis.name for axis in axes() if axis.name not in DISTURBANCES]
        ['l1', 'noise', 'policy', 'epsilon', 'alpha', 'stage']
    """
    found = []
    for part in fields(Condition):
        if part.name == _DISTURBANCES:
            found += [
                Axis(name, float, (entry.neutral,), entry.help)
                for name, entry in DISTURBANCES.items()
            ]
        else:
            found.append(Axis(part.name, **part.metadata[_AXIS]))
    return found


TUNING = tuple(axis.name for axis in axes() if axis.tunes)
"""Names of the axes that tune the controller, in tables too."""


def conditions(of_suite: str | None = None, **values: Sequence[Any]) -> list[Condition]:
    """Every combination of controller, noise, stage and policy with each single disturbance.

    Disturbances vary one at a time, first all values of the first one, then the non-neutral values
    of each other; or they come from a suite. Every controller with a low-pass filter is tested with
    each ``epsilon`` and each ``alpha``; other controllers, and all if no values are given, are
    tested as they are. Without a ``stage``, the last one's policy is tested.

    Args:
        of_suite: name of a suite, whose cells replace the values of disturbances.
        **values: values by the names of :func:`axes`; the axis's defaults where not given.

    Raises:
        ValueError: for any other name, for disturbances beside a suite, or for values of alpha
            if no controller has a low-pass filter.

    Examples:
        >>> cells = conditions(epsilon=[0.3, 1.0], policy=["stochastic"])
        >>> [cell.controller for cell in cells]
        ['off', 'paper epsilon=0.3', 'paper epsilon=1']
        >>> len(conditions("quick", l1=["off"], policy=["stochastic"])) == len(suite("quick"))
        True
    """
    every = {axis.name: axis.values for axis in axes()}
    _check_names(values, every, "value to vary")
    given = {**every, **values}
    check_suite(of_suite, given)
    disturbances = _one_at_a_time(given) if of_suite is None else suite(of_suite)
    if given["alpha"] and not any(map(is_tuned, given["l1"])):
        raise ValueError(
            f"alpha is given, but none of {', '.join(given['l1'])} has a low-pass filter: leave it "
            "out, or test paper"
        )
    tunings = [
        dict(zip(TUNING, values, strict=True))
        for values in product(*(given[name] or (None,) for name in TUNING))
    ]
    cells = product(
        given["stage"] or (None,), given["policy"], given["noise"], disturbances, given["l1"]
    )
    return list(
        dict.fromkeys(
            Condition(l1, noise, disturbance, policy, stage=stage, **tuning)
            for stage, policy, noise, disturbance, l1 in cells
            for tuning in (tunings if is_tuned(l1) else [{}])
        )
    )


def _one_at_a_time(given: Mapping[str, Sequence[float]]) -> list[dict[str, float]]:
    first = next(iter(DISTURBANCES))
    return [
        {name: value}
        for name, entry in DISTURBANCES.items()
        for value in given[name]
        if name == first or value != entry.neutral
    ]


def check_suite(name: str | None, values: Mapping[str, Sequence[Any]], prefix: str = "") -> None:
    """Refuse an unknown suite, or one beside values of a disturbance.

    Args:
        name: name of the suite; ``None`` for none.
        values: values by the names of :func:`axes`.
        prefix: prefix of names as the user writes them.

    Raises:
        ValueError: naming suite and disturbance.
    """
    if name is None:
        return
    if name not in SUITES:
        raise ValueError(f"unknown {prefix}suite {name!r}; there are {', '.join(SUITES)}")
    for what, entry in DISTURBANCES.items():
        if any(value != entry.neutral for value in values[what]):
            raise ValueError(
                f"{prefix}suite and {prefix}{what} both set disturbances; leave one of them out"
            )


def disturbed(columns: Mapping[str, Any]) -> dict[str, float]:
    """The disturbances among the columns of a condition that are not neutral, with their values.

    A disturbance without a column is neutral.
    """
    return {
        name: float(columns[name])
        for name, entry in DISTURBANCES.items()
        if float(columns.get(name, entry.neutral)) != entry.neutral
    }


def undisturbed(columns: Mapping[str, Any]) -> bool:
    """Whether every disturbance in the columns of a condition is neutral."""
    return not disturbed(columns)


def disturbance_words(columns: Mapping[str, Any]) -> str:
    """The disturbances of a condition, as tables and charts name them.

    Examples:
        >>> disturbance_words({"bias": 0.5, "gain": 1.0}), disturbance_words({})
        ('bias 0.5', 'undisturbed')
    """
    found = [f"{name} {value:g}" for name, value in disturbed(columns).items()]
    return ", ".join(found) or "undisturbed"


def check_disturbance(name: str, value: float, prefix: str = "") -> None:
    """Refuse a value that a disturbance cannot have.

    Args:
        name: name of the disturbance.
        value: its value.
        prefix: prefix of the name as the user writes it.

    Raises:
        ValueError: naming disturbance and value.
    """
    if not math.isfinite(value):
        raise ValueError(f"{prefix}{name} must be finite, got {value}")
    try:
        DISTURBANCES[name].check(value)
    except ValueError as error:
        raise ValueError(f"{prefix}{name}: {error}") from None


def check_values(values: Mapping[str, Sequence[Any]], prefix: str = "") -> None:
    """Refuse values that cannot be tested.

    Args:
        values: values by the names of :func:`axes`, of their types.
        prefix: prefix of names as the user writes them.

    Raises:
        ValueError: naming axis and value.
    """
    for axis in axes():
        for value in values[axis.name]:
            if axis.choices and value not in axis.choices:
                raise ValueError(
                    f"unknown {axis.name} {value!r}; there are {', '.join(axis.choices)}"
                )
            if axis.name in DISTURBANCES:
                check_disturbance(axis.name, value, prefix)
    check_tuning(values["epsilon"], values["alpha"], prefix)


def _check_names(given: Iterable[str], known: Iterable[str], what: str) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"unknown {what} {name!r}; there are {', '.join(known)}")
