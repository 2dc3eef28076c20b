from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.experiment.launch import compose

VERSIONS = {"python": "3.12.1", "torch": "2.13.0", "torchrl": "0.14.1"}

WriteRun = Callable[..., Path]


@cache
def composed(recipe: str, overrides: tuple[str, ...]) -> DictConfig:
    return compose(recipe, [*overrides, "run_dir=unused"])


def write_rows(file: Path, rows: Sequence[dict[str, Any]]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def run_directory(
    path: Path,
    returns: Sequence[float],
    *overrides: str,
    recipe: str = "metrpo/inverted_pendulum",
    seed: int = 0,
    deterministic: Sequence[float] | None = None,
    iterations: int | None = None,
    steps: int = 2500,
    evaluations: dict[str, list[dict[str, Any]]] | None = None,
    signals: dict[str, Sequence[float]] | None = None,
    timings: Sequence[dict[str, float]] | None = None,
) -> Path:
    """A run directory with these returns, one per outer iteration."""
    path.mkdir(parents=True)
    config = composed(recipe, overrides).copy()
    config.seed = seed
    config.run_dir = str(path)
    config.outer_iterations = iterations or len(returns)
    (path / "config.yaml").write_text(OmegaConf.to_yaml(config, resolve=True))
    (path / "versions.json").write_text(json.dumps(VERSIONS))
    means = list(returns if deterministic is None else deterministic)
    rows = [
        {"iteration": i, "real_steps": (i + 2) * steps, "return_mean": value,
         "return_std": 1.0, "return_deterministic": means[i], "policy/std": 0.5,
         **{name: values[i] for name, values in (signals or {}).items()}}
        for i, value in enumerate(returns)
    ]  # fmt: skip
    if rows:
        write_rows(path / "metrics.csv", rows)
    if timings:
        write_rows(path / "timing.csv", timings)
    for name, tests in (evaluations or {}).items():
        write_rows(path / "evaluations" / f"{name}.csv", tests)
    return path


@pytest.fixture
def write_run(tmp_path: Path) -> WriteRun:
    """Writes a run directory below ``tmp_path / 'runs'``, each in a folder of its own."""

    def write(returns: Sequence[float], *overrides: str, name: str = "", **options: Any) -> Path:
        folder = tmp_path / "runs"
        number = len(list(folder.rglob("config.yaml")))
        path = folder / (name or f"run_{number:03}")
        return run_directory(path, np.asarray(returns, dtype=float).tolist(), *overrides, **options)

    return write
