"""Benchmarks measure what they say, in files that can be read back."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from benchmarks import collection, env_stepping, jacobian
from benchmarks.tables import Table
from benchmarks.timing import interleave, ratio
from torchrl_l1.dynamics import FitConfig


def test_cases_take_turns() -> None:
    calls: list[str] = []
    cases = {name: lambda name=name: calls.append(name) for name in "ab"}
    measured = interleave(cases, 3, shortest=0.0, warmup=0)
    # One calibrating call of each, then in turns.
    assert "".join(calls) == "ab" + "ababab"
    assert {name: len(values) for name, values in measured.items()} == {"a": 3, "b": 3}


def test_ratio_is_taken_between_neighbours() -> None:
    found = ratio("speed", [1.0, 10.0, 6.0], [1.0, 5.0, 2.0])
    assert found == {"speed": 2.0, "speed_low": 1.0, "speed_high": 3.0}


def test_table_round_trip(tmp_path: Path) -> None:
    rows = [{"task": "a", "speed": 1234.5, "speed_low": 1000.0, "speed_high": 2000.0, "n": 3}]
    table = Table("stem", "Title", "Caption", rows, {"task": "Task", "speed": "Speed"}, {})
    table.write(tmp_path)
    assert "| a | 1234.50 (1000.00 to 2000.00) |" in (tmp_path / "stem.md").read_text()
    with (tmp_path / "stem.csv").open() as file:
        assert list(csv.DictReader(file)) == [{k: str(v) for k, v in rows[0].items()}]


def test_jacobian_benchmark_compares_equal_computations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jacobian, "SIZES", ((2, 3, 2),))
    (row,) = jacobian.run(1)
    assert {"forward", "analytic", "jvp", "jacfwd", "jacrev", "forwards"} <= row.keys()
    assert all(row[f"{rival}_ratio"] > 0 for rival in jacobian.RIVALS)


def test_env_stepping_benchmark_measures_both_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_stepping, "NUM_ENVS", 2)
    monkeypatch.setattr(env_stepping, "STEPS", 2)
    rows = env_stepping.table(1).rows
    assert [row["task"] for row in rows] == list(env_stepping.GYM_IDS)
    assert all(row["ratio"] == pytest.approx(row["batched"] / row["serial"]) for row in rows)


def test_collection_benchmark_switches_with_a_fitted_model(monkeypatch: pytest.MonkeyPatch) -> None:
    # A tolerance far below the model's curvature: switches are all but certain.
    monkeypatch.setattr(collection, "SETTINGS", (("half_cheetah", 2, 1e-3),))
    monkeypatch.setattr(collection, "WIDTHS", (8,))
    monkeypatch.setattr(collection, "COMPILE", {"eager": False})
    monkeypatch.setattr(collection, "STEPS", 10)
    monkeypatch.setattr(collection, "FIT", FitConfig(batch_size=50, max_gradient_steps=20))
    (row,) = collection.run(1, (1,))
    assert row["model"] == "2 x 8"
    assert row["switches"] > 100
    assert row["eager_ratio"] > 0
