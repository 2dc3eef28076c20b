"""What a run was, from its configuration: task, noise, arm, and the settings that matter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from omegaconf import OmegaConf

from torchrl_l1.experiment.recipes import shared_dir
from torchrl_l1.experiment.schema import VOLATILE_KEYS, METRPORecipe

__all__ = ["BASELINE", "NOISES", "TASKS", "Identity", "identify"]

BASELINE = "off"
"""Name of the arm without L1."""

NOISES = ("none", "action", "observation", "both")
"""Noise settings in the order in which tables and figures show them."""

TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
"""Tasks in the order of the paper's tables; others come after them."""

# Keys that tell runs apart in other ways, or that do not touch the result.
_NOT_COMPARED = (*VOLATILE_KEYS, "seed", "task", "threads", "device", "l1.compile")
_NOISE_KEYS = ("perturbation.action_noise", "perturbation.observation_noise")


@dataclass(frozen=True)
class Identity:
    """What a run is one sample of.

    Attributes:
        task: such as ``half_cheetah``.
        noise: option of the ``noise`` group that its noise is equal to, else the noise in words.
        arm: ``off``, or the option of the ``l1`` group that its controller is closest to.
        seed: its seed.
        outer_iterations: the number of rows of a finished run.
        shared: settings that both arms have, key by key, as text.
        l1: settings of the controller as text; none for the baseline.
    """

    task: str
    noise: str
    arm: str
    seed: int
    outer_iterations: int
    shared: Mapping[str, str]
    l1: Mapping[str, str]

    @property
    def model_form(self) -> str:
        """``nonlinear`` or ``affine`` in the control."""
        return self.shared.get("model.form", "nonlinear")


def identify(config: Mapping[str, Any]) -> Identity:
    """Read a run's resolved configuration.

    Settings that it does not mention, since it is older than they are, have the schema's
    defaults.

    Raises:
        KeyError: if it lacks a key that every run has.
        ValueError: if such a key has no usable value.
    """
    settings = {**schema_defaults(), **_flatten(config)}
    for key in ("task", "seed", "outer_iterations"):
        if settings.get(key) in (None, "???"):
            raise KeyError(f"the configuration has no {key}")
    arm = _arm(settings)
    compared = {
        key: _text(value)
        for key, value in settings.items()
        if key not in (*_NOT_COMPARED, *_NOISE_KEYS) and key.split(".")[0] not in VOLATILE_KEYS
    }
    return Identity(
        task=str(settings["task"]),
        noise=_noise(settings),
        arm=arm,
        seed=int(settings["seed"]),
        outer_iterations=int(settings["outer_iterations"]),
        shared={k: v for k, v in compared.items() if not k.startswith("l1.")},
        l1={k: v for k, v in compared.items() if k.startswith("l1.") and arm != BASELINE},
    )


@cache
def schema_defaults() -> dict[str, Any]:
    """Every key of the recipe schema that has a default, dotted, with that default."""
    node = OmegaConf.to_container(OmegaConf.structured(METRPORecipe))
    return {key: value for key, value in _flatten(node).items() if value != "???"}


def default_text(key: str) -> str | None:
    """A key's default as :class:`Identity` writes values; ``None`` if the schema has none."""
    defaults = schema_defaults()
    return _text(defaults[key]) if key in defaults else None


def _arm(settings: Mapping[str, Any]) -> str:
    if not settings.get("l1.enabled"):
        return BASELINE

    def distance(option: str) -> int:
        full = {k: v for k, v in schema_defaults().items() if k.startswith("l1.")}
        full |= {f"l1.{key}": value for key, value in _group("l1")[option].items()}
        tuned = ("l1.epsilon", "l1.compile")
        return sum(settings.get(k) != v for k, v in full.items() if k not in tuned)

    options = [name for name, values in _group("l1").items() if values.get("enabled")]
    # The first of equals: the paper's controller is what a user's own departs from.
    return min(sorted(options, key=lambda name: name != "paper"), key=distance)


def _noise(settings: Mapping[str, Any]) -> str:
    for name, values in _group("noise").items():
        if all(settings.get(f"perturbation.{key}") == value for key, value in values.items()):
            return name
    action, observation = (settings.get(key) for key in _NOISE_KEYS)
    return f"action {action:g}, observation {observation:g}"


@cache
def _group(group: str) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for file in sorted((shared_dir() / group).glob("*.yaml")):
        found[file.stem] = _flatten(OmegaConf.to_container(OmegaConf.load(file)))
    return found


def _flatten(node: Any, prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in node.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{name}.")
        else:
            flat[name] = value
    return flat


def _text(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)
