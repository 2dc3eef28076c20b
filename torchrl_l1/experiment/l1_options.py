"""The shipped options of the L1 controller, and which of them a run's controller corresponds to."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from functools import cache
from typing import Any

from torchrl_l1.algorithms.collection import ORACLE
from torchrl_l1.control.config import DEFAULT_ALPHA, follows_input
from torchrl_l1.envs import AnyTask
from torchrl_l1.envs.tasks import is_plain
from torchrl_l1.experiment.recipes import group_options, group_setting
from torchrl_l1.experiment.settings import L1Settings, l1_config

OFF = "off"
"""The option without L1."""

UNTUNED = (OFF, ORACLE)
"""Names in tests that stand for no controller that epsilon and alpha could tune."""

# Settings by which runs are tuned; they do not make a different controller.
_NO_OPTION = ("enabled", "epsilon", "compile")
# Two ways to give the same number.
_FILTER = ("alpha", "cutoff")


@cache
def l1_options() -> dict[str, L1Settings]:
    """The options of the recipe group ``l1`` by name, including ``off``.

    Examples:
        >>> l1_options()["slow"].alpha
        0.1
    """
    return {name: l1_option(name) for name in group_options("l1")}


def l1_option(name: str) -> L1Settings:
    """A shipped option of the recipe group ``l1``.

    Raises:
        ValueError: for an unknown option; the message lists the known ones.
    """
    return L1Settings(**group_setting("l1", name))


def is_tuned(name: str) -> bool:
    """Whether epsilon and alpha apply to what a test names.

    Examples:
        >>> is_tuned("paper"), is_tuned("robust"), is_tuned("oracle")
        (True, False, False)
    """
    return name not in UNTUNED and not follows_input(l1_options()[name].filter)


def check_tested(names: Iterable[str]) -> None:
    """Refuse controllers that frozen policies cannot be tested with.

    Args:
        names: options of the recipe group ``l1``, or the oracle, which trains no run.

    Raises:
        ValueError: for any other name; the message lists the known ones.
    """
    there = [*group_options("l1"), ORACLE]
    for name in names:
        if name not in there:
            raise ValueError(f"unknown l1 setting {name!r}; there are {', '.join(there)}")


def filter_gain(settings: L1Settings, task: str | AnyTask) -> float:
    """Gain per step of the low-pass filter, however it was given.

    For an external environment given only by name, it is the cutoff in rad/s if that was given:
    nothing is run to find out the time step.

    Raises:
        KeyError: for an unknown task, whose time step a ``cutoff`` needs.
        ValueError: for settings that contradict each other.

    Examples:
        >>> filter_gain(L1Settings(), "inverted_pendulum")
        0.35
        >>> filter_gain(L1Settings(cutoff=8.75), "inverted_pendulum")
        0.35
    """
    if isinstance(task, str) and not is_plain(task):
        gain = settings.alpha if settings.cutoff is None else settings.cutoff
        return DEFAULT_ALPHA if gain is None else gain
    config = l1_config(replace(settings, enabled=True), task)
    assert config is not None
    # The product of cutoff and time step may differ from a written alpha in the last digit.
    return float(f"{config.filter_gain:.9g}")


def departures(settings: L1Settings, option: str, task: str | AnyTask) -> dict[str, Any]:
    """The settings in which a controller departs from a shipped option, with its values.

    Epsilon and compilation do not count; the filter is compared by its gain, as ``alpha``.

    Examples:
        >>> departures(L1Settings(enabled=True, cutoff=2.5), "paper", "inverted_pendulum")
        {'alpha': 0.1}
    """
    shipped = l1_options()[option]
    found = {
        name: getattr(settings, name)
        for name in (f.name for f in fields(L1Settings) if f.name not in (*_NO_OPTION, *_FILTER))
        if getattr(settings, name) != getattr(shipped, name)
    }
    gain = filter_gain(settings, task)
    return found if gain == filter_gain(shipped, task) else {**found, "alpha": gain}


def closest_option(settings: L1Settings, task: str | AnyTask, *, by_filter: bool = True) -> str:
    """The shipped option from which a controller departs least.

    Args:
        settings: the controller's settings.
        task: name of the task.
        by_filter: whether the filter's gain distinguishes options that are otherwise equal.

    Examples:
        >>> slow = L1Settings(enabled=True, alpha=0.1)
        >>> closest_option(slow, "swimmer"), closest_option(slow, "swimmer", by_filter=False)
        ('slow', 'paper')
        >>> closest_option(L1Settings(), "swimmer")
        'off'
    """
    if not settings.enabled:
        return OFF

    def distance(option: str) -> tuple[int, bool, bool]:
        found = departures(settings, option, task)
        filters = found.pop("alpha", None) is not None
        # The first of equals: users' own controllers depart from the paper's.
        return len(found), by_filter and filters, option != "paper"

    return min((name for name, values in l1_options().items() if values.enabled), key=distance)


def same_controller(one: L1Settings, other: L1Settings, task: str | AnyTask) -> bool:
    """Whether two settings make the same controller, compiled or not.

    Filters are compared by their gain; controllers that are off are the same.

    Examples:
        >>> own = L1Settings(enabled=True, epsilon=0.3, cutoff=2.5)
        >>> same_controller(own, replace(own, alpha=0.1, cutoff=None), "inverted_pendulum")
        True
        >>> same_controller(own, replace(own, epsilon=1.0), "inverted_pendulum")
        False
    """
    if not (one.enabled and other.enabled):
        return one.enabled == other.enabled
    first, second = (
        replace(settings, alpha=filter_gain(settings, task), cutoff=None, compile=False)
        for settings in (one, other)
    )
    return first == second


def controller_label(option: str, **values: float | None) -> str:
    """An option and the values that a test sets, as tables and figures name a controller.

    Examples:
        >>> controller_label("paper", epsilon=0.3, alpha=0.1), controller_label("off", alpha=None)
        ('paper epsilon=0.3 alpha=0.1', 'off')
    """
    return " ".join([option, *(f"{k}={v:.9g}" for k, v in values.items() if v is not None)])


def check_tuning(epsilon: Sequence[float], alpha: Sequence[float], prefix: str = "") -> None:
    """Refuse values that no controller can be tested with.

    Args:
        epsilon: tolerances of the switching law; with 0 the affine model is at the policy's action
            in every step.
        alpha: gains of the filter per step.
        prefix: prefix of option names as the user writes them.

    Raises:
        ValueError: naming the option and the value.
    """
    for value in epsilon:
        if not (value >= 0 and math.isfinite(value)):
            raise ValueError(f"{prefix}epsilon must be finite and not negative, got {value:g}")
    for value in alpha:
        if not 0 < value <= 1:
            raise ValueError(f"{prefix}alpha must be above 0 and at most 1, got {value:g}")
