"""Running a recipe: from a resolved configuration to a finished run directory, logged."""

from __future__ import annotations

import hashlib
import logging
import os
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
import wandb
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from torchrl_l1.algorithms import Algorithm
from torchrl_l1.algorithms.algorithm import Diverged, IterationResult
from torchrl_l1.experiment.checkpoints import checkpoint_of, load_state
from torchrl_l1.experiment.errors import RunDirectoryError, fitting_into_memory
from torchrl_l1.experiment.files import refuse_link, write_atomically
from torchrl_l1.experiment.run_directory import RunDirectory, versions
from torchrl_l1.experiment.settings import RunSettings, check_known
from torchrl_l1.experiment.signals import RESUME_ME, asked_to_make_room

MODES = ("auto", "online", "offline", "disabled")


class Tracker:
    """Thin wrapper that chooses the mode and keeps a resumed run under its first id.

    Args:
        mode: ``auto`` is online when an API key is configured and offline otherwise.
        project: W&B project.
        config: the full resolved configuration, with versions.
        directory: where W&B puts its files.
        run_id: identifier of the run, the same before and after a resume.

    Raises:
        ValueError: for an unknown mode.
    """

    def __init__(
        self, mode: str, project: str, config: Mapping[str, Any], directory: Path, run_id: str
    ) -> None:
        check_wandb_mode(mode)
        if mode == "auto":
            # An explicit WANDB_MODE, as users set it on clusters, has the last word.
            mode = os.environ.get("WANDB_MODE") or ("online" if _logged_in() else "offline")
        self._run = wandb.init(
            mode=mode,  # type: ignore[arg-type]
            project=project,
            config=dict(config),
            dir=str(directory),
            id=run_id,
            name=str(config.get("recipe", "run")) + f" seed {config.get('seed')}",
            resume="allow" if mode == "online" else None,
            settings=wandb.Settings(silent=True, console="off"),
        )

    def log(self, metrics: Mapping[str, Any], timing: Mapping[str, Any]) -> None:
        """Log one outer iteration as one dictionary."""
        seconds = {f"seconds/{phase}": value for phase, value in timing.items()}
        del seconds["seconds/iteration"]
        self._run.log({**metrics, **seconds}, step=int(metrics["iteration"]))

    def close(self) -> None:
        """Flush and close."""
        self._run.finish()


def _logged_in() -> bool:
    try:
        return bool(wandb.login(prompt=False))
    except wandb.errors.Error:
        # A key without a network that would accept it: nothing is lost offline.
        return False


def check_wandb_mode(mode: str) -> None:
    """Raise a ``ValueError`` for an unknown mode."""
    if mode not in MODES:
        raise ValueError(f"wandb.mode must be one of {', '.join(MODES)}, got {mode!r}")


def run(config: DictConfig) -> Path:
    """Run or resume a recipe.

    Args:
        config: composed by Hydra from a recipe.

    Returns:
        the run directory.

    Raises:
        RunDirectoryError: if the run directory holds another run.
        ValueError: if settings contradict each other; nothing has been written then.
    """
    check_known(config)
    resolved = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(resolved, dict)
    recipe = OmegaConf.to_object(config)
    assert isinstance(recipe, RunSettings)
    settings = {str(key): value for key, value in resolved.items()}
    check_wandb_mode(recipe.wandb.mode)
    torch.set_num_threads(recipe.threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    progress = tqdm(
        total=recipe.outer_iterations,
        desc=f"{recipe.recipe} seed {recipe.seed}",
        unit="iteration",
        disable=None,
    )
    with progress:
        with fitting_into_memory(recipe.recipe):
            algorithm = recipe.build()
        algorithm.on_phase = lambda phase: progress.set_postfix_str(phase)
        directory = RunDirectory(recipe.run_dir)
        refuse_link(directory.path / "wandb")
        with directory.open(settings, recipe.resume):
            _run(algorithm, recipe, settings, directory, progress)
    print(f"Finished: {directory.metrics_file}")
    return directory.path


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
            # A kill has come between the checkpoint and the files made from it, or they changed.
            restored = directory.restore_results(algorithm.weights(), rows, timings)
            if restored:
                names = ", ".join(restored)
                progress.write(f"{directory.path}: written again from the checkpoint: {names}")
        if len(rows) >= recipe.outer_iterations:
            progress.write(f"{directory.path} is complete: nothing to do")
            return
    run_id = hashlib.sha256(str(directory.path.resolve()).encode()).hexdigest()[:12]
    tracker = Tracker(
        recipe.wandb.mode,
        recipe.wandb.project,
        {**settings, "versions": versions(), "choices": dict(algorithm.choices())},
        directory.path,
        run_id,
    )
    choices = (f"{name} {value}" for name, value in algorithm.choices().items())
    progress.write(f"{recipe.recipe}: {', '.join(choices)}")
    with closing(tracker):
        if rows:
            # A kill may have come between the last checkpoint and its log entry.
            tracker.log(rows[-1], timings[-1])
        try:
            for result in algorithm.iterate():
                _save(result, algorithm, settings, directory, rows, timings)
                tracker.log(rows[-1], timings[-1])
                progress.update()
                progress.write(
                    f"iteration {len(rows) - 1}: {result.metrics['real_steps']} real steps, "
                    f"return {result.metrics['return_mean']:.2f} "
                    f"(deterministic {result.metrics['return_deterministic']:.2f})"
                )
                for error in result.diverged:
                    progress.write(f"on_divergence=warn: {error}")
                if asked_to_make_room() and len(rows) < recipe.outer_iterations:
                    progress.write(f"{directory.path}: saved; go on with --resume")
                    sys.exit(RESUME_ME)
        except Diverged as error:
            directory.mark_diverged(str(error), rows)
            raise RunDirectoryError(
                f"{directory.path}: {error}; the checkpoint of {len(rows)} iterations stays, and "
                "on_divergence=warn goes on all the same"
            ) from error


def _save(
    result: IterationResult,
    algorithm: Algorithm,
    settings: dict[str, Any],
    directory: RunDirectory,
    rows: list[dict[str, Any]],
    timings: list[dict[str, Any]],
) -> None:
    """Write what an outer iteration has led to."""
    marks = {"diverged": len(result.diverged)} if result.diverged else {}
    rows.append({**result.metrics, **marks})
    timings.append({"iteration": result.metrics["iteration"], **result.seconds})
    directory.save_checkpoint(checkpoint_of(algorithm.state_dict(), rows, timings, settings))
    directory.write_results(algorithm.weights(), rows, timings)
    if result.diverged:
        write_atomically(directory.diverged_file, f"{result.diverged[0]}\n")
    elif not any("diverged" in row for row in rows):
        directory.diverged_file.unlink(missing_ok=True)
