"""Trainings that diverge stop with a word, and signals end runs in order."""

from __future__ import annotations

import csv
import math
import os
import re
import signal
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from tests.attack import kills
from torchrl_l1.algorithms import METRPO
from torchrl_l1.algorithms.algorithm import Algorithm, Diverged
from torchrl_l1.algorithms.model_learning import ModelLearning
from torchrl_l1.algorithms.policy_improvement import PolicyImprovement
from torchrl_l1.envs.simulation import TaskSimulation
from torchrl_l1.experiment import run_directory
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.experiment.shutdown import RESUME_ME, asked_to_make_room, orderly_end
from torchrl_l1.objectives import NonFiniteAdvantages
from torchrl_l1.objectives.gaussian_trpo import _GaussianProblem
from torchrl_l1.report import report

Recipe = Callable[..., DictConfig]


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def spoil_model(monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """From its n-th fit on a model has weights that are no numbers."""
    fit, count = ModelLearning.fit, iter(range(1000))

    def spoilt(self: ModelLearning, *arguments: Any) -> Any:
        found = fit(self, *arguments)
        if next(count) >= at:
            with torch.no_grad():
                next(self.dynamics.parameters()).fill_(math.nan)
        return found

    monkeypatch.setattr(ModelLearning, "fit", spoilt)


def test_a_model_of_no_numbers_stops_the_run_at_its_last_good_checkpoint(
    tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    healthy = run(tiny_recipe(f"run_dir={tmp_path / 'healthy'}"))
    assert "diverged" not in rows(healthy)[0]
    spoil_model(monkeypatch, at=1)
    with pytest.raises(RunDirectoryError, match=r"iteration 1, fit: weights of the model.*fit\.l"):
        run(tiny_recipe())
    folder = tmp_path / "run"
    (row,) = rows(folder)
    assert row["diverged"] == "1"
    assert RunDirectory(folder).iterations_done() == 1 and RunDirectory(folder).intact()
    assert "weights of the model" in (folder / "diverged.txt").read_text()
    text = report([folder], tmp_path / "report").read_text()
    assert f"Trainings that diverged:\n\n- {folder}: training diverged in iteration 1" in text
    monkeypatch.undo()
    run(tiny_recipe("resume=true"))
    assert (folder / "metrics.csv").read_bytes() == (healthy / "metrics.csv").read_bytes()
    assert not (folder / "diverged.txt").exists()


@pytest.mark.parametrize("kind", ["loss", "advantage", "kl"])
def test_what_is_not_finite_in_fit_and_policy_step_is_named(
    kind: str, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kind == "loss":
        fit = ModelLearning.fit

        def spoilt(self: Any, *arguments: Any) -> Any:
            found = fit(self, *arguments)
            found.validation_loss = math.inf
            return found

        monkeypatch.setattr(ModelLearning, "fit", spoilt)
        words = r"fit: model/validation_loss is inf; look at fit\.learning_rate"
    else:
        step = PolicyImprovement.step

        def spoilt(self: Any, *arguments: Any) -> Any:
            if kind == "advantage":
                raise NonFiniteAdvantages(
                    "TRPO: non-finite advantages; check rewards and value estimates"
                )
            found = step(self, *arguments)
            found.report.kl = math.nan
            return found

        monkeypatch.setattr(PolicyImprovement, "step", spoilt)
        words = "TRPO: non-finite advantages" if kind == "advantage" else "trpo/kl is nan"
    with pytest.raises(RunDirectoryError, match=words):
        run(tiny_recipe())
    assert not (tmp_path / "run" / "metrics.csv").exists()
    run(tiny_recipe("resume=true", "on_divergence=warn"))
    assert [float(row["diverged"]) > 0 for row in rows(tmp_path / "run")] == [True, True]
    assert words.split(";")[0].split("\\")[0] in (tmp_path / "run" / "diverged.txt").read_text()


def test_a_kill_loses_no_word_of_what_has_diverged(
    tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It comes after the last row of the metrics, or after the checkpoint that they are of."""
    step, write = PolicyImprovement.step, run_directory.write_atomically
    folder = tmp_path / "run"

    def spoilt(self: Any, *arguments: Any) -> Any:
        found = step(self, *arguments)
        found.report.kl = math.nan
        return found

    def run_until(name: str, *overrides: str) -> None:
        def killed(file: Path, *arguments: Any) -> None:
            write(file, *arguments)
            if file.name == name:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(run_directory, "write_atomically", killed)
            run(tiny_recipe("on_divergence=warn", "checkpoint.every=1", *overrides))

    monkeypatch.setattr(PolicyImprovement, "step", spoilt)
    run_until("metrics.csv")
    assert "iteration 0, TRPO: trpo/kl is nan" in (folder / "diverged.txt").read_text()
    assert (folder / "checkpoints/after_1.pt").exists()
    (folder / "diverged.txt").unlink()
    run_until("checkpoint.pt", "resume=true")
    assert (folder / "diverged.txt").read_text() == "training diverged in iteration 0\n"
    (folder / "diverged.txt").unlink()
    run(tiny_recipe("on_divergence=warn", "resume=true"))
    assert (folder / "diverged.txt").read_text() == "training diverged in iteration 1\n"


def test_plans_that_all_diverge_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    config = compose("pets/inverted_pendulum", ["run_dir=x", "model.hidden=[4]"])
    algorithm: Algorithm = OmegaConf.to_object(config).build()  # type: ignore[union-attr]
    from tensordict import TensorDict

    data = TensorDict({"observation": torch.zeros(1, 3, 4)}, batch_size=[1, 3])
    data["next", "plan", "best_return"] = torch.zeros(1, 3, 1)
    algorithm.check_plans(data)
    data["next", "plan", "best_return"][0, 1] = -math.inf
    with pytest.raises(Diverged, match="in 1 of 3 steps"):
        algorithm.check_plans(data)
    data["observation"][0, 1] = math.nan  # then it is the state that is at fault
    algorithm.check_plans(data)


@pytest.mark.parametrize("name", ["trpo.max_kl", "fit.learning_rate", "policy.std", "discount"])
def test_settings_that_can_never_work_are_refused(
    name: str, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    config = tiny_recipe()
    for value in (math.nan, math.inf, -math.inf):
        OmegaConf.update(config, name, value)
        with pytest.raises(ValueError, match=name):
            run(config)
    with pytest.raises(ValueError, match="on_divergence"):
        run(tiny_recipe("on_divergence=ignore"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGHUP"])
def test_a_signal_ends_the_run_in_order(
    name: str,
    tiny_recipe: Recipe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    number = getattr(signal, name)
    complete, closed = METRPO.complete, []

    class Told:
        def __init__(self, *arguments: Any) -> None:
            pass

        def log(self, *rows: Any) -> None:
            pass

        def close(self, status: int = 0) -> None:
            closed.append(status)

    monkeypatch.setattr("torchrl_l1.experiment.tracking.WandbTracker", Told)

    def complete_and_send(self: METRPO, *arguments: Any) -> Any:
        if self.iteration == 1:
            signal.raise_signal(number)
        return complete(self, *arguments)

    monkeypatch.setattr(METRPO, "complete", complete_and_send)
    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as exit_info, orderly_end():
        run(tiny_recipe("wandb.mode=offline"))
    assert exit_info.value.code == 128 + number
    assert capsys.readouterr().err.count(f"torchrl-l1: stopped by {name}\n") == 1
    assert closed == [1] and signal.getsignal(number) == before
    assert len(rows(tmp_path / "run")) == 1


@pytest.mark.parametrize("state", ["read-only", "a closed pipe", "closed", "never open"])
def test_a_signal_is_obeyed_where_its_line_cannot_be_written(
    state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = os.dup(2)
    try:
        if state == "read-only":
            with open(os.devnull, "rb") as unwritable:
                os.dup2(unwritable.fileno(), 2)
        elif state == "a closed pipe":
            reader, writer = os.pipe()
            os.close(reader)
            os.dup2(writer, 2)
            os.close(writer)
        else:
            os.close(2)
        stream = None if state == "never open" else sys.__stderr__
        for name in ("stderr", "__stderr__"):
            monkeypatch.setattr(sys, name, stream)
        file = tmp_path / "file"
        # Where there is no standard error, the next file opened takes its number.
        with (
            open(file, "wb") if stream is None else nullcontext(),
            pytest.raises(SystemExit) as exit_info,
            orderly_end(),
        ):
            signal.raise_signal(signal.SIGUSR1)
            asked = asked_to_make_room()
            signal.raise_signal(signal.SIGTERM)
    finally:
        os.dup2(kept, 2)
        os.close(kept)
    assert asked and exit_info.value.code == 143
    assert not file.exists() or not file.read_bytes()


def test_a_second_signal_is_not_caught() -> None:
    seen = []
    with pytest.raises(SystemExit), orderly_end():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            seen.append(signal.getsignal(signal.SIGTERM))
    assert seen == [signal.SIG_DFL]


def test_a_signal_that_is_ignored_stays_so_after_another() -> None:
    """With nohup a run that ends by SIGTERM closes its loggers though the terminal is closed."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with pytest.raises(SystemExit), orderly_end():
            try:
                signal.raise_signal(signal.SIGTERM)
            finally:
                found = signal.getsignal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert found is signal.SIG_IGN


def test_a_warning_lets_the_iteration_be_finished(
    tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run(tiny_recipe(f"run_dir={tmp_path / 'whole'}"))
    fit = ModelLearning.fit

    def send_and_fit(self: Any, *arguments: Any) -> Any:
        signal.raise_signal(signal.SIGUSR1)
        return fit(self, *arguments)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as exit_info, orderly_end():
        patch.setattr(ModelLearning, "fit", send_and_fit)
        run(tiny_recipe())
    assert exit_info.value.code == RESUME_ME
    assert RunDirectory(tmp_path / "run").iterations_done() == 1
    run(tiny_recipe("resume=true"))
    assert (tmp_path / "run/metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()


def spoil_simulation(monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """From its n-th step on the simulation gives rewards that are no numbers."""
    step, count = TaskSimulation.step, iter(range(10**9))

    def spoilt(self: TaskSimulation, *arguments: Any) -> Any:
        found = step(self, *arguments)
        return found._replace(reward=found.reward * (math.nan if next(count) >= at else 1.0))

    monkeypatch.setattr(TaskSimulation, "step", spoilt)


def spoil_curvature(monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """From its n-th product on the Fisher matrix of TRPO is no number."""
    product, count = _GaussianProblem.fisher_product, iter(range(10**9))

    def spoilt(self: _GaussianProblem, vector: torch.Tensor) -> torch.Tensor:
        return product(self, vector) * (math.nan if next(count) >= at else 1.0)

    monkeypatch.setattr(_GaussianProblem, "fisher_product", spoilt)


DIVERGING: dict[str, tuple[str, list[str], Callable[..., None], str]] = {
    "METRPO, curvature": (
        "metrpo/inverted_pendulum",
        kills.METRPO_TINY,
        spoil_curvature,
        r"TRPO: trpo/kl is nan; look at trpo\.max_kl",
    ),
    "PETS, weights": (
        "pets/inverted_pendulum",
        kills.PETS_TINY,
        spoil_model,
        "fit: weights of the model are not finite",
    ),
    "PETS, rewards": ("pets/inverted_pendulum", kills.PETS_TINY, spoil_simulation, "is nan"),
    "MBMF, weights": (
        "mbmf/inverted_pendulum",
        kills.MBMF_TINY,
        spoil_model,
        "fit: weights of the model are not finite",
    ),
    "MBMF, rewards": (
        "mbmf/inverted_pendulum",
        kills.MBMF_TINY,
        spoil_simulation,
        "PPO: non-finite advantages",
    ),
}


@pytest.mark.parametrize("name", list(DIVERGING))
@pytest.mark.parametrize("mode", ["stop", "warn"])
def test_every_algorithm_stops_or_counts_and_is_reported(
    name: str, mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, overrides, spoil, words = DIVERGING[name]
    folder = tmp_path / "run"
    config = compose(recipe, [*overrides, f"on_divergence={mode}", f"run_dir={folder}"])
    # Late enough for a first iteration that is whole.
    spoil(monkeypatch, at={"weights": 1, "rewards": 60, "curvature": 30}[name.split(", ")[1]])
    if mode == "stop":
        with pytest.raises(
            RunDirectoryError, match=rf"training diverged in iteration \d+, .*{words}"
        ):
            run(config)
    else:
        run(config)
    table = rows(folder)
    assert len(table) == config.outer_iterations or mode == "stop"
    assert any(float(row["diverged"] or 0) > 0 for row in table) and RunDirectory(folder).intact()
    if all(math.isfinite(float(row["return_mean"])) for row in table):
        text = report([folder], tmp_path / "report").read_text()
        assert "Trainings that diverged:" in text
    else:  # then it is left out, and the reason is told
        with pytest.raises(RunDirectoryError, match=r"return_mean is .nan.*training diverged in"):
            report([folder], tmp_path / "report")


@pytest.mark.parametrize("mode", ["stop", "warn"])
def test_a_policy_of_no_numbers_stops_the_run(
    mode: str, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, count = TaskSimulation.step, iter(range(1000))

    def spoilt(self: TaskSimulation, action: torch.Tensor, *others: Any) -> Any:
        return step(self, action * math.nan if next(count) >= 40 else action, *others)

    monkeypatch.setattr(TaskSimulation, "step", spoilt)
    with pytest.raises(RunDirectoryError) as error:
        run(tiny_recipe(f"on_divergence={mode}"))
    words = (
        r"iteration \d, \w.*: 'action' of environment 0 is \[nan\].*look at policy\.std and trpo"
    )
    assert re.search(words, str(error.value)) and "on_divergence" not in str(error.value)


def test_a_model_whose_predictions_are_no_numbers_stops_the_run(
    tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = ModelLearning.fit

    def spoilt(self: ModelLearning, *arguments: Any) -> Any:
        found = fit(self, *arguments)
        with torch.no_grad():
            for part in self.dynamics.parameters():
                part.mul_(1e30)  # finite still
        return found

    monkeypatch.setattr(ModelLearning, "fit", spoilt)
    with pytest.raises(RunDirectoryError, match="iteration 0, fit: predictions of the model are"):
        run(tiny_recipe())
