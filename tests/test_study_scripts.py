"""What the scripts of the studies make of the files that they read."""

from __future__ import annotations

import csv
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from matplotlib.figure import Figure

from tests.test_studies import RESULTS, script


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that would have been saved."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    return figures


def write(file: Path, rows: Sequence[dict[str, Any]]) -> None:
    file.parent.mkdir(parents=True)
    with file.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def new_planner(folder: Path) -> tuple[str, str]:
    controllers = ("off", "paper", "robust", "oracle")
    rows = [{"l1": l1, "bias": 0.0, "episode": 0, "return": -1.0} for l1 in controllers]
    write(folder / "pets/episodes.csv", rows)
    return "planners/episodes.csv", "pets"


def new_reward(folder: Path) -> tuple[str, str]:
    rows = [{"real_steps": 12000, "return_mean": 1.0, "reward_model/explained_variance": 0.5}]
    write(folder / "learned/seed_0/metrics.csv", rows)
    return "learned_rewards.csv", "learned,0"


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    ("name", "measure"), [("planners", new_planner), ("learned_rewards", new_reward)]
)
def test_what_a_folder_lacks_is_kept(
    name: str,
    measure: Callable[[Path], tuple[str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for kept in RESULTS.glob(f"{name}*"):
        (shutil.copytree if kept.is_dir() else shutil.copy)(kept, tmp_path / kept.name)
    copied: ModuleType = script(name, monkeypatch, tmp_path)
    new = tmp_path / "new"
    file, key = measure(new)

    def lines() -> list[str]:
        return (tmp_path / file).read_text().splitlines()

    before = lines()
    monkeypatch.setattr(sys, "argv", [name, str(tmp_path / "mistyped")])
    with pytest.raises(SystemExit, match="mistyped"):
        copied.main()
    assert lines() == before
    monkeypatch.setattr(sys, "argv", [name, str(new)])
    copied.main()
    others = [line for line in before if not line.startswith(key)]
    assert [line for line in lines() if not line.startswith(key)] == others
    assert len(others) < len(lines()) < len(before)


def test_qualities_that_a_campaign_lacks_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offline = script("offline", monkeypatch)
    file = tmp_path / "cells.csv"
    shutil.copy(RESULTS / "offline/cells.csv", file)
    before = offline.kept(file)
    of_run = {"task": "hopper", "quality": "expert", "seed": 0}
    offline.keep([{**offline.select(before, **of_run)[0], "return": 7.0}], file)
    after = offline.kept(file)
    assert [row["return"] for row in offline.select(after, **of_run)] == [7.0]
    others = [row for row in before if not offline.select([row], **of_run)]
    assert [row for row in after if not offline.select([row], **of_run)] == others
