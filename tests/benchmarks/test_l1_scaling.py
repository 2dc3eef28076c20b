"""What L1 costs is measured on computations that agree, with the columns that are shown."""

from __future__ import annotations

import pytest
import torch

from benchmarks import collection, l1_controllers, l1_scaling, l1_single


def test_scaling_has_a_row_per_size_and_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(l1_scaling, "SIZES", (1, 150))
    monkeypatch.setattr(l1_scaling, "HIDDEN", (8,))
    monkeypatch.setattr(l1_scaling, "THREAD_COUNTS", (1,))
    before = torch.get_num_threads()
    table = l1_scaling.table(1)
    assert [(row["threads"], row["num_envs"]) for row in table.rows] == [(1, 1), (1, 150)]
    assert all(set(table.columns) <= set(row) for row in table.rows)
    assert torch.get_num_threads() == before


def test_collection_is_measured_with_both_actors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collection, "SETTINGS", (("inverted_pendulum", 2, 1.0),))
    monkeypatch.setattr(collection, "WIDTHS", (8,))
    monkeypatch.setattr(collection, "COMPILE", {"eager": False, "compiled": False})
    monkeypatch.setattr(collection, "STEPS", 10)
    monkeypatch.setattr(collection, "THREAD_COUNTS", (1,))
    table = collection.table(1)
    (row,) = table.rows
    assert set(table.columns) <= set(row)
    assert min(float(row[name]) for name in ("off", "eager", "torchrl", "actor_ratio")) > 0


def test_controllers_have_a_row_per_task_and_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(l1_controllers, "SIZES", (2,))
    monkeypatch.setattr(l1_controllers, "HIDDEN", (8,))
    monkeypatch.setattr(l1_controllers, "MODES", {"eager": False})
    monkeypatch.setattr(l1_controllers, "THREAD_COUNTS", (1,))
    table = l1_controllers.table(1)
    assert [row["task"] for row in table.rows] == ["inverted_pendulum", "half_cheetah"]
    assert all(set(table.columns) <= set(row) for row in table.rows)


def test_a_single_environment_is_measured_with_and_without_seals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(l1_single, "TASKS", {("InvertedPendulum-v5", 2): (4, 1)})
    monkeypatch.setattr(l1_single, "HIDDEN", (8,))
    cases = {name: case for name, case in l1_single.CASES.items() if "compile" not in case}
    monkeypatch.setattr(l1_single, "CASES", cases)
    table = l1_single.table(1)
    (row,) = table.rows
    assert set(table.columns) - set(row) == {"compiled"}
    assert float(row["paper"]) > 0 and float(row["seal_share"]) < 1
