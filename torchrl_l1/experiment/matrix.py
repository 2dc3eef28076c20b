"""What an evaluation varies: options, keys of campaign files and columns of tables follow from it.

The fields of :class:`Condition` are the one description; :func:`axes` lists them with the
disturbances of :class:`~torchrl_l1.envs.Perturbation` in their place.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from typing import Any

from torchrl_l1.algorithms.facts import KINDS
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.l1_options import check_tuning, controller_label
from torchrl_l1.experiment.settings import SCHEMAS

_STAGES = [stage.name for one in SCHEMAS.values() for stage in one.builds.facts.named_stages]

# Key of the metadata of a field.
_AXIS = "axis"
_DISTURBANCES = "disturbances"


@dataclass(frozen=True)
class Axis:
    """One of the things that an evaluation varies.

    Attributes:
        name: of the option, of the key in campaign files, and of the column.
        kind: of its values, ``str`` or ``float``.
        values: those that are tested where none are given; empty where the run has its own.
        help: what the values are, in words.
        choices: the only values that there are; empty if any may be tried.
    """

    name: str
    kind: type[str] | type[float]
    values: tuple[Any, ...]
    help: str
    choices: tuple[str, ...] = ()


def _varied(
    kind: type[str] | type[float],
    help: str,
    values: Iterable[Any] = (),
    choices: tuple[str, ...] = (),
    **default: Any,
) -> Any:
    axis = {"kind": kind, "help": help, "values": tuple(values), "choices": choices}
    return field(metadata={_AXIS: axis}, **default)


@dataclass(frozen=True)
class Condition:
    """One cell: which controller, noise, disturbances and policy, and how this acts.

    Attributes:
        l1: option of the ``l1`` group.
        noise: option of the ``noise`` group.
        disturbances: value of each of :data:`~torchrl_l1.envs.DISTURBANCES`, by name; those that
            are not given are neutral.
        policy: ``stochastic`` or ``deterministic``.
        epsilon: tolerance of the switching law, raw state units; the run's own if ``None``.
        alpha: gain of the filter per step; that of the option (or of the run's own controller)
            if ``None``.
        stage: whose policy it is, see :attr:`Algorithm.policies
            <torchrl_l1.algorithms.algorithm.Algorithm.policies>`; the last one's if ``None``.

    Raises:
        ValueError: for a disturbance that there is not.

    Examples:
        >>> Condition("paper", disturbances={"bias": 0.5}, epsilon=0.3).columns()
        {'l1': 'paper', 'noise': 'none', 'bias': 0.5, 'gain': 1.0, 'policy': 'stochastic', \
'epsilon': 0.3, 'alpha': None, 'stage': None}
    """

    l1: str = _varied(str, "settings of the l1 group", ("off", "paper"))
    noise: str = _varied(str, "settings of the noise group", ("none",), default="none")
    disturbances: Mapping[str, float] = field(default_factory=dict, hash=False)
    policy: str = _varied(
        str,
        "sampled or mean actions; both by default, and sampled ones where they are the same",
        KINDS,
        choices=KINDS,
        default=KINDS[0],
    )
    epsilon: float | None = _varied(
        float, "tolerances of the switching law; the run's own by default", default=None
    )
    alpha: float | None = _varied(
        float, "gains of the filter per step; the controller's own by default", default=None
    )
    stage: str | None = _varied(
        str,
        "stages whose policies are tested, of algorithms with several "
        f"({', '.join(_STAGES)}); "
        "the last that there is by default",
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
        """The controller in tables and figures, see :func:`controller_label`."""
        return controller_label(self.l1, self.epsilon, self.alpha)

    def columns(self) -> dict[str, Any]:
        """Its values by the names of :func:`axes`, as tables hold them."""
        every = {**vars(self), **self.disturbances}
        return {axis.name: every[axis.name] for axis in axes()}


def axes() -> list[Axis]:
    """All that an evaluation varies, in the order of the columns of its tables.

    Examples:
        >>> [axis.name for axis in axes()]
        ['l1', 'noise', 'bias', 'gain', 'policy', 'epsilon', 'alpha', 'stage']
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


def conditions(**values: Sequence[Any]) -> list[Condition]:
    """Every combination of controller, noise, stage and policy with each single disturbance.

    Disturbances vary one at a time: the values of the first, then those of each other that are
    not neutral. Every controller but ``off`` is tested with each ``epsilon`` and each ``alpha``;
    without values, as it is. Without a ``stage``, the last one's policy is tested.

    Args:
        **values: by the names of :func:`axes`; those of the axis where none are given.

    Raises:
        ValueError: for any other name.

    Examples:
        >>> cells = conditions(epsilon=[0.3, 1.0], policy=["stochastic"])
        >>> [cell.controller for cell in cells]
        ['off', 'paper epsilon=0.3', 'paper epsilon=1']
    """
    every = {axis.name: axis.values for axis in axes()}
    _check_names(values, every, "value to vary")
    given = {**every, **values}
    first = next(iter(DISTURBANCES))
    disturbances = [
        {name: value}
        for name, entry in DISTURBANCES.items()
        for value in given[name]
        if name == first or value != entry.neutral
    ]
    tunings = list(product(given["epsilon"] or (None,), given["alpha"] or (None,)))
    cells = product(
        given["stage"] or (None,), given["policy"], given["noise"], disturbances, given["l1"]
    )
    return list(
        dict.fromkeys(
            Condition(l1, noise, disturbed, policy, epsilon, alpha, stage)
            for stage, policy, noise, disturbed, l1 in cells
            for epsilon, alpha in (tunings if l1 != "off" else [(None, None)])
        )
    )


def undisturbed(columns: Mapping[str, Any]) -> bool:
    """Whether the columns of a condition hold the neutral value of every disturbance."""
    return all(columns[name] == entry.neutral for name, entry in DISTURBANCES.items())


def check_values(values: Mapping[str, Sequence[Any]], prefix: str = "") -> None:
    """Refuse values that nothing can be tested with.

    Args:
        values: by the names of :func:`axes`, of their kinds.
        prefix: what stands before a name where the user writes it.

    Raises:
        ValueError: naming axis and value.
    """
    for axis in axes():
        for value in values[axis.name]:
            if axis.choices and value not in axis.choices:
                raise ValueError(
                    f"unknown {axis.name} {value!r}; there are {', '.join(axis.choices)}"
                )
            if axis.name in DISTURBANCES and not math.isfinite(value):
                raise ValueError(f"{prefix}{axis.name} must be finite, got {value}")
    check_tuning(values["epsilon"], values["alpha"], prefix)


def _check_names(given: Iterable[str], known: Iterable[str], what: str) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"unknown {what} {name!r}; there are {', '.join(known)}")
