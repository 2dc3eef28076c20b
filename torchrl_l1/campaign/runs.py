"""One run of a campaign: where it is and how far it has got."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_l1.campaign.settings import EvaluationSettings
from torchrl_l1.envs import get_task
from torchrl_l1.experiment.run_directory import RunDirectory, RunDirectoryError
from torchrl_l1.experiment.settings import RunSettings


@dataclass
class PlannedRun:
    """One run of a campaign.

    Attributes:
        values: the run's place in the matrix, as texts, with ``recipe``.
        matrix: the position of its matrix in the campaign.
        round: the position of its seed in the matrix.
        directory: its run directory.
        config: composed, with seed and run directory.
        evaluations: what is to be evaluated once it is finished.
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
        """Outer iterations in all."""
        return int(self.config.outer_iterations)

    def collected_steps(self, iterations: int) -> int:
        """Real steps that so many outer iterations collect; random data do not count."""
        full = self.config.horizon or get_task(self.config.task).horizon
        steps = min(self.config.episode_steps or full, full)
        return self._recipe.collected_episodes(iterations) * int(steps)

    def stages(self) -> tuple[str, ...]:
        """The stages that the run has reached once it is finished."""
        return self._recipe.stages()

    @cached_property
    def _recipe(self) -> RunSettings:
        recipe = OmegaConf.to_object(self.config)
        assert isinstance(recipe, RunSettings)
        return recipe

    def iterations_done(self) -> int:
        """Outer iterations so far; all of them only once the run is sure to be finished."""
        return min(self.directory.iterations_done(), self.iterations)

    def finished(self) -> bool:
        """Whether all outer iterations are done."""
        return self.iterations_done() >= self.iterations

    def settings(self) -> dict[str, Any]:
        """The configuration as plain dictionaries, lists and values."""
        settings: Any = OmegaConf.to_container(self.config, resolve=True, throw_on_missing=True)
        return {str(key): value for key, value in settings.items()}

    def check_directory(self) -> None:
        """Make sure that the run directory, if it holds a run, holds this one.

        Raises:
            RunDirectoryError: if it holds a run of another configuration.
        """
        if not self.directory.config_file.exists():
            return
        try:
            self.directory.check_same(self.settings())
        except RunDirectoryError as error:
            raise RunDirectoryError(
                f"{error}\nThe campaign or its recipe has changed since that run was started; with "
                "--output the campaign gets a folder of its own."
            ) from error

    def problem(self) -> str | None:
        """What keeps the run from being finished as planned; ``None`` if it is."""
        if not self.finished():
            return f"{self} has {self.iterations_done()} of {self.iterations} iterations"
        try:
            self.check_directory()
        except RunDirectoryError as error:
            return str(error)
        return None


def recipe_name(recipe: str) -> str:
    """The name of a recipe, for folders and for ``where``: that of the file if it is a user's."""
    return Path(recipe).stem if recipe.endswith(".yaml") else recipe


def quoted(path: Path) -> str:
    """A path as the value of a Hydra override.

    Examples:
        >>> quoted(Path("runs/l1=off"))
        "'runs/l1=off'"
    """
    return "'" + str(path).replace("'", "\\'") + "'"
