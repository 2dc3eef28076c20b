"""Benchmarks of what METRPO's time goes into, at sizes that take no time."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import imagination, metrpo_iteration, trpo


def test_trpo(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trpo, "SAMPLES", 500)
    autograd, closed = trpo.run(1)
    assert autograd["milliseconds"] > 0
    assert closed["speedup"] > 0


def test_imagination(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imagination, "HIDDEN", (8,))
    monkeypatch.setattr(imagination, "TRAJECTORIES", 3)
    monkeypatch.setattr(imagination, "HORIZON", 2)
    rows = imagination.run(1)
    assert [row["implementation"] for row in rows] == ["step by step", "float32", "bfloat16"]
    assert "| bfloat16 |" in imagination.table(1).markdown()


def test_iterations_of_two_versions_take_turns(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "torchrl_l1").symlink_to(Path(__file__).parents[2] / "torchrl_l1")
    monkeypatch.setattr(metrpo_iteration, "SCALE", 0.002)
    monkeypatch.setattr(metrpo_iteration, "pinned", lambda: tmp_path)
    monkeypatch.setattr(metrpo_iteration, "resolve_precision", lambda precision: "float32")
    rows = metrpo_iteration.run(1)
    versions = {row["version"] for row in rows}
    assert versions == {metrpo_iteration.PINNED, "float32"}
    everything = {row["version"]: row for row in rows if row["phase"] == "processor"}
    assert everything["float32"]["speedup"] > 0


def test_a_commit_that_is_not_there_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(metrpo_iteration, "_ROOT", tmp_path)
    with pytest.raises(metrpo_iteration.PinnedUnavailableError, match="Fetch the whole history"):
        metrpo_iteration.pinned()
