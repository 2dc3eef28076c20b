"""The parts of a campaign, and reading it from a YAML file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import yaml  # type: ignore[import-untyped]

from torchrl_l1.experiment.files import path_text, problem, yaml_text
from torchrl_l1.experiment.matrix import (
    SUITE_L1,
    Axis,
    Condition,
    axes,
    check_suite,
    check_values,
    conditions,
)
from torchrl_l1.experiment.recipes import find_campaign
from torchrl_l1.experiment.settings import NAMING_KEYS


class _Loader(yaml.SafeLoader):
    """The safe loader, with booleans as in Hydra."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a duplicate key: one of the two would be lost silently."""
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} appears twice", key.start_mark
                )
            seen.add(key.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


# YAML 1.1 reads yes, no, on and off as booleans, so l1: [off, paper] as [False, 'paper'], and
# 1e-3 as a string.
_BOOL, _FLOAT = "tag:yaml.org,2002:bool", "tag:yaml.org,2002:float"
_Loader.yaml_implicit_resolvers = {
    letter: [entry for entry in entries if entry[0] not in (_BOOL, _FLOAT)]
    for letter, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(_BOOL, re.compile(r"^(?:true|false)$", re.IGNORECASE), list("tTfF"))
_FLOAT_WORDS = re.compile(
    r"^[-+]?(?:\d+(?:\.\d*|(?=[eE]))|\.\d+)(?:[eE][-+]?\d+)?$|^[-+]?\.inf$|^\.nan$"
)
_Loader.add_implicit_resolver(_FLOAT, _FLOAT_WORDS, list("-+.0123456789"))


def _integer(loader: _Loader, node: yaml.ScalarNode) -> int:
    value = int(loader.construct_yaml_int(node))
    if re.match(r"[-+]?0[0-9_]", node.value) or ":" in node.value:
        raise yaml.constructor.ConstructorError(
            None,
            None,
            f"{node.value} means {value} in YAML; write {value}, or '{node.value}' for the word",
            node.start_mark,
        )
    return value


_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


class _Dumper(yaml.SafeDumper):
    """Quotes the words that either kind of loader would misread."""


_Dumper.add_implicit_resolver(_FLOAT, _FLOAT_WORDS, list("-+.0123456789"))


def load_yaml(file: Path) -> Any:
    """The content of a YAML file.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is not YAML, naming the place, or is too large.
    """
    try:
        return yaml.load(yaml_text(file), _Loader)
    # Tags with impossible values and keys that are lists raise other errors.
    except (yaml.YAMLError, RecursionError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{file} is not valid YAML: {problem(error)}") from error


def dump_yaml(content: Any) -> str:
    """YAML of plain lists, dictionaries and values, keys in their order.

    Examples:
        >>> print(dump_yaml({"l1": ["off", "paper"]}), end="")
        l1:
        - 'off'
        - paper
    """
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True))


# Texts that can be part of a path and of a Hydra override without quotes.
_PLAIN = re.compile(r"[A-Za-z0-9_.+-]{1,100}")
# Names of environments and functions; in a path, underscores replace separators.
_NAME_OF_CODE = re.compile(r"[A-Za-z0-9_.+:/-]{1,200}")
# Keys likewise; a group may be nested in another.
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(?:[./@-][A-Za-z0-9_]+)*")
# Names of campaigns, by default that of the user's file.
_NAME = re.compile(r"[\w+][\w.+=, -]{0,99}")
# Types of the values of a matrix.
_PLAIN_VALUES = (str, bool, int, float)
_RESERVED = ("run_dir", "resume")


class CampaignError(ValueError):
    """A campaign cannot be run as requested; the message locates the problem."""


@dataclass
class RunMatrix:
    """Runs of one recipe: every combination of the matrix's values.

    Attributes:
        recipe: a shipped recipe, or the user's own YAML file, relative to the campaign file.
        overrides: Hydra overrides for all of these runs.
        matrix: values by key; a key is a recipe group or a setting. ``seed`` is ``[0]`` if absent.
    """

    recipe: str
    overrides: list[str] = field(default_factory=list)
    matrix: dict[str, list[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.recipe, str):
            raise CampaignError(
                f"recipe must be the name of a recipe or a YAML file, got {self.recipe!r}"
            )
        _check_list("overrides", self.overrides, (str,))
        if not isinstance(self.matrix, dict):
            raise CampaignError(f"matrix must map keys to lists of values, got {self.matrix!r}")
        for key, values in self.matrix.items():
            if not _KEY.fullmatch(str(key)) or len(str(key)) > 100:
                raise CampaignError(f"matrix: {key!r} is not a key of a recipe")
            _check_list(f"matrix.{key}", values, _PLAIN_VALUES, filled=True)
            texts = [value_text(value) for value in values]
            for text in texts:
                if not (_NAME_OF_CODE if key in NAMING_KEYS else _PLAIN).fullmatch(text):
                    raise CampaignError(
                        f"matrix.{key}: {text!r} cannot name a folder; use a word or a number, and "
                        "move settings that all runs share to overrides"
                    )
            if len(set(map(path_text, texts))) < len(texts):
                raise CampaignError(f"matrix.{key} repeats a value: {', '.join(texts)}")
        for key in [*self.matrix, *map(override_key, self.overrides)]:
            if key in _RESERVED:
                raise CampaignError(f"{key} is set by the campaign itself; leave it out")
        for key in map(override_key, self.overrides):
            if key in self.matrix:
                raise CampaignError(
                    f"{key} is set both by overrides and by the matrix; leave one of them out"
                )
        seeds = {"seed": self.matrix.get("seed", [0])}
        if any(not isinstance(seed, int) or isinstance(seed, bool) for seed in seeds["seed"]):
            raise CampaignError(f"matrix.seed must hold whole numbers, got {seeds['seed']!r}")
        self.matrix = {k: v for k, v in self.matrix.items() if k != "seed"} | seeds


@dataclass
class EvaluationSettings:
    """An evaluation of frozen policies, for each finished run that matches.

    Attributes:
        name: name of the table ``RUN_DIR/evaluations/NAME.csv``.
        where: values that a run must have, by matrix key (or ``recipe``); every run if empty.
        matrix: what is varied: values by the names of :func:`~torchrl_l1.experiment.matrix.axes`,
            which are keys of the campaign file beside the others. By default they are those of the
            axis. ``epsilon`` and ``alpha`` may also be a single number or null. A planner, which
            acts in only one way, is tested once whatever ``policy`` is.
        episodes: episodes per cell.
        seed: seed of resets, noise and sampled actions.
        suite: name of a suite of disturbances, instead of their values. With it, ``l1`` defaults
            to ``[off, paper, robust, oracle]``.
    """

    name: str
    where: dict[str, list[Any]] = field(default_factory=dict)
    matrix: dict[str, list[Any]] = field(default_factory=dict)
    episodes: int = 25
    seed: int = 0
    suite: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not _PLAIN.fullmatch(self.name):
            raise CampaignError(f"name must be a word, got {self.name!r}")
        if not isinstance(self.where, dict):
            raise CampaignError(f"where must map keys to lists of values, got {self.where!r}")
        for key, values in self.where.items():
            _check_list(f"where.{key}", values, _PLAIN_VALUES, filled=True)
        every = axes()
        for key in self.matrix:
            if key not in [axis.name for axis in every]:
                raise CampaignError(f"an evaluation does not vary {key!r}")
        given = {"l1": list(SUITE_L1), **self.matrix} if self.suite is not None else self.matrix
        self.matrix = {axis.name: _axis_values(axis, given) for axis in every}
        for key, least in (("episodes", 1), ("seed", 0)):
            value = getattr(self, key)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise CampaignError(f"{key} must be a whole number from {least}, got {value!r}")
        try:
            check_values(self.matrix)
            check_suite(self.suite, self.matrix)
        except ValueError as error:
            raise CampaignError(str(error)) from error

    @staticmethod
    def keys() -> list[str]:
        """The keys in a campaign file, in their written order."""
        varied = [axis.name for axis in axes()]
        how_many = 1 + varied.index("policy")
        rest = ["episodes", "seed", *varied[how_many:], "suite"]
        return ["name", "where", *varied[:how_many], *rest]

    @classmethod
    def from_keys(cls, **entry: Any) -> EvaluationSettings:
        """Build from the :meth:`keys` of a campaign file, in which the matrix's are not nested.

        Raises:
            CampaignError: for a value of the wrong kind.
            TypeError: for any other key.
        """
        varied = {axis.name for axis in axes()}
        rest = {key: value for key, value in entry.items() if key not in varied}
        if "matrix" in rest:
            raise TypeError("matrix is not a key of an evaluation")
        return cls(**rest, matrix={key: entry[key] for key in entry if key in varied})

    def to_keys(self) -> dict[str, Any]:
        """Values by :meth:`keys`."""
        values = {**vars(self), **self.matrix}
        return {key: values[key] for key in self.keys()}

    def conditions(self) -> list[Condition]:
        """The tested conditions, in the order of the table."""
        return conditions(self.suite, **self.matrix)

    def of_a_run(self) -> dict[str, Any]:
        """The keys that the table of a single run depends on: all but ``name`` and ``where``."""
        settings = self.to_keys()
        del settings["name"], settings["where"]
        return settings


@dataclass
class Campaign:
    """A campaign file, read and checked.

    Attributes:
        name: the name of the campaign.
        file: the file it was read from.
        description: one line.
        runs: matrices of runs.
        evaluations: evaluations of the finished runs.
    """

    name: str
    file: Path
    description: str
    runs: list[RunMatrix]
    evaluations: list[EvaluationSettings]

    def to_dict(self) -> dict[str, Any]:
        """The resolved campaign as plain lists and dictionaries."""
        whole = asdict(self)
        del whole["file"]
        return {**whole, "evaluations": [settings.to_keys() for settings in self.evaluations]}


def value_text(value: Any) -> str:
    """A value as Hydra writes and reads it.

    Examples:
        >>> [value_text(value) for value in ("off", 3, 0.5, True)]
        ['off', '3', '0.5', 'true']
    """
    return str(value).lower() if isinstance(value, bool) else str(value)


def override_key(override: str) -> str:
    """The key of a Hydra override.

    Raises:
        CampaignError: if it has none.

    Examples:
        >>> override_key("+l1.epsilon=0.5")
        'l1.epsilon'
    """
    key, equals, _ = override.partition("=")
    if not equals or not key.strip("+~"):
        raise CampaignError(f"{override!r} is not an override; write KEY=VALUE")
    return key.strip("+~").partition("@")[0]


def _axis_values(axis: Axis, given: Mapping[str, Any]) -> list[Any]:
    """The values of an axis: texts or numbers; some axes may be left to the run."""
    values = given.get(axis.name, list(axis.values))
    if axis.kind is float and not axis.values:
        return _numbers(axis.name, values)
    if axis.kind is float:
        _check_list(axis.name, values, (int, float), filled=True)
        return [float(value) for value in values]
    _check_list(axis.name, values, (str,), filled=bool(axis.values))
    return list(values)


def _numbers(key: str, value: Any) -> list[float]:
    """A list from null, a number or a list of numbers."""
    values = [] if value is None else value if isinstance(value, list) else [value]
    if any(isinstance(one, bool) or not isinstance(one, (int, float)) for one in values):
        raise CampaignError(f"{key} must be null, a number or a list of numbers, got {value!r}")
    return [float(one) for one in values]


def _check_list(key: str, values: Any, kinds: tuple[type, ...], filled: bool = False) -> None:
    if not isinstance(values, list) or (filled and not values):
        raise CampaignError(f"{key} must be a list{' of values' * filled}, got {values!r}")
    for value in values:
        # In Python, a bool is an int too.
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise CampaignError(f"{key} holds {value!r}, which has the wrong type")


T = TypeVar("T")


def read_campaign(name: str, overrides: Sequence[str] = (), *, trusted: bool = False) -> Campaign:
    """Read a shipped campaign or the user's own YAML file.

    Args:
        name: such as ``table1``, or a path that ends in ``.yaml``.
        overrides: Hydra overrides for all runs; they replace those with the same key in the file.
        trusted: whether the file may configure Hydra itself, which may run arbitrary code.

    Raises:
        RecipeError: if there is no such campaign.
        CampaignError: for unknown keys and values of the wrong type, with file and key.

    Examples:
        >>> campaign = read_campaign("labels", ["outer_iterations=2"])
        >>> campaign.runs[0].matrix["label"]
        ['nominal', 'executed']
        >>> campaign.runs[0].overrides[-1]
        'outer_iterations=2'
    """
    file = find_campaign(name)
    try:
        content = load_yaml(file)
    except ValueError as error:
        raise CampaignError(str(error)) from error
    keys = ("name", "description", "runs", "evaluations")
    _check_keys(file, "", content, keys, required=("runs",))
    for key in ("runs", "evaluations"):
        if not isinstance(content.get(key, []), list) or content.get(key, [None]) == []:
            raise CampaignError(f"{file}: {key} must be a list with at least one entry")
    parts = [part.name for part in fields(RunMatrix)]
    runs = [
        _build(RunMatrix, file, f"runs[{i}]", entry, parts, "recipe")
        for i, entry in enumerate(content["runs"])
    ]
    for i, matrix in enumerate(runs):
        own = file.parent / str(matrix.recipe)
        for key in [*matrix.matrix, *map(override_key, matrix.overrides)]:
            if re.match(r"hydra\b", key) and not trusted:
                raise CampaignError(
                    f"{file}: runs[{i}]: {key} configures Hydra, which may run arbitrary code; "
                    "leave it out, or give --trust if the file is yours"
                )
        try:
            runs[i] = RunMatrix(
                str(own.resolve()) if own.suffix == ".yaml" and own.is_file() else matrix.recipe,
                list(
                    {override_key(text): text for text in (*matrix.overrides, *overrides)}.values()
                ),
                matrix.matrix,
            )
        except CampaignError as error:
            raise CampaignError(f"{file}: runs[{i}]: {error}") from error
    evaluations = [
        _build(
            EvaluationSettings.from_keys, file, f"evaluations[{i}]", entry,
            EvaluationSettings.keys(), "name",
        )
        for i, entry in enumerate(content.get("evaluations", []))
    ]  # fmt: skip
    title = content.get("name", file.stem)
    if not isinstance(title, str) or not _NAME.fullmatch(title):
        raise CampaignError(
            f"{file}: name must begin with a letter and have at most 100 letters, digits, spaces "
            f"and . + = , - because it names a folder; got {title!r}"
        )
    return Campaign(title, file, str(content.get("description", "")), runs, evaluations)


def _build(
    make: Callable[..., T], file: Path, where: str, entry: Any, known: Sequence[str], required: str
) -> T:
    _check_keys(file, where, entry, known, [required])
    try:
        return make(**entry)
    except CampaignError as error:
        raise CampaignError(f"{file}: {where}: {error}") from error


def _check_keys(
    file: Path, where: str, entry: Any, known: Sequence[str], required: Sequence[str]
) -> None:
    place = f"{file}: {where}: " if where else f"{file}: "
    if not isinstance(entry, Mapping):
        raise CampaignError(f"{place}expected keys and values, got {entry!r}")
    for key in entry:
        if key not in known:
            close = get_close_matches(str(key), known, n=1)
            hint = f" Did you mean {close[0]}?" if close else ""
            raise CampaignError(f"{place}unknown key {key!r}.{hint} There are {', '.join(known)}.")
    for key in required:
        if key not in entry:
            raise CampaignError(f"{place}{key} is missing")
