"""What a report over hundreds of runs takes: ``python -m benchmarks.report_runs [--runs 300]``.

With ``--training`` the runs have no evaluations, whose figures are most of a report.

The runs are copies of one tiny training, varied as those of a large study would be: tasks, L1,
noise and seeds, 33 iterations each, a table of evaluations with the returns of single episodes.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.campaign.evaluation import evaluate_run
from torchrl_l1.experiment.files import digest, table_text
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.run import run

RUNS, ITERATIONS = 300, 33
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
L1 = ("off", "paper", "robust")
NOISES = ("none", "action")

_TINY = [
    *("outer_iterations=2", "episodes_per_iteration=2", "horizon=15", "trpo_iterations=2"),
    *("imagined_steps=100", "imagined_horizon=10", "model.members=2", "model.hidden=[8]"),
    *("policy.hidden=[8]", "fit.max_epochs=2", "fit.batch_size=16", "l1=paper"),
    *("fit.validation_fraction=0.3", "wandb.mode=disabled"),
]
_EVALUATION = {"l1": ["off", "paper", "oracle"], "bias": [0.0, 0.5, 1.0], "episodes": 10}


def make_runs(folder: Path, count: int) -> None:
    """Write so many run directories.

    Args:
        folder: where to.
        count: how many; the seeds of every task, L1 and noise are as many as are needed.
    """
    with tempfile.TemporaryDirectory() as place:
        source = run(compose("metrpo/inverted_pendulum", [*_TINY, f"run_dir={place}/run"]))
        evaluate_run(str(source), "robustness", _EVALUATION)
        tables = {
            str(file.relative_to(source)): _rows(file)
            for file in (source / name for name in _TABLES)
        }
        versions = (source / "versions.json").read_text()
    rng = np.random.default_rng(0)
    studies = list(product(TASKS, L1, NOISES))
    configs: dict[tuple[str, ...], DictConfig] = {}
    for number in range(count):
        study, seed = studies[number % len(studies)], number // len(studies)
        task, l1, noise = study
        if study not in configs:
            options = [f"l1={l1}", f"noise={noise}", f"outer_iterations={ITERATIONS}"]
            configs[study] = compose(f"metrpo/{task}", [*options, "run_dir=x"])
        path = folder / task / f"l1={l1},noise={noise}" / f"seed_{seed}"
        config = configs[study].copy()
        config.seed, config.run_dir = seed, str(path)
        _write(path, config, tables, versions, rng)


_TABLES = (
    *("metrics.csv", "timing.csv"),
    *("evaluations/robustness.csv", "evaluations/episodes/robustness.csv"),
)


def _rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as handle:
        return list(csv.DictReader(handle))


def _write(
    path: Path,
    config: DictConfig,
    tables: Mapping[str, Sequence[Mapping[str, str]]],
    versions: str,
    rng: np.random.Generator,
) -> None:
    """One run directory with numbers of its own."""
    level = 100 * rng.random()
    texts = {}
    for name, rows in tables.items():
        grown: list[dict[str, Any]] = [dict(row) for row in rows]
        if name in _TABLES[:2]:
            grown = [{**rows[-1], "iteration": i} for i in range(ITERATIONS)]
        for i, row in enumerate(grown):
            for key in ("return", "return_mean", "return_deterministic"):
                if key in row:
                    row[key] = level * (1 + i / len(grown)) + rng.normal()
            if "real_steps" in row:
                row["real_steps"] = 3000 * (i + 2)
            if "run" in row:
                row |= {"run": str(path), "training_seed": config.seed}
        texts[name] = table_text(grown)
    (path / "evaluations" / "episodes").mkdir(parents=True)
    for name, text in texts.items():
        (path / name).write_text(text)
    checksums = {name: {str(ITERATIONS): digest(texts[name])} for name in _TABLES[:2]}
    (path / "checksums.json").write_text(json.dumps(checksums))
    (path / "config.yaml").write_text(OmegaConf.to_yaml(config, resolve=True))
    (path / "versions.json").write_text(versions)


def measure(folder: Path, output: Path) -> dict[str, float]:
    """Seconds on the wall and of the processor, and peak memory in MB, of the whole command."""
    command = [sys.executable, "-m", "torchrl_l1.cli", "report", str(folder)]
    start = time.perf_counter()
    process = subprocess.Popen(
        [*command, "--output", str(output)],
        stdout=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError("the report has failed")
    # Kilobytes, on macOS bytes.
    size = used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    return {
        "seconds": time.perf_counter() - start,
        "processor seconds": used.ru_utime + used.ru_stime,
        "MB": size,
    }


def main() -> None:
    """Make the runs, report on them, say what that took."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.report_runs", description=__doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--output", type=Path, help="keep runs and report in this folder")
    parser.add_argument("--training", action="store_true", help="no evaluations")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        place = options.output or Path(temporary)
        if not (place / "runs").exists():
            make_runs(place / "runs", options.runs)
        if options.training:
            for evaluations in (place / "runs").glob("*/*/*/evaluations"):
                shutil.rmtree(evaluations)
        for _ in range(options.repetitions):
            found = measure(place / "runs", place / "report")
            print(", ".join(f"{value:.1f} {name}" for name, value in found.items()), flush=True)


if __name__ == "__main__":
    main()
