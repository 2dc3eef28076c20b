"""The evaluations of a campaign: one table per run, with its settings beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_l1.campaign.description import EvaluationSettings, dump_yaml, load_yaml
from torchrl_l1.experiment.evaluate import (
    distinct,
    episodes_file,
    evaluate_episodes,
    load_run,
    reachable,
    table_checksums,
)
from torchrl_l1.experiment.files import refuse_link, write_atomically, write_table
from torchrl_l1.experiment.matrix import suite
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.experiment.tracking import Evaluated, log_evaluation


def evaluation_file(run_dir: Path, name: str) -> Path:
    """The table of an evaluation; the file of its settings has the suffix ``.yaml``.

    The returns of single episodes are in :func:`episodes_file`.
    """
    return run_dir / "evaluations" / f"{name}.csv"


def is_evaluated(directory: RunDirectory, settings: EvaluationSettings) -> bool:
    """Whether there is an intact table, made with these settings after all iterations.

    Settings that are missing from its description, because it is older than they are, have their
    defaults.
    """
    table = evaluation_file(directory.path, settings.name)
    try:
        before = load_yaml(table.with_suffix(".yaml"))
        iterations, cells = before.pop("iterations"), before.pop("disturbances", None)
        checksums = before.pop("checksums", None)
        made_with = EvaluationSettings.from_keys(name=settings.name, **before)
        if checksums not in (None, table_checksums(table)):
            return False
    except (OSError, ValueError, AttributeError, KeyError, TypeError):
        return False
    now = _described(settings, directory.iterations_done())
    return (
        table.exists()
        and _described(made_with, iterations) == now
        and cells == now.get("disturbances")
    )


def _described(settings: EvaluationSettings, iterations: int) -> dict[str, Any]:
    """What a table was made from: settings, and the run's number of outer iterations.

    For a suite it lists the disturbances, which may differ in another version.
    """
    cells = {} if settings.suite is None else {"disturbances": suite(settings.suite)}
    return {**settings.of_a_run(), **cells, "iterations": iterations}


def evaluate_run(run_dir: str, name: str, settings: Mapping[str, Any]) -> Path:
    """Evaluate the last checkpoint of a run and write its table.

    Args:
        run_dir: the run directory.
        name: name of the evaluation.
        settings: as returned by :meth:`EvaluationSettings.of_a_run`.

    Returns:
        the table; that of the single episodes is its :func:`episodes_file`.

    Raises:
        RunDirectoryError: if the directory holds no run or no checkpoint.
        ValueError: for a stage that the run does not have; nothing is changed in this case.
    """
    chosen = EvaluationSettings.from_keys(name=name, **settings)
    table = evaluation_file(Path(run_dir), name)
    for folder in (table.parent, episodes_file(table).parent):
        refuse_link(folder)
    trained = load_run(run_dir, last=True)
    cells = distinct(trained, chosen.conditions())
    if chosen.suite is not None:
        cells = reachable(trained, cells)
    rows, episodes = [], []
    for row, single in evaluate_episodes(trained, cells, chosen.episodes, chosen.seed):
        rows.append(row)
        episodes += single
    described = table.with_suffix(".yaml")
    singly = episodes_file(table)
    singly.parent.mkdir(parents=True, exist_ok=True)
    # In this order, no kill leaves a table beside another table's settings, or without any.
    table.unlink(missing_ok=True)
    described.unlink(missing_ok=True)
    write_table(singly, episodes)
    write_table(table, rows)
    # Before its settings: after a kill in between, the evaluation is made and logged again.
    log_evaluation(trained.recipe, trained.path, Evaluated(f"evaluations/{name}", rows))
    words = _described(chosen, trained.algorithm.iteration)
    write_atomically(described, dump_yaml({**words, "checksums": table_checksums(table)}))
    return table
