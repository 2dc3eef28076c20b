"""From a campaign file to its runs: settings composed and mistakes found before anything starts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torch.random import fork_rng

from torchrl_l1.algorithms.algorithm import resolve_device
from torchrl_l1.algorithms.config import episode_length
from torchrl_l1.campaign.description import (
    Campaign,
    CampaignError,
    EvaluationSettings,
    RunMatrix,
    value_text,
)
from torchrl_l1.envs import AnyTask
from torchrl_l1.experiment.checkpoints import single_precision
from torchrl_l1.experiment.datasets import check_dataset
from torchrl_l1.experiment.errors import (
    USER_ERRORS,
    RunDirectoryError,
    fitting_into_memory,
    message,
)
from torchrl_l1.experiment.evaluate import check_controllers, check_plants
from torchrl_l1.experiment.files import bounded, path_text
from torchrl_l1.experiment.l1_options import check_tested
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.experiment.recipes import group_setting
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.experiment.settings import SCHEMAS, RunSettings, check_known
from torchrl_l1.experiment.tracking import check_loggers


@dataclass
class PlannedRun:
    """One run of a campaign.

    Attributes:
        values: the run's place in the matrix, as texts, with ``recipe``.
        matrix: the position of its matrix in the campaign.
        round: the position of its seed in the matrix.
        directory: its run directory.
        config: the composed configuration, with seed and run directory.
        evaluations: the evaluations to make once it is finished.
    """

    values: dict[str, str]
    matrix: int
    round: int
    directory: RunDirectory
    config: DictConfig
    evaluations: list[EvaluationSettings] = field(default_factory=list)

    def __str__(self) -> str:
        """Recipe and place in the matrix, on one line."""
        place = [f"{key}={text}" for key, text in self.values.items() if key != "recipe"]
        return " ".join([self.values["recipe"], *place])

    @property
    def iterations(self) -> int:
        """Total number of outer iterations."""
        return int(self.config.outer_iterations)

    def collected_steps(self, iterations: int) -> int:
        """Number of real steps in so many outer iterations; random data do not count."""
        full = self.config.horizon or self.task.horizon
        steps = episode_length(self.config.get("episode_steps"), full)
        return self._recipe.collected_episodes(iterations) * steps

    def stages(self) -> tuple[str, ...]:
        """The stages that the run has reached once it is finished."""
        return self._recipe.stages()

    def check_controllers(self, cells: Sequence[Condition]) -> None:
        """Refuse values that a tested controller does not take.

        Raises:
            ValueError: naming the controller.
        """
        check_controllers(self._recipe.l1, self.task, cells)

    @cached_property
    def task(self) -> AnyTask:
        """The task of the run."""
        return self._recipe.real_task()

    @cached_property
    def _recipe(self) -> RunSettings:
        recipe = OmegaConf.to_object(self.config)
        assert isinstance(recipe, RunSettings)
        return recipe

    def iterations_done(self) -> int:
        """Outer iterations so far; all of them only once the run is certainly finished."""
        return min(self.directory.iterations_done(), self.iterations)

    def finished(self) -> bool:
        """Whether all outer iterations are done and their files are intact."""
        return self.iterations_done() >= self.iterations and self.directory.intact()

    def settings(self) -> dict[str, Any]:
        """The configuration as plain dictionaries, lists and values."""
        settings: Any = OmegaConf.to_container(self.config, resolve=True, throw_on_missing=True)
        return {str(key): value for key, value in settings.items()}

    def check_directory(self) -> None:
        """Make sure that the run directory holds no other run.

        Raises:
            RunDirectoryError: if it holds a run of another configuration.
        """
        if not self.directory.config_file.exists():
            return
        try:
            self.directory.check_same(self.settings())
        except RunDirectoryError as error:
            raise RunDirectoryError(
                f"{error}\nThe campaign or its recipe has changed since that run was started; use "
                "--output to give the campaign its own folder."
            ) from error

    def problem(self) -> str | None:
        """Why the run is not finished as planned; ``None`` if it is."""
        if not self.finished():
            done = self.iterations_done()
            if done >= self.iterations:
                return f"{self} has files that are not as they were written"
            return f"{self} has {done} of {self.iterations} iterations"
        try:
            self.check_directory()
        except RunDirectoryError as error:
            return str(error)
        return None


def recipe_name(recipe: str) -> str:
    """The name of a recipe for folders and ``where``; of a user's recipe, that of its file."""
    return Path(recipe).stem if recipe.endswith(".yaml") else recipe


def quoted(path: Path) -> str:
    """A path as the value of a Hydra override.

    Examples:
        >>> quoted(Path("runs/l1=off"))
        "'runs/l1=off'"
    """
    return "'" + str(path).replace("'", "\\'") + "'"


def plan(campaign: Campaign, output: Path, *, trusted: bool = False) -> list[PlannedRun]:
    """All runs of a campaign, in the order in which to start them.

    The first seed of every cell comes before the second of any, so that a campaign stopped early
    still compares all cells.

    Args:
        campaign: the campaign.
        output: its folder.
        trusted: whether the user's recipes may configure Hydra itself.

    Raises:
        CampaignError: for an unknown recipe or option, a setting out of range, an evaluation that
            matches no run, or two runs that would share a directory.
        RunDirectoryError: if a run directory holds a run of another configuration.
    """
    runs: list[PlannedRun] = []
    for i, matrix in enumerate(campaign.runs):
        try:
            runs += _runs(i, matrix, output.resolve(), trusted)
        except USER_ERRORS as error:
            raise CampaignError(f"{campaign.file}: runs[{i}]: {message(error)}") from error
    for path, count in Counter(run.directory.path for run in runs).items():
        if count > 1:
            raise CampaignError(
                f"{campaign.file}: {count} runs would share {path}; distinguish them by a key of "
                "their matrices"
            )
    _add_evaluations(campaign, runs)
    for run in runs:
        run.check_directory()
    return sorted(runs, key=lambda run: run.round)


def cells(matrix: RunMatrix) -> Iterator[dict[str, str]]:
    """Every combination of a matrix's values except the seed, as texts by key."""
    keys = [key for key in matrix.matrix if key != "seed"]
    for values in product(*(matrix.matrix[key] for key in keys)):
        yield dict(zip(keys, map(value_text, values), strict=True))


def levels(matrix: RunMatrix) -> list[list[str]]:
    """Names of folders, level by level: a run's path below the campaign's has one of each.

    Examples:
        >>> levels(RunMatrix("pets/swimmer", matrix={"l1": ["off", "paper"]}))
        [['pets'], ['swimmer'], ['l1=off', 'l1=paper'], ['seed_0']]
    """
    chosen = dict(matrix.matrix)
    seeds = [f"seed_{seed}" for seed in chosen.pop("seed")]
    recipe = [[part] for part in Path(recipe_name(matrix.recipe)).parts]
    places = [[path_text(f"{k}={value_text(v)}") for v in values] for k, values in chosen.items()]
    return [*recipe, *places, seeds]


def _runs(index: int, matrix: RunMatrix, output: Path, trusted: bool) -> Iterator[PlannedRun]:
    recipe = matrix.recipe
    for cell in cells(matrix):
        place = [f"{key}={text}" for key, text in cell.items()]
        folder = output.joinpath(recipe_name(recipe), *map(path_text, place))
        overrides = [*matrix.overrides, *place, f"run_dir={quoted(folder)}"]
        config = compose(recipe, overrides, trusted=trusted)
        _check(config)
        _check_varied(matrix, config)
        for round_, seed in enumerate(matrix.matrix["seed"]):
            own = config.copy()
            own.seed = seed
            own.run_dir = str(folder / f"seed_{seed}")
            values = {"recipe": recipe_name(recipe), **cell, "seed": str(seed)}
            run = PlannedRun(values, index, round_, RunDirectory(own.run_dir), own)
            if own.wandb.name is None:
                own.wandb.name = bounded(str(run))
            yield run


def _check(config: DictConfig) -> None:
    check_known(config)
    recipe = OmegaConf.to_object(config)
    assert isinstance(recipe, RunSettings)
    check_loggers(recipe)
    # Weights drawn here are not used; the global generator is left untouched.
    with fork_rng(devices=[]), single_precision(), fitting_into_memory(recipe.recipe):
        recipe.build_on_cpu()


def _check_varied(matrix: RunMatrix, config: DictConfig) -> None:
    """Refuse settings of L1 that would distinguish runs without it: they would all be the same."""
    for key, values in matrix.matrix.items():
        of_l1 = key.startswith("l1.") and key != "l1.enabled"
        if of_l1 and len(values) > 1 and not config.l1.enabled:
            raise CampaignError(
                f"matrix.{key} has no effect while L1 is off: turn it on with l1=paper in "
                "overrides, or move the runs without L1 to another matrix"
            )


def check_machine(campaign: Campaign, runs: Sequence[PlannedRun]) -> None:
    """Make sure that this machine can train the unfinished runs.

    Raises:
        CampaignError: if a device or a dataset is missing.
    """
    for run in runs:
        if run.finished():
            continue  # evaluations need no other device than the CPU, and no dataset
        try:
            resolve_device(run.config.device)
            if "dataset" in run.config and not run.directory.checkpoint_file.exists():
                check_dataset(run.config.dataset)
        except (FileNotFoundError, ValueError) as error:
            raise CampaignError(f"{campaign.file}: runs[{run.matrix}]: {error}") from error


def _add_evaluations(campaign: Campaign, runs: Sequence[PlannedRun]) -> None:
    for i, settings in enumerate(campaign.evaluations):
        place = f"{campaign.file}: evaluations[{i}] ({settings.name})"
        try:
            check_tested(settings.matrix["l1"])
            for option in settings.matrix["noise"]:
                group_setting("noise", option)
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
            raise CampaignError(f"{place}: no run matches all of where")
        for run in chosen:
            _check_stages(place, run, settings.matrix["stage"])
            try:
                run.check_controllers(settings.conditions())
                if settings.suite is None:  # disturbances of a suite that cannot act are left out
                    check_plants(run.task, settings.conditions())
            except ValueError as error:
                raise CampaignError(f"{place}: {error}") from error
            if any(other.name == settings.name for other in run.evaluations):
                raise CampaignError(
                    f"{place}: another evaluation of this name is also for {run}; give it another "
                    "name or a narrower where"
                )
            run.evaluations.append(settings)


def _check_stages(place: str, run: PlannedRun, asked: Sequence[str]) -> None:
    every = SCHEMAS[run.config.algorithm].builds.facts.stage_names
    reached = run.stages()
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
