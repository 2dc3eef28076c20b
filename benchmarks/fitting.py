"""Fitting an ensemble: ours against mbrl-lib's trainer."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks import cheetah
from benchmarks.peers import peer
from benchmarks.tables import Table
from benchmarks.timing import Row, interleave, ratio, spread
from torchrl_l1.dynamics import FitConfig, FitReport, fit_ensemble

THREADS = 2
BATCHES = 40
BATCH_SIZE = 256
VALIDATION = 1024
EPOCHS = 2
LEARNING_RATE = 1e-3
PRECISIONS = ("float32", "bfloat16")

Case = tuple[str, str]

# Of PETS, one per layer; mbrl-lib knows one for all.
DECAYS: dict[str, tuple[list[float], float]] = {
    "none": ([], 0.0),
    "weight decay": ([2.5e-5, 5e-5, 5e-5, 7.5e-5], 5e-5),
}


def run(repetitions: int) -> list[Row]:
    """Measure both, with and without weight decay.

    Args:
        repetitions: interleaved measurements of each implementation.

    Returns:
        One row per implementation and penalty: training samples times members per second
        (``samples``), ``gflops`` per second, three times those of the predictions, the
        factor by which ours is faster (``speedup``), and the loss on the validation data in the
        end, after equally many steps in either precision (``held_out``).
    """
    buffer = cheetah.transitions(BATCHES * BATCH_SIZE, VALIDATION)
    worker = peer(torch.get_num_threads())
    cases: dict[Case, Callable[[], object]] = {}
    reports: dict[Case, FitReport] = {}
    for penalty, (decays, decay) in DECAYS.items():
        for precision in PRECISIONS:
            model = cheetah.fitted_model(buffer, gradient_steps=1)
            config = FitConfig(
                batch_size=BATCH_SIZE,
                max_epochs=EPOCHS,
                max_gradient_steps=EPOCHS * BATCHES,
                learning_rate=LEARNING_RATE,
                weight_decay=decays,
                precision=precision,
            )
            optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, fused=True)
            cases[penalty, precision] = partial(
                _fit, reports, (penalty, precision), model, buffer, config, optimizer
            )
        if worker is not None:
            with tempfile.TemporaryDirectory() as folder:
                paths = {name: str(Path(folder) / f"{name}.pt") for name in ("model", "data")}
                cheetah.save_for_mbrl(model, Path(paths["model"]))
                cheetah.save_transitions(buffer, Path(paths["data"]))
                worker.call("model", path=paths["model"])
                worker.call(
                    "data",
                    name=penalty,
                    path=paths["data"],
                    batch_size=BATCH_SIZE,
                    learning_rate=LEARNING_RATE,
                    weight_decay=decay,
                )
            cases[penalty, "mbrl-lib"] = partial(worker.call, "fit", name=penalty, epochs=EPOCHS)
    seconds = interleave(cases, repetitions, shortest=0.0, warmup=1)
    if worker is not None:
        worker.close()
    flops = 3e-9 * cheetah.flops_per_prediction(model)
    samples = EPOCHS * BATCHES * BATCH_SIZE * cheetah.MEMBERS
    rows: list[Row] = []
    for (penalty, implementation), values in seconds.items():
        row: Row = {"penalty": penalty, "implementation": implementation}
        row |= spread("samples", [samples / value for value in values])
        row |= spread("gflops", [flops * samples / value for value in values])
        if report := reports.get((penalty, implementation)):
            row["implementation"] = f"torchrl_l1, {implementation}"
            row["held_out"] = report.validation_loss
            if (penalty, "mbrl-lib") in seconds:
                row |= ratio("speedup", seconds[penalty, "mbrl-lib"], values)
        rows.append(row)
    return rows


def _fit(reports: dict[Case, FitReport], case: Case, *fit: Any) -> None:
    reports[case] = fit_ensemble(*fit)


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "fitting",
        "Fitting an ensemble",
        "Training samples times members per second, median (range), validation after each of "
        f"{EPOCHS} epochs included: `fit_ensemble` and mbrl-lib 0.2.0's `ModelTrainer`, both on "
        f"{BATCHES} batches of {BATCH_SIZE} per epoch, shuffled for each member, and five "
        "Gaussian members of 3 x 200 SiLU units (HalfCheetah, 17 observations, 6 actions). "
        "GFLOP/s count the products of the model and of its gradients; the held-out loss is that "
        "after all repetitions.",
        run(repetitions),
        {
            "penalty": "penalty",
            "implementation": "implementation",
            "samples": "member-samples per second",
            "gflops": "GFLOP/s",
            "speedup": "times as fast as mbrl-lib",
            "held_out": "held-out loss, nats",
        },
        {"samples": ",.0f", "gflops": ",.0f", "held_out": ".4f"},
    )
