"""Running a recipe: from a resolved configuration to a finished run directory, logged."""

from __future__ import annotations

import csv
import logging
import math
import sys
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from torchrl_l1.algorithms import Algorithm
from torchrl_l1.algorithms.algorithm import Diverged, IterationResult
from torchrl_l1.experiment.checkpoints import (
    checkpoint_of,
    keep_checkpoints,
    load_state,
    single_precision,
)
from torchrl_l1.experiment.errors import RunDirectoryError, fitting_into_memory
from torchrl_l1.experiment.files import refuse_link
from torchrl_l1.experiment.provenance import versions
from torchrl_l1.experiment.run_directory import RunDirectory, read_config
from torchrl_l1.experiment.settings import RunSettings, check_known, schema_of
from torchrl_l1.experiment.shutdown import RESUME_ME, asked_to_make_room
from torchrl_l1.experiment.tracking import check_loggers, lacks, trackers


def run(config: DictConfig) -> Path:
    """Run or resume a recipe.

    Args:
        config: composed by Hydra from a recipe.

    Returns:
        the run directory.

    Raises:
        RunDirectoryError: if the run directory holds another run.
        ValueError: if settings contradict each other; nothing is written in this case.
    """
    check_known(config)
    resolved = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(resolved, dict)
    recipe = OmegaConf.to_object(config)
    assert isinstance(recipe, RunSettings)
    settings = {str(key): value for key, value in resolved.items()}
    check_loggers(recipe)
    torch.set_num_threads(recipe.threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    progress = tqdm(
        total=recipe.outer_iterations,
        desc=f"{recipe.recipe} seed {recipe.seed}",
        unit="iteration",
        disable=None,
    )
    with progress, single_precision():
        with fitting_into_memory(recipe.recipe):
            algorithm = recipe.build()
        algorithm.on_phase = lambda phase: progress.set_postfix_str(phase)
        directory = RunDirectory(recipe.run_dir)
        for folder in ("wandb", "tensorboard", "checkpoints"):
            refuse_link(directory.path / folder)
        directory.check_open(settings, recipe.resume)
        if not (recipe.resume and directory.checkpoint_file.exists()):
            algorithm.prepare()
        with directory.open(settings, recipe.resume), fitting_into_memory(recipe.recipe):
            _run(algorithm, recipe, settings, directory, progress)
    print(f"Finished: {directory.metrics_file}")
    return directory.path


def final_return(run_dir: str | Path) -> float:
    """Return of a run by the paper's rule: the mean over the last outer iterations.

    With several stages, only those of the last stage count. NaN if there are none yet.

    Args:
        run_dir: a run directory.
    """
    directory = RunDirectory(run_dir)
    with directory.metrics_file.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        return math.nan
    facts = schema_of(read_config(directory.config_file)).builds.facts
    # With a single stage, metrics do not include it.
    position = int(rows[-1]["stage"]) - 1 if facts.named_stages else 0
    ending = [row for row in rows if row.get("stage") == rows[-1].get("stage")]
    returns = [float(row["return_mean"]) for row in ending[-facts.stages[position].window :]]
    return sum(returns) / len(returns)


def _run(
    algorithm: Algorithm,
    recipe: RunSettings,
    settings: dict[str, Any],
    directory: RunDirectory,
    progress: tqdm,
) -> None:
    rows: list[dict[str, Any]] = []
    timings: list[dict[str, Any]] = []
    checkpoint = directory.load_checkpoint(settings, progress.write)
    if checkpoint is not None:
        load_state(algorithm, checkpoint["algorithm"], directory.checkpoint_file)
        rows, timings = checkpoint["metrics"], checkpoint["timings"]
        progress.update(len(rows))
        if directory.last_is_good:
            # The run was killed between the checkpoint and the files made from it, or they changed.
            directory.tell_divergence(rows)
            keep_checkpoints(directory.checkpoint_file, recipe.checkpoint, rows, progress.write)
            restored = directory.restore_results(algorithm.weights(), rows, timings)
            if restored:
                names = ", ".join(restored)
                progress.write(f"{directory.path}: rewritten from the checkpoint: {names}")
        if len(rows) >= recipe.outer_iterations and not lacks(recipe, directory.path, rows):
            progress.write(f"{directory.path} is complete: nothing to do")
            return
    config = {**settings, "versions": versions(), "choices": dict(algorithm.choices())}
    choices = (f"{name} {value}" for name, value in algorithm.choices().items())
    progress.write(f"{recipe.recipe}: {', '.join(choices)}")
    with trackers(recipe, directory.path, config, rows, timings, progress.write) as loggers:
        try:
            for result in algorithm.iterate():
                _save(result, algorithm, recipe, settings, directory, rows, timings)
                for logger in loggers:
                    logger.log(rows[-1], timings[-1])
                progress.update()
                progress.write(
                    f"iteration {len(rows) - 1}: {result.metrics['real_steps']} real steps, "
                    f"return {result.metrics['return_mean']:.2f} "
                    f"(deterministic {result.metrics['return_deterministic']:.2f})"
                )
                for error in result.diverged:
                    progress.write(f"on_divergence=warn: {error}")
                if asked_to_make_room() and len(rows) < recipe.outer_iterations:
                    progress.write(f"{directory.path}: saved; continue with --resume")
                    sys.exit(RESUME_ME)
        except Diverged as error:
            directory.mark_diverged(str(error), rows)
            warn = ", and on_divergence=warn continues all the same" * error.may_go_on
            raise RunDirectoryError(
                f"{directory.path}: {error}; the checkpoint of {len(rows)} iterations is kept{warn}"
            ) from error


def _save(
    result: IterationResult,
    algorithm: Algorithm,
    recipe: RunSettings,
    settings: dict[str, Any],
    directory: RunDirectory,
    rows: list[dict[str, Any]],
    timings: list[dict[str, Any]],
) -> None:
    """Write the results of an outer iteration."""
    marks = {"diverged": len(result.diverged)} if result.diverged else {}
    rows.append({**result.metrics, **marks})
    timings.append({"iteration": result.metrics["iteration"], **result.seconds})
    directory.save_checkpoint(checkpoint_of(algorithm.state_dict(), rows, timings, settings))
    directory.tell_divergence(rows, *map(str, result.diverged[:1]))
    keep_checkpoints(directory.checkpoint_file, recipe.checkpoint, rows)
    directory.write_results(algorithm.weights(), rows, timings)
