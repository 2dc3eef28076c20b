"""From a campaign file to its runs: every setting known, every mistake found, nothing started."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from torchrl_l1.algorithms.device import resolve_device
from torchrl_l1.campaign.runs import PlannedRun, quoted, recipe_name
from torchrl_l1.campaign.settings import (
    Campaign,
    CampaignError,
    RunMatrix,
    value_text,
)
from torchrl_l1.envs import get_task
from torchrl_l1.experiment.errors import USER_ERRORS, message
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.recipes import group_setting
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.experiment.settings import RunSettings, compile_mode, l1_config
from torchrl_l1.experiment.stages import STAGES
from torchrl_l1.experiment.tracking import check_mode


def plan(campaign: Campaign, output: Path) -> list[PlannedRun]:
    """All runs of a campaign, in the order in which they are to be started.

    The first seed of every cell comes before the second of any, so that a campaign that is
    stopped early has compared everything with everything.

    Args:
        campaign: the campaign.
        output: its folder.

    Raises:
        CampaignError: for an unknown recipe or option, a setting out of range, an evaluation that
            matches no run, or two runs that would share a directory.
        RunDirectoryError: if a run directory holds a run of another configuration.
    """
    runs: list[PlannedRun] = []
    for i, matrix in enumerate(campaign.runs):
        try:
            runs += _runs(i, matrix, output.resolve())
        except USER_ERRORS as error:
            raise CampaignError(f"{campaign.file}: runs[{i}]: {message(error)}") from error
    for path, count in Counter(run.directory.path for run in runs).items():
        if count > 1:
            raise CampaignError(
                f"{campaign.file}: {count} runs would share {path}; let a key of their matrices "
                "tell them apart"
            )
    _add_evaluations(campaign, runs)
    for run in runs:
        run.check_directory()
    return sorted(runs, key=lambda run: run.round)


def cells(matrix: RunMatrix) -> Iterator[dict[str, str]]:
    """Every combination of a matrix' values but the seed, as texts by key."""
    keys = [key for key in matrix.matrix if key != "seed"]
    for values in product(*(matrix.matrix[key] for key in keys)):
        yield dict(zip(keys, map(value_text, values), strict=True))


def _runs(index: int, matrix: RunMatrix, output: Path) -> Iterator[PlannedRun]:
    recipe = matrix.recipe
    for cell in cells(matrix):
        place = [f"{key}={text}" for key, text in cell.items()]
        folder = output.joinpath(recipe_name(recipe), *place)
        config = compose(recipe, [*matrix.overrides, *place, f"run_dir={quoted(folder)}"])
        _check(config)
        for round_, seed in enumerate(matrix.matrix["seed"]):
            own = config.copy()
            own.seed = seed
            own.run_dir = str(folder / f"seed_{seed}")
            yield PlannedRun(
                {"recipe": recipe_name(recipe), **cell, "seed": str(seed)},
                index,
                round_,
                RunDirectory(own.run_dir),
                own,
            )


def _check(config: DictConfig) -> None:
    recipe = OmegaConf.to_object(config)
    if not isinstance(recipe, RunSettings):
        raise ValueError(
            "the recipe has no schema; put that of its algorithm, such as metrpo_recipe, first in "
            "its defaults"
        )
    get_task(recipe.task)
    l1_config(recipe.l1, recipe.task)
    compile_mode(recipe.l1.compile)
    check_mode(recipe.wandb.mode)


def check_devices(campaign: Campaign, runs: Sequence[PlannedRun]) -> None:
    """Make sure that this machine can train the runs that are not finished.

    Raises:
        CampaignError: if a device is not there.
    """
    for run in runs:
        if run.finished():
            continue  # evaluations need no other device than the CPU
        try:
            resolve_device(run.config.device)
        except ValueError as error:
            raise CampaignError(f"{campaign.file}: runs[{run.matrix}]: {error}") from error


def _add_evaluations(campaign: Campaign, runs: Sequence[PlannedRun]) -> None:
    for i, settings in enumerate(campaign.evaluations):
        place = f"{campaign.file}: evaluations[{i}] ({settings.name})"
        try:
            for group in ("l1", "noise"):
                for option in getattr(settings, group):
                    group_setting(group, option)
        except ValueError as error:
            raise CampaignError(f"{place}: {error}") from error
        chosen = list(runs)
        for key, values in settings.where.items():
            found = {run.values[key] for run in runs if key in run.values}
            for text in map(value_text, values):
                if text not in found:
                    raise CampaignError(
                        f"{place}: no run has {key}={text}; there are "
                        + (", ".join(sorted(found)) or f"none with a {key} in their matrix")
                    )
            texts = set(map(value_text, values))
            chosen = [run for run in chosen if run.values.get(key) in texts]
        if not chosen:
            raise CampaignError(f"{place}: no run has all of where")
        for run in chosen:
            _check_stages(place, run, settings.stage)
            if any(other.name == settings.name for other in run.evaluations):
                raise CampaignError(
                    f"{place}: another evaluation of this name is for {run} too; give it another "
                    "name or a narrower where"
                )
            run.evaluations.append(settings)


def _check_stages(place: str, run: PlannedRun, asked: Sequence[str]) -> None:
    every, reached = STAGES[run.config.algorithm], run.stages()
    for name in asked:
        if name not in every:
            raise CampaignError(
                f"{place}: {run} has no stage {name!r}; the stages of its algorithm are "
                f"{', '.join(every)}"
            )
        if name not in reached:
            raise CampaignError(
                f"{place}: with outer_iterations={run.iterations} {run} does not reach the stage "
                f"{name!r}, only {', '.join(reached)}; raise outer_iterations"
            )
