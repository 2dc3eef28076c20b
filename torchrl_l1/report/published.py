"""The paper's printed tables, with what is known to be wrong with their cells."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from torchrl_l1.report.algorithms import facts
from torchrl_l1.report.identity import BASELINE

# Controllers whose results the paper's "L1" stands for: its own and that of its released code.
_PUBLISHED_ARMS = ("paper", "reference")


@dataclass(frozen=True)
class PublishedCell:
    """One printed cell.

    Attributes:
        mean: as printed.
        std: as printed behind the ``±``.
        source: paper and table.
        erratum: why not to take it at its word; empty if nothing is known.
    """

    mean: str
    std: str
    source: str
    erratum: str

    def columns(self) -> dict[str, str]:
        """The cell as columns of our tables."""
        return {f"paper_{key}": value for key, value in vars(self).items()}


@cache
def published_cells() -> dict[tuple[str, str, str, str, str], PublishedCell]:
    """All cells of Tables 1, 2, 4 and 5 of arXiv 2403.14860.

    Returns:
        by table (``"1"``), task, noise, L1 in training and L1 in testing (``on`` or ``off``).
        In Table 2 the noise is that of the test.

    Examples:
        >>> published_cells()["2", "inverted_pendulum", "action", "off", "off"].mean
        '30.2'
    """
    file = files("torchrl_l1.report") / "data" / "published_tables.csv"
    with file.open(encoding="utf-8") as handle:
        return {
            (row["table"], row["task"], row["noise"], row["l1_training"], row["l1_testing"]):
            PublishedCell(row["mean"], row["std"], row["source"], row["erratum"])
            for row in csv.DictReader(handle)
        }  # fmt: skip


def published_cell(
    task: str,
    training_noise: str,
    trained: str,
    testing_noise: str,
    tested: str,
    algorithm: str = "metrpo",
) -> PublishedCell | None:
    """What the paper's tables say of a training and a test; ``None`` if nothing.

    Args:
        task: the task.
        training_noise: noise of the training environment.
        trained: L1 setting of the training.
        testing_noise: noise of the test; that of the training in a run's own returns.
        tested: L1 setting of the test.
        algorithm: see :data:`~torchrl_l1.report.algorithms.ALGORITHMS`. Of MBMF there are only the
            returns of the training.

    Examples:
        >>> published_cell("swimmer", "none", "off", "none", "off").mean
        '309.5'
        >>> published_cell("swimmer", "none", "off", "action", "paper").source
        'arXiv 2403.14860, Table 2'
        >>> published_cell("swimmer", "none", "paper", "none", "paper", "mbmf").mean
        '314.3'
    """
    switches = []
    for arm in (trained, tested):
        if arm != BASELINE and arm not in _PUBLISHED_ARMS:
            return None
        switches.append("off" if arm == BASELINE else "on")
    if training_noise == testing_noise and switches[0] == switches[1]:
        kind = "training"
    elif training_noise == testing_noise:
        kind = "ablation"
    else:
        kind = "sim_to_real" if training_noise == "none" else ""
    table = facts(algorithm).tables.get(kind, "")
    return published_cells().get((table, task, testing_noise, switches[0], switches[1]))
