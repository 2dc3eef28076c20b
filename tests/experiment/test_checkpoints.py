"""Checkpoints that a recipe keeps: which they are, and that they are used like a run."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import DictConfig

from tests.attack.kills import METRPO_TINY, PETS_TINY
from torchrl_l1.cli import main
from torchrl_l1.deployment import load_target
from torchrl_l1.experiment.checkpoints import (
    CheckpointSettings,
    keep_checkpoints,
    read_checkpoint,
)
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.evaluate import evaluate, load_run
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.experiment.run import run

Recipe = Callable[..., DictConfig]
KEEP = ("checkpoint.every=2", "checkpoint.best=true")


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as handle:
        return list(csv.DictReader(handle))


@given(st.lists(st.floats(-9, 9) | st.just(float("nan")), max_size=8), st.integers(1, 4))
def test_which_are_kept(
    tmp_path_factory: pytest.TempPathFactory, returns: list[float], every: int
) -> None:
    folder = tmp_path_factory.mktemp("run")
    last = folder / "checkpoint.pt"
    rows: list[dict[str, Any]] = []
    for number, value in enumerate(returns):
        rows.append({"return_mean": value})
        new = folder / "new"
        new.write_text(str(number))
        os.replace(new, last)
        keep_checkpoints(last, CheckpointSettings(every, best=True), rows)
    found = {file.name: int(file.read_text()) for file in folder.glob("checkpoints/*")}
    known = [(value, -number) for number, value in enumerate(returns) if value == value]
    best = {"best.pt": -max(known)[1]} if known else {}
    periodic = {f"after_{n}.pt": n - 1 for n in range(every, len(returns) + 1, every)}
    assert found == {**periodic, **best}


def test_kept_checkpoints_are_used_like_a_run(
    tiny_recipe: Recipe, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir = run(tiny_recipe("outer_iterations=3", *KEEP))
    kept = run_dir / "checkpoints"
    assert {file.name for file in kept.iterdir()} == {"after_2.pt", "best.pt"}
    returns = [float(row["return_mean"]) for row in rows_of(run_dir / "metrics.csv")]
    best = read_checkpoint(kept / "best.pt")["metrics"]
    assert len(best) == returns.index(max(returns)) + 1
    assert load_run(kept / "after_2.pt").algorithm.iteration == 2
    main(["evaluate", str(kept / "after_2.pt"), "--episodes", "2", "--bias", "0", "--l1", "off"])
    (stochastic, _) = rows_of(run_dir / "evaluation_after_2" / "evaluation.csv")
    assert stochastic["run"] == str(kept / "after_2.pt")
    assert not (run_dir / "evaluation").exists()
    earlier = run(tiny_recipe(f"run_dir={run_dir.with_name('earlier')}"))
    main(["evaluate", str(earlier), "--episodes", "2", "--bias", "0", "--l1", "off"])
    (expected, _) = rows_of(earlier / "evaluation" / "evaluation.csv")
    assert stochastic["return_mean"] == expected["return_mean"]
    policy = load_target(str(kept / "after_2.pt")).policy
    weights = list(torch.load(earlier / "policy.pt").values())
    for found, expected in zip(policy.state_dict().values(), weights, strict=True):
        assert torch.equal(found, expected)


def test_what_a_kill_has_come_before_is_kept_when_the_run_goes_on(tiny_recipe: Recipe) -> None:
    run_dir = run(tiny_recipe(*KEEP))
    for file in (run_dir / "checkpoints").iterdir():
        file.unlink()
    before = (run_dir / "metrics.csv").read_bytes()
    run(tiny_recipe(*KEEP, "resume=true"))
    assert (run_dir / "checkpoints" / "after_2.pt").exists()
    assert (run_dir / "metrics.csv").read_bytes() == before


def test_kept_checkpoints_that_cannot_be_used_are_a_line(tiny_recipe: Recipe) -> None:
    run_dir = run(tiny_recipe(*KEEP))
    file = run_dir / "checkpoints" / "after_2.pt"
    with pytest.raises(RunDirectoryError, match="it is not a file"):
        load_run(file.with_name("after_9.pt"))
    content = file.read_bytes()
    file.unlink()
    file.write_bytes(content[:-50])
    with pytest.raises(RunDirectoryError, match=r"after_2\.pt cannot be read"):
        load_run(file)
    other = run(tiny_recipe(f"run_dir={run_dir.with_name('other')}", "seed=1", *KEEP))
    file.write_bytes((other / "checkpoints" / "after_2.pt").read_bytes())
    with pytest.raises(RunDirectoryError, match="another configuration: seed: 1 there, 0 now"):
        load_run(file)
    file.write_bytes(content)
    state = read_checkpoint(file)
    del state["algorithm"]["policy"]
    torch.save(state, file)
    with pytest.raises(RunDirectoryError, match=r"after_2\.pt does not fit the run: 'policy'"):
        load_run(file)


def test_checkpoints_of_other_iterations_are_no_seeds_of_one_training(
    tiny_recipe: Recipe, capsys: pytest.CaptureFixture[str]
) -> None:
    keep = ("checkpoint.every=1", "checkpoint.best=true")
    first = run(tiny_recipe(*keep)) / "checkpoints"
    second = run(tiny_recipe(f"run_dir={first.parent.with_name('2')}", "seed=1", *keep))
    second /= "checkpoints"
    files = [str(first / "after_2.pt"), str(second / "after_1.pt")]
    with pytest.raises(SystemExit):
        main(["evaluate", *files, "--episodes", "1", "--l1", "off"])
    line = f"{files[0]} is of 2 iterations and {files[1]} of 1; train both equally far"
    assert line in capsys.readouterr().err
    # The best may come at any time.
    (first / "best.pt").unlink()
    (second / "best.pt").unlink()
    shutil.copy(files[0], first / "best.pt")
    shutil.copy(files[1], second / "best.pt")
    files = [str(first / "best.pt"), str(second / "best.pt")]
    main(["evaluate", *files, "--episodes", "1", "--l1", "off"])


def test_nothing_is_kept_through_a_link(tiny_recipe: Recipe, tmp_path: Path) -> None:
    run_dir = run(tiny_recipe("outer_iterations=1", *KEEP))
    elsewhere = tmp_path / "elsewhere"
    (run_dir / "checkpoints").rename(elsewhere)
    (run_dir / "checkpoints").symlink_to(elsewhere)
    with pytest.raises(RunDirectoryError, match="symbolic link"):
        run(tiny_recipe("resume=true", *KEEP))
    assert {file.name for file in elsewhere.iterdir()} == {"best.pt"}


def test_a_file_system_without_hard_links_gets_copies(
    tiny_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise OSError(1, "Operation not permitted", str(source))

    monkeypatch.setattr(os, "link", refuse)
    run_dir = run(tiny_recipe(*KEEP))
    assert len(read_checkpoint(run_dir / "checkpoints" / "after_2.pt")["metrics"]) == 2
    assert len(read_checkpoint(run_dir / "checkpoint.pt")["metrics"]) == 2


def test_the_best_that_is_gone_is_told(tmp_path: Path) -> None:
    last, told = tmp_path / "checkpoint.pt", []
    last.write_text("of iteration 2")
    rows = [{"return_mean": value} for value in (1.0, 3.0, 2.0)]
    keep_checkpoints(last, CheckpointSettings(best=True), rows, told.append)
    assert not (tmp_path / "checkpoints").exists()
    (line,) = told
    assert line.startswith(f"{tmp_path}: checkpoint.best keeps nothing yet: iteration 1 was")
    keep_checkpoints(last, CheckpointSettings(best=True), rows[:2], told.append)
    keep_checkpoints(last, CheckpointSettings(best=True), rows, told.append)
    assert (tmp_path / "checkpoints/best.pt").exists() and told == [line]


@pytest.mark.parametrize("recipe", ["metrpo", "pets"])
def test_the_type_that_a_session_has_chosen_changes_no_run(recipe: str, tmp_path: Path) -> None:
    """Where a notebook computes in double precision, a run goes on and is tested as it began."""
    tiny = {"metrpo": METRPO_TINY, "pets": PETS_TINY}[recipe]
    one, two = (
        compose(f"{recipe}/inverted_pendulum", [*tiny, f"run_dir={tmp_path / name}"])
        for name in ("one", "two")
    )
    one.outer_iterations = two.outer_iterations = 2
    run(one)
    cells = [Condition(l1, disturbances={"bias": 0.5}) for l1 in ("paper", "robust")]
    expected = list(evaluate(load_run(one.run_dir), cells, 2))
    two.outer_iterations = 1
    run(two)
    two.outer_iterations, two.resume = 2, True
    torch.set_default_dtype(torch.float64)
    try:
        run(two)
        found = list(evaluate(load_run(two.run_dir), cells, 2))
        assert torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)
    for name in ("metrics.csv", "model.pt"):
        assert Path(two.run_dir, name).read_bytes() == Path(one.run_dir, name).read_bytes()
    assert [{**row, "run": ""} for row in found] == [{**row, "run": ""} for row in expected]
