"""Reading a campaign file, with messages that say where a mistake is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from torchrl_l1.campaign.settings import (
    Campaign,
    CampaignError,
    EvaluationSettings,
    RunMatrix,
    override_key,
)
from torchrl_l1.campaign.yaml_file import load_yaml
from torchrl_l1.experiment.recipes import find_campaign

T = TypeVar("T")


def read_campaign(name: str, overrides: Sequence[str] = ()) -> Campaign:
    """Read a shipped campaign or a YAML file of the user's.

    Args:
        name: such as ``table1``, or a path that ends in ``.yaml``.
        overrides: Hydra overrides for all runs; they replace those of the file with the same key.

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
    runs = [_build(RunMatrix, file, f"runs[{i}]", entry) for i, entry in enumerate(content["runs"])]
    for i, matrix in enumerate(runs):
        own = file.parent / str(matrix.recipe)
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
        _build(EvaluationSettings, file, f"evaluations[{i}]", entry)
        for i, entry in enumerate(content.get("evaluations", []))
    ]
    title = str(content.get("name", file.stem))
    return Campaign(title, file, str(content.get("description", "")), runs, evaluations)


def _build(kind: type[T], file: Path, where: str, entry: Any) -> T:
    parts = fields(kind)  # type: ignore[arg-type]
    required = [
        part.name for part in parts if part.default is MISSING and part.default_factory is MISSING
    ]
    _check_keys(file, where, entry, [part.name for part in parts], required)
    try:
        return kind(**entry)
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
