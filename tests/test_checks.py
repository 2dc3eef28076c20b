"""No setting takes a number that is none: of every field of every dataclass of settings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from torchrl_l1.algorithms import (
    CloningConfig,
    FineTuningConfig,
    MBMFConfig,
    METRPOConfig,
    ModelConfig,
    OutcomeConfig,
    PETSConfig,
)
from torchrl_l1.algorithms.mbmf_config import ClonedPolicyConfig
from torchrl_l1.algorithms.metrpo_config import PolicyConfig
from torchrl_l1.checks import check_choice, check_count, check_widths, check_within
from torchrl_l1.compilation import check_mode
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.objectives import TRPOConfig
from torchrl_l1.planning import CEMConfig, MPPIConfig, ShootingConfig

# With the prefix of their settings, and what they cannot be made without.
SETTINGS: dict[type, tuple[str, dict[str, Any]]] = {
    CEMConfig: ("cem.", {}),
    ClonedPolicyConfig: ("policy.", {}),
    CloningConfig: ("cloning.", {}),
    FineTuningConfig: ("fine_tuning.", {}),
    FitConfig: ("fit.", {}),
    L1Config: ("", {"dt": 0.04}),
    MBMFConfig: ("", {}),
    METRPOConfig: ("", {}),
    ModelConfig: ("model.", {}),
    MPPIConfig: ("mppi.", {}),
    OutcomeConfig: ("outcome_model.", {}),
    PETSConfig: ("", {}),
    PolicyConfig: ("policy.", {}),
    ShootingConfig: ("shooting.", {}),
    TRPOConfig: ("trpo.", {}),
}
# Infinity there is no bound.
UNBOUNDED = {
    (L1Config, "action_low"): (-math.inf,),
    (L1Config, "action_high"): (math.inf,),
    (L1Config, "max_error"): (math.inf,),
}


def holds(hint: Any, kind: type) -> bool:
    return hint is kind or any(holds(part, kind) for part in get_args(hint))


def numbers(kind: type) -> Iterator[tuple[type, str, bool]]:
    """Settings, names of their fields that are numbers, and whether in a list."""
    for settings in SETTINGS:
        hints = get_type_hints(settings)
        for field in fields(settings):
            if holds(hints[field.name], kind):
                yield settings, field.name, get_origin(hints[field.name]) is list


def make(settings: type, name: str, value: object) -> object:
    return settings(**{**SETTINGS[settings][1], name: value})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("settings", "name", "in_list"), list(numbers(float)))
def test_no_float_is_nan_or_infinite(
    settings: type, name: str, in_list: bool, value: float
) -> None:
    if value in UNBOUNDED.get((settings, name), ()):
        make(settings, name, value)
        return
    with pytest.raises(ValueError, match=rf"^{SETTINGS[settings][0]}{name}\b.* (must|got) "):
        make(settings, name, [value] if in_list else value)


@pytest.mark.parametrize("value", [math.nan, -1])
@pytest.mark.parametrize(("settings", "name", "in_list"), list(numbers(int)))
def test_no_count_is_nan_or_negative(
    settings: type, name: str, in_list: bool, value: float
) -> None:
    with pytest.raises(ValueError, match=rf"^{SETTINGS[settings][0]}{name}\b.* (must|got) "):
        make(settings, name, [value] if in_list else value)


def test_the_fields_are_found() -> None:
    found = {(settings, name) for settings, name, _ in numbers(float)}
    assert {(FitConfig, "weight_decay"), (L1Config, "a_s"), (MPPIConfig, "variance")} <= found
    assert not {(FitConfig, "batch_size"), (FitConfig, "bootstrap")} & found


@pytest.mark.parametrize(
    ("interval", "inside", "outside"),
    [
        ("[0, 1]", [0, 0.5, 1], [-1e-9, 1 + 1e-9, math.nan]),
        ("(0, 1]", [1e-9, 1], [0, 1.1, math.nan]),
        ("[0, 1)", [0, 0.999], [1, -0.1, math.nan]),
        ("(0, inf)", [1e-9, 1e300], [0, math.inf, math.nan]),
    ],
)
def test_intervals(interval: str, inside: list[float], outside: list[float]) -> None:
    for value in inside:
        check_within("x", value, interval)
    for value in outside:
        with pytest.raises(ValueError, match=r"^x must be in [\[(]\d, (\d|inf)[\])], got "):
            check_within("x", value, interval)


def test_errors_name_the_setting_and_what_it_may_be() -> None:
    with pytest.raises(ValueError, match=r"^fit.patience must be at least 1, got 0$"):
        check_count("fit.patience", 0)
    with pytest.raises(ValueError, match=r"^steps must be an integer, got 1000.0$"):
        check_count("steps", 1e3)
    with pytest.raises(ValueError, match=r"^policy.hidden must hold widths .* got \[8, 0\]$"):
        check_widths("policy.hidden", [8, 0])
    with pytest.raises(ValueError, match=r"^label must be 'one' or 'two', got 'three'$"):
        check_choice("label", "three", ("one", "two"))


@pytest.mark.parametrize("mode", [True, False, "auto"])
def test_modes_of_compilation(mode: bool | str) -> None:
    assert check_mode(mode) is mode


@pytest.mark.parametrize("mode", [1, 0, 1.0, None, "yes", "true"])
def test_a_number_is_no_mode_of_compilation(mode: object) -> None:
    with pytest.raises(ValueError, match=r"^l1.compile must be True, False or 'auto', got "):
        check_mode(mode, "l1.compile")
