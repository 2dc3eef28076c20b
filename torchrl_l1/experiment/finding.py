"""Finding run directories."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

from torchrl_l1.experiment.run_directory import RunDirectoryError


def run_directories(folder: Path) -> Iterator[tuple[Path, dict[str, Any] | RunDirectoryError]]:
    """Every run directory in or below a folder, with its configuration or why that is unreadable.

    Folders come in alphabetical order; hidden ones, and those that are links, are left out.
    """
    for path, below, files in os.walk(folder):
        below[:] = sorted(name for name in below if not name.startswith("."))
        if "config.yaml" not in files:
            continue
        config: dict[str, Any] | RunDirectoryError
        try:
            config = read_config(Path(path) / "config.yaml")
        except RunDirectoryError as error:
            config = error
        # Any tool may keep a config.yaml; a run's says which task and which seed.
        if isinstance(config, RunDirectoryError) or ("task" in config and "seed" in config):
            below.clear()
            yield Path(path), config


def read_config(file: Path) -> dict[str, Any]:
    """A configuration; empty if the file holds something else than keys and values.

    Raises:
        RunDirectoryError: if the file cannot be read.
    """
    try:
        config = OmegaConf.to_container(OmegaConf.load(file))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise RunDirectoryError(f"cannot read {file}: {error}") from error
    return {str(k): v for k, v in config.items()} if isinstance(config, dict) else {}
