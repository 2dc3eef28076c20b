"""Weights & Biases: one run per run directory, one dictionary per outer iteration."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import wandb

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
        check_mode(mode)
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


def check_mode(mode: str) -> None:
    """Raise a ``ValueError`` for an unknown mode."""
    if mode not in MODES:
        raise ValueError(f"wandb.mode must be one of {', '.join(MODES)}, got {mode!r}")
