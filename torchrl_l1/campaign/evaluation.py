"""The evaluations of a campaign: one table for each run, with its settings beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_l1.campaign.settings import EvaluationSettings
from torchrl_l1.campaign.yaml_file import dump_yaml, load_yaml
from torchrl_l1.experiment.evaluate import conditions, evaluate, load_run
from torchrl_l1.experiment.run_directory import RunDirectory, write_atomically


def evaluation_file(run_dir: Path, name: str) -> Path:
    """The table of an evaluation; its settings have the suffix ``.yaml``."""
    return run_dir / "evaluations" / f"{name}.csv"


def is_evaluated(directory: RunDirectory, settings: EvaluationSettings) -> bool:
    """Whether the table is there, made from these settings and from the last checkpoint."""
    table = evaluation_file(directory.path, settings.name)
    try:
        if table.stat().st_mtime_ns < directory.checkpoint_file.stat().st_mtime_ns:
            return False
        before: object = load_yaml(table.with_suffix(".yaml"))
    except (OSError, ValueError):
        return False
    return before == settings.of_a_run()


def evaluate_run(run_dir: str, name: str, settings: Mapping[str, Any]) -> Path:
    """Evaluate the last checkpoint of a run and write its table.

    Args:
        run_dir: the run directory.
        name: of the evaluation.
        settings: as :meth:`EvaluationSettings.of_a_run` gives them.

    Returns:
        the table.

    Raises:
        RunDirectoryError: if the directory holds no run or no checkpoint.
    """
    chosen = EvaluationSettings(name=name, **settings)
    cells = conditions(chosen.l1, chosen.noise, chosen.bias, chosen.gain, chosen.policy)
    trained = load_run(run_dir)
    rows = list(evaluate(trained, cells, chosen.episodes, chosen.seed, chosen.epsilon))
    table = evaluation_file(Path(run_dir), name)
    described = table.with_suffix(".yaml")
    table.parent.mkdir(exist_ok=True)
    # In this order: no kill leaves a table beside the settings of another one.
    described.unlink(missing_ok=True)
    RunDirectory(run_dir).write_table(table, rows)
    write_atomically(described, dump_yaml(chosen.of_a_run()))
    return table
