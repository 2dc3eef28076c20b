"""The identity of a run, from its configuration: task, noise, arm, and relevant settings."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

from omegaconf import OmegaConf

from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.control.config import DEFAULT_ALPHA
from torchrl_l1.experiment.l1_options import OFF, closest_option, departures, filter_gain
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.recipes import available_recipes, shared_dir
from torchrl_l1.experiment.settings import (
    SCHEMAS,
    VOLATILE_KEYS,
    L1Settings,
    flatten,
    schema_defaults,
)

# Algorithms that learn a policy come before those that only plan, each before its variants.
_TRAINED = {
    name: SCHEMAS[name].builds.facts
    for name in sorted(SCHEMAS, key=lambda name: not SCHEMAS[name].builds.facts.samples)
}
_SCHEMA_OF = {shown: name for name, one in _TRAINED.items() for shown in (name, *one.variants)}

ALGORITHMS: Mapping[str, AlgorithmFacts] = {
    shown: _TRAINED[name] if shown == name else _TRAINED[name].of_variant(shown)
    for shown, name in _SCHEMA_OF.items()
}
"""Algorithms by name, see :class:`Identity`, in the order of a report."""

BASELINE = OFF
"""Name of the arm without L1."""

NOISES: Mapping[str, str] = {
    "none": "no noise",
    "action": "action noise",
    "observation": "observation noise",
    "both": "action and observation noise",
}
"""Noise settings in words, in the order of tables and figures."""

# Keys that distinguish runs in other ways, or that do not affect the result.
_VOLATILE = [key for key in VOLATILE_KEYS if key != "search_path"]
_NOT_COMPARED = (*_VOLATILE, "seed", "task", "threads", "device", "compile_plans", "l1.compile")
# Two ways to give the gain of the filter, which is compared under the first name.
_FILTER_KEYS = ("l1.alpha", "l1.cutoff")
_NOISE_KEYS = ("perturbation.action_noise", "perturbation.observation_noise")
# Settings that, like disturbances, change the named task.
_TASK_KEYS = ("dt", "horizon", "reward", "termination")


@dataclass(frozen=True)
class Identity:
    """What a run is a sample of.

    Attributes:
        algorithm: the recipe's algorithm, such as ``metrpo``, or its variant, such as ``dets`` for
            PETS with members that predict points.
        task: such as ``half_cheetah``.
        noise: option of the ``noise`` group that its noise equals, or else the kind of noise with
            its half-width, such as ``action 0.3``.
        arm: ``off``, or the option of the ``l1`` group that its controller is closest to,
            whatever the gain of its filter.
        seed: its seed.
        outer_iterations: the number of rows of a finished run.
        shared: settings that both arms have, by key, as text.
        l1: settings of the controller as text; none for the baseline. ``l1.alpha`` is the gain
            of the filter, however it was given.
        departures: settings in which the controller departs from the shipped option ``arm``;
            epsilon does not count.
        shipped: the option that the controller equals except for epsilon; empty if there is none.
    """

    algorithm: str
    task: str
    noise: str
    arm: str
    seed: int
    outer_iterations: int
    shared: Mapping[str, str]
    l1: Mapping[str, str]
    departures: Mapping[str, str]
    shipped: str

    @property
    def model_form(self) -> str:
        """Form of the model: ``nonlinear`` or ``affine`` in the control."""
        return self.shared.get("model.form", "nonlinear")

    @property
    def usual_task(self) -> bool:
        """Whether steps, episodes and rewards are the task's, with no disturbance but noise."""
        return all(
            value == default_text(key, self.algorithm)
            for key, value in self.shared.items()
            if key in _TASK_KEYS or key.startswith("perturbation.")
        )

    @property
    def as_published(self) -> bool:
        """Whether the published tables include such runs: algorithm, task, model, controller."""
        usual = self.usual_task and self.model_form != "affine" and not self.departures
        return usual and "training" in facts(self.algorithm).tables

    @property
    def recipe_departures(self) -> dict[str, str]:
        """Settings in which it departs from a shipped recipe, except those of the controller."""
        usual = _recipe_settings(self.shared.get("recipe", ""))
        return {k: v for k, v in self.shared.items() if k in usual and v != usual[k]}


def identify(config: Mapping[str, Any]) -> Identity:
    """Read a run's resolved configuration.

    Settings that it lacks, because it is older than they are, have the schema's defaults.

    Raises:
        KeyError: if it lacks a key that every run has.
        ValueError: if such a key has no usable value.
    """
    settings = {**schema_defaults(config), **flatten(config)}
    for key in ("task", "seed", "outer_iterations"):
        if settings.get(key) in (None, "???"):
            raise KeyError(f"the configuration has no {key}")
    task = str(settings["task"])
    controller = L1Settings(**{f.name: settings[f"l1.{f.name}"] for f in fields(L1Settings)})
    arm = closest_option(controller, task, by_filter=False)
    closest = closest_option(controller, task)
    compared = {
        clean(key): _text(value)
        for key, value in settings.items()
        if key not in (*_NOT_COMPARED, *_NOISE_KEYS, *_FILTER_KEYS)
        and key.split(".")[0] not in _VOLATILE
    }
    l1 = {k: v for k, v in compared.items() if k.startswith("l1.")}
    on = arm != BASELINE
    departed = departures(controller, arm, task) if on else {}
    return Identity(
        algorithm=_algorithm(settings),
        task=task,
        noise=_noise(settings),
        arm=arm,
        seed=int(settings["seed"]),
        outer_iterations=int(settings["outer_iterations"]),
        shared={k: v for k, v in compared.items() if k not in l1},
        l1={**l1, _FILTER_KEYS[0]: _text(filter_gain(controller, task))} if on else {},
        departures={f"l1.{key}": _text(value) for key, value in departed.items()},
        shipped="" if on and departures(controller, closest, task) else closest,
    )


@cache
def _recipe_settings(recipe: str) -> dict[str, str]:
    if recipe not in available_recipes():
        return {}
    settings = OmegaConf.to_container(compose(recipe, ["run_dir=unused"]), resolve=True)
    flat = flatten(settings)
    del flat["search_path"]  # folders of the user's code
    return {key: _text(value) for key, value in flat.items()}


def default_text(key: str, algorithm: str) -> str | None:
    """The text of a key's default, as in :class:`Identity`; ``None`` if the schema has none."""
    schema = schema_defaults({"algorithm": _SCHEMA_OF[algorithm]})
    defaults = {**schema, _FILTER_KEYS[0]: DEFAULT_ALPHA}
    return _text(defaults[key]) if key in defaults else None


def _algorithm(settings: Mapping[str, Any]) -> str:
    name = str(settings["algorithm"])
    for variant, one in _TRAINED[name].variants.items():
        if all(settings.get(key) == value for key, value in one.settings.items()):
            return variant
    return name


def _noise(settings: Mapping[str, Any]) -> str:
    for name, values in _noises().items():
        if all(settings.get(f"perturbation.{key}") == value for key, value in values.items()):
            return name
    # perturbation.action_noise is shown as "action".
    levels = {key.split(".")[1].split("_")[0]: float(settings[key]) for key in _NOISE_KEYS}
    return ", ".join(f"{kind} {level:g}" for kind, level in levels.items() if level)


@cache
def _noises() -> dict[str, dict[str, Any]]:
    files = sorted((shared_dir() / "noise").glob("*.yaml"))
    return {file.stem: flatten(OmegaConf.to_container(OmegaConf.load(file))) for file in files}


def _text(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return clean(str(value))


def clean(text: str) -> str:
    """Text made safe for Markdown: it goes into tables, headings and legends.

    Examples:
        >>> clean("a <b> | [c](d)")
        'a ?b? ? [c] (d)'
    """
    return re.sub(r"[^\w .,:;=+*/()\[\]{}'\"@%~^&#!?$-]", "?", text).replace("](", "] (")


def facts(algorithm: str) -> AlgorithmFacts:
    """The facts of an algorithm.

    Raises:
        ValueError: for an unknown algorithm.

    Examples:
        >>> facts("dets").samples
        False
    """
    if algorithm not in ALGORITHMS:
        raise ValueError(f"no report of algorithm {algorithm!r}; there are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[algorithm]
