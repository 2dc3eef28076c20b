"""Evaluating frozen policies: L1 off and on, under noise and disturbances."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from tensordict import TensorDict

from torchrl_l1.algorithms import Algorithm
from torchrl_l1.algorithms.collection import (
    ORACLE,
    Collection,
    episode_lengths,
    episode_returns,
    first_episodes,
    return_metrics,
    signal_metrics,
)
from torchrl_l1.algorithms.policy import kinds_of
from torchrl_l1.control import L1Config
from torchrl_l1.control.config import follows_input
from torchrl_l1.dynamics import calibrate_filter
from torchrl_l1.dynamics.validation import one_step_residuals
from torchrl_l1.envs import (
    DISTURBANCES,
    AnyTask,
    ExternalTask,
    Perturbation,
    Task,
    environment_source,
)
from torchrl_l1.envs.factory import acting_on
from torchrl_l1.experiment.checkpoints import KEPT, kept_by, load_state, single_precision
from torchrl_l1.experiment.errors import RunDirectoryError, fitting_into_memory, message
from torchrl_l1.experiment.files import digest, read_text
from torchrl_l1.experiment.l1_options import (
    UNTUNED,
    closest_option,
    is_tuned,
    l1_option,
    same_controller,
)
from torchrl_l1.experiment.matrix import Condition, disturbed
from torchrl_l1.experiment.recipes import group_setting
from torchrl_l1.experiment.run_directory import RunDirectory, read_config
from torchrl_l1.experiment.settings import L1Settings, RunSettings, l1_config, schema_of


@dataclass
class TrainedRun:
    """A finished or running training, loaded for evaluation.

    Attributes:
        path: the run directory.
        recipe: its settings.
        algorithm: the algorithm with the state of a checkpoint.
        checkpoint: name of a kept checkpoint; empty for the last.
    """

    path: Path
    recipe: RunSettings
    algorithm: Algorithm
    checkpoint: str = ""

    @property
    def name(self) -> str:
        """The run as users name it: its directory, or the file of the kept checkpoint."""
        return str(self.path / KEPT / f"{self.checkpoint}.pt" if self.checkpoint else self.path)

    def stage(self, name: str | None) -> str:
        """The name of a stage that the run has reached; of the last one if ``None``.

        Raises:
            ValueError: if there is no such stage (yet), naming the run and its stages.
        """
        reached = list(self.algorithm.policies)
        if name is None:
            return reached[-1]
        if name not in reached:
            there = "there are" if len(reached) > 1 else "there is"
            raise ValueError(f"{self.path}: no stage {name!r} so far; {there} {', '.join(reached)}")
        return name


def load_run(path: str | Path, *, last: bool = False) -> TrainedRun:
    """Load recipe, model and policy of a run directory.

    Args:
        path: the directory, or one of its kept checkpoints, such as
            ``RUN_DIR/checkpoints/best.pt``.
        last: whether to insist on the last checkpoint, even if only the one before it is readable.

    Raises:
        RunDirectoryError: if the directory holds no run or no readable checkpoint.
    """
    kept = kept_by(Path(path))
    directory = RunDirectory(path if kept is None else kept)
    if not directory.config_file.exists():
        raise RunDirectoryError(
            f"{directory.path} holds no run: there is no {directory.config_file.name}"
        )
    checkpoint = directory.load_checkpoint() if kept is None else directory.load_kept(Path(path))
    if checkpoint is not None and last and not directory.last_is_good:
        raise RunDirectoryError(
            f"{directory.checkpoint_file} cannot be read; resume the run, which rewrites it"
        )
    if checkpoint is None:
        raise RunDirectoryError(f"the run in {path} has no checkpoint yet; let it finish first")
    recipe = _recipe(directory)
    state = checkpoint["algorithm"]
    with single_precision():
        with fitting_into_memory(str(path)):
            algorithm = recipe.build_on_cpu()
        file = directory.checkpoint_file if kept is None else Path(path)
        load_state(algorithm, {**state, "buffer": {}}, file)
        _measure_residuals(algorithm, state.get("buffer", {}))
    return TrainedRun(directory.path, recipe, algorithm, Path(path).stem if kept else "")


def _recipe(directory: RunDirectory) -> RunSettings:
    stored = read_config(directory.config_file)
    try:
        schema = OmegaConf.structured(schema_of(stored))
        recipe = OmegaConf.to_object(OmegaConf.merge(schema, _literal(stored)))
        assert isinstance(recipe, RunSettings)
        return recipe
    # A damaged file may hold anything: errors of OmegaConf and dataclasses have no common class.
    except Exception as error:
        raise RunDirectoryError(f"cannot use {directory.config_file}: {message(error)}") from error


def _literal(value: Any) -> Any:
    """Settings escaped for OmegaConf: interpolations were resolved for the run."""
    if isinstance(value, dict):
        return {key: _literal(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_literal(inner) for inner in value]
    if isinstance(value, str):
        return re.sub(r"(\\*)\$\{", r"\1\1\\${", value)
    return value


def _measure_residuals(algorithm: Algorithm, buffer: dict[str, Any]) -> None:
    """Calibrate, on the run's own data, what training without a Kalman filter has not measured."""
    dynamics, task = algorithm.acting_dynamics, algorithm.task
    if not buffer:
        return
    data = TensorDict(buffer).auto_batch_size_(1)
    action_key = algorithm.learning.action_key
    held_out = data[data["validation"].reshape(-1)]
    if not bool(dynamics.residuals.measured) and held_out.shape[0]:
        held_out = held_out.set("action", held_out[action_key])
        moved = held_out["next", "observation"] - held_out["observation"]
        dynamics.residuals.measure(one_step_residuals(dynamics, held_out), moved)
    if bool(dynamics.residuals.calibrated):
        return
    config = L1Config.robust(task.dt, action_low=task.action_low, action_high=task.action_high)
    calibrate_filter(dynamics.residuals, dynamics.value_and_jacobian, data, config, action_key)


def distinct(trained: TrainedRun, cells: Sequence[Condition]) -> list[Condition]:
    """The conditions that are distinct for a run, with the names of their stages.

    Sampled and mean actions of a planner are the same, and ``epsilon`` makes no difference to a
    controller whose operating point follows the executed input. Of conditions that differ in
    nothing else, only the first is kept.

    Raises:
        ValueError: for a stage that the run does not have.
    """
    found: dict[Condition, Condition] = {}
    for cell in cells:
        stage = trained.stage(cell.stage)
        named = replace(cell, stage=stage)
        if cell.epsilon is not None and _follows(trained, cell):
            named = replace(named, epsilon=None)
        both_ways = len(kinds_of(trained.algorithm.policies[stage])) > 1
        found.setdefault(named if both_ways else replace(named, policy=""), named)
    return list(found.values())


def evaluate(
    trained: TrainedRun,
    cells: Sequence[Condition],
    episodes: int,
    seed: int = 0,
) -> Iterator[dict[str, Any]]:
    """Returns of a frozen policy, one row per condition.

    Every condition sees the same resets and the same random numbers. Model and policy are
    those of the run's last checkpoint. ``own_l1`` is 1 if the controller is the one that the
    run was trained with, else 0; ``epsilon`` and ``alpha`` are those set by the condition, and
    ``steps_mean`` is the mean length of the episodes. If an algorithm has several stages,
    ``stage`` names the tested one.

    Raises:
        ValueError: for a stage that the run does not have, before anything is evaluated.
    """
    for row, _ in evaluate_episodes(trained, cells, episodes, seed):
        yield row


def evaluate_episodes(
    trained: TrainedRun,
    cells: Sequence[Condition],
    episodes: int,
    seed: int = 0,
) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """As :func:`evaluate`, with the rows of the single episodes beside each row.

    Their columns are those of the condition, the run, and ``episode``, ``return`` and ``steps``,
    the length of the episode. Episodes of the same number start from the same reset in all
    conditions.

    Raises:
        ValueError: for a stage that the run does not have, or values that a controller does not
            take, before anything is evaluated.
    """
    check_plants(trained.algorithm.task, cells)
    check_controllers(trained.recipe.l1, trained.algorithm.task, cells)
    for cell in [replace(cell, stage=trained.stage(cell.stage)) for cell in cells]:
        with fitting_into_memory(f"an evaluation of {episodes} episodes"), single_precision():
            collection = make_collection(trained, cell, episodes)
            data = collection.evaluate(seed, deterministic=cell.policy == "deterministic")
        place = {
            "run": trained.name,
            "training_seed": trained.recipe.seed,
            **_columns(trained, cell),
        }
        returns, steps = episode_returns(data).tolist(), episode_lengths(data).tolist()
        row = {
            **place,
            "own_l1": int(_is_own(trained, cell)),
            **return_metrics(data),
            "steps_mean": sum(steps) / len(steps),
            **signal_metrics(first_episodes(data)),
        }
        yield (
            row,
            [
                {**place, "episode": number, "return": value, "steps": length}
                for number, (value, length) in enumerate(zip(returns, steps, strict=True))
            ],
        )


def check_plants(task: AnyTask, cells: Sequence[Condition]) -> None:
    """Refuse changes to a plant that cannot be modified.

    Raises:
        ValueError: naming disturbance and environment.
    """
    if not isinstance(task, ExternalTask):
        return
    for cell in cells:
        changed = disturbed(cell.disturbances)
        task.check_disturbances([n for n in changed if DISTURBANCES[n].of_plant])


def check_controllers(own: L1Settings, task: AnyTask, cells: Sequence[Condition]) -> None:
    """Refuse values that a controller does not take, such as ``alpha`` for a filter without it.

    Args:
        own: the controller of the run.
        task: its task.
        cells: the conditions to test.

    Raises:
        ValueError: naming the controller.
    """
    for cell in {cell.controller: cell for cell in cells if cell.l1 != ORACLE}.values():
        try:
            l1_config(_tested_l1(own, task, cell), task)
        except ValueError as error:
            raise ValueError(f"L1 {cell.controller}: {error}") from error


def reachable(trained: TrainedRun, cells: Sequence[Condition]) -> list[Condition]:
    """The conditions of a suite that can act on the task of a run."""
    task = trained.algorithm.task
    if isinstance(task, Task):
        source = environment_source(task)
    elif isinstance(task, ExternalTask):
        source = task.source
    else:
        return list(cells)
    can_act = acting_on(source, trained.algorithm.horizon)
    return [cell for cell in cells if can_act(disturbed(cell.disturbances))]


def episodes_file(table: Path) -> Path:
    """The file with the single episodes of a table in ``RUN_DIR/evaluations``."""
    return table.parent / "episodes" / table.name


def table_checksums(table: Path) -> dict[str, str]:
    """Digests of a table in ``RUN_DIR/evaluations`` and of its episodes, if they exist.

    Raises:
        OSError: if one cannot be read.
        ValueError: if one is not text.
    """
    files = {"table": table, "episodes": episodes_file(table)}
    return {name: digest(read_text(file)) for name, file in files.items() if file.exists()}


def make_collection(trained: TrainedRun, cell: Condition, episodes: int) -> Collection:
    """The environments of one condition around the frozen policy and model."""
    task = trained.algorithm.task
    settings = None if cell.l1 == ORACLE else _tested_l1(trained.recipe.l1, task, cell)
    disturbances = {DISTURBANCES[name].setting: value for name, value in cell.disturbances.items()}
    perturbation = Perturbation(**group_setting("noise", cell.noise), **disturbances)
    return Collection(
        task,
        episodes,
        trained.algorithm.policies[trained.stage(cell.stage)],
        trained.algorithm.acting_dynamics,
        ORACLE if settings is None else l1_config(settings, task),
        perturbation,
        trained.recipe.horizon,
    )


def _columns(trained: TrainedRun, cell: Condition) -> dict[str, Any]:
    columns = cell.columns()
    if not trained.algorithm.facts.named_stages:
        del columns["stage"]  # there is no choice, and so nothing to name
    return columns


def _is_own(trained: TrainedRun, cell: Condition) -> bool:
    """Whether a test's controller is the one that the run was trained with."""
    if cell.l1 == ORACLE:
        return False
    own, task = trained.recipe.l1, trained.algorithm.task
    return same_controller(_tested_l1(own, task, cell), own, task)


def _follows(trained: TrainedRun, cell: Condition) -> bool:
    """Whether the operating point of a test's controller follows the executed input."""
    if cell.l1 in UNTUNED:
        return False
    settings = _tested_l1(trained.recipe.l1, trained.algorithm.task, cell)
    return follows_input(settings.filter)


def _tested_l1(own: L1Settings, task: AnyTask, cell: Condition) -> L1Settings:
    """The controller of a test.

    For the option that the run was trained with, however tuned, it is the run's own. Any other is
    as shipped, with the run's epsilon if it has one. The values of the condition override either.
    """
    if cell.l1 == closest_option(own, task):
        settings = own
    else:
        settings = l1_option(cell.l1)
        if is_tuned(cell.l1):
            settings = replace(settings, epsilon=own.epsilon)
    tuned: dict[str, Any] = {k: v for k, v in cell.tuning.items() if v is not None}
    if "alpha" in tuned:
        tuned["cutoff"] = None  # two ways to give one number
    return replace(settings, **tuned)
