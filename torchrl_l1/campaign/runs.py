"""One run of a campaign: where it is and how far it has got."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_l1.campaign.settings import EvaluationSettings
from torchrl_l1.experiment.run_directory import RunDirectory, RunDirectoryError


@dataclass
class PlannedRun:
    """One run of a campaign.

    Attributes:
        recipe: as ``torchrl-l1 run`` takes it.
        overrides: all but the run directory.
        values: the run's place in the matrix, as texts, with ``recipe``.
        matrix: the position of its matrix in the campaign.
        round: the position of its seed in the matrix.
        directory: its run directory.
        config: composed, with seed and run directory.
        evaluations: what is to be evaluated once it is finished.
    """

    recipe: str
    overrides: list[str]
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

    def iterations_done(self) -> int:
        """Outer iterations so far; all of them only once the run is sure to be finished."""
        if not self.directory.checkpoint_file.exists():
            return 0
        try:
            text = self.directory.metrics_file.read_text(encoding="utf-8")
        except FileNotFoundError:
            return 0
        return min(max(len(text.splitlines()) - 1, 0), self.iterations)

    def finished(self) -> bool:
        """Whether all outer iterations are done."""
        return self.iterations_done() >= self.iterations

    def check_directory(self) -> None:
        """Make sure that the run directory, if it holds a run, holds this one.

        Raises:
            RunDirectoryError: if it holds a run of another configuration.
        """
        if not self.directory.config_file.exists():
            return
        settings: Any = OmegaConf.to_container(self.config, resolve=True, throw_on_missing=True)
        try:
            self.directory.check_same(settings)
        except RunDirectoryError as error:
            raise RunDirectoryError(
                f"{error}\nThe campaign was started with other settings; with --output it gets a "
                "folder of its own."
            ) from error


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
