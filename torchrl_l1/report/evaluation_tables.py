"""Evaluations of frozen policies over training seeds, as rows of values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchrl_l1.report.algorithms import facts
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.published import published_cell
from torchrl_l1.report.reading import Evaluation
from torchrl_l1.report.runs import Run
from torchrl_l1.report.statistics import difference_summary, mean_interval
from torchrl_l1.report.study import Study, noise_order, variant_text

PHASES = ("neither", "training only", "testing only", "both")
"""Where L1 is on, in the order in which tables and figures show it."""

_CONDITION = ("l1", "noise", "bias", "gain", "policy", "stage")

Key = tuple[Any, ...]


def evaluation_names(study: Study) -> list[str]:
    """Names of the evaluations that there are."""
    return sorted({name for run in study.runs for name in run.evaluations})


def evaluation_rows(study: Study, name: str) -> list[dict[str, Any]]:
    """One row per cell of the training and condition of the test.

    ``return_values`` holds the mean returns of the single training seeds, ``std`` is their
    population standard deviation (as in the paper's tables), and the differences are those to
    the same policies tested without L1. Runs that are not finished are left out. Where ``l1``
    is equal to ``training_l1`` the policy was tested with the controller of its training;
    another controller of that name is marked. Where the test has set values of the controller,
    ``l1`` names them, and ``option``, ``epsilon`` and ``alpha`` hold them. ``stage`` is there
    where a test names it.
    """
    rows = []
    for cell, runs in study.cells.items():
        done = [run for run in runs if run.finished and name in run.evaluations]
        tests: dict[Key, list[tuple[Run, Evaluation]]] = {}
        for run in done:
            for test in run.evaluations[name]:
                key = (_tested(run, test), *test.condition[1:])
                tests.setdefault(key, []).append((run, test))
        places = {key: study.facts.position(key[-1]) for key in tests}
        for key in sorted(tests, key=lambda key: (places[key], _order(key, tests[key][0][1]))):
            rows.append(
                {
                    "task": cell.task,
                    "training_noise": cell.noise,
                    "training_l1": cell.arm,
                    "variant": variant_text(cell.variant),
                    **dict(zip(_CONDITION, key, strict=True)),
                    **_tuning(tests[key][0][1]),
                    **_summary(tests[key]),
                    **_against_baseline(key, tests),
                    **_published(runs[0], key),
                }
            )
    if not any(row["stage"] for row in rows):
        for row in rows:
            del row["stage"]
    return rows


def ablation_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Those rows of an evaluation that the ablation is made of, with the ``phase`` of L1.

    The test has the noise of the training and no disturbance, and L1 is on in both phases, in
    one, or in neither. Where L1 is on in both it is the same L1.
    """
    chosen = []
    for row in rows:
        trained, tested = row["training_l1"], row["l1"]
        on = {trained, tested} - {BASELINE}
        undisturbed = (row["bias"], row["gain"]) == (0.0, 1.0)
        if undisturbed and row["training_noise"] == row["noise"] and len(on) < 2:
            chosen.append({**row, "phase": phase(trained, tested)})
    return sorted(chosen, key=lambda row: PHASES.index(row["phase"]))


def phase(trained: str, tested: str) -> str:
    """Where L1 is on: ``neither``, ``training only``, ``testing only`` or ``both``."""
    if trained == BASELINE:
        return "neither" if tested == BASELINE else "testing only"
    return "training only" if tested == BASELINE else "both"


def _tested(run: Run, test: Evaluation) -> str:
    """The controller of a test: the training's L1 setting if it is that of the training."""
    what = run.identity
    if test.tuned or BASELINE in (what.arm, test.l1):
        return test.controller
    # Older tables were made with the options as shipped.
    own = test.l1 == what.shipped if test.own_l1 is None else test.own_l1
    if own:
        return what.arm
    return f"{test.l1} (not as trained)" if test.l1 == what.arm else test.l1


def _tuning(test: Evaluation) -> dict[str, Any]:
    values = {"option": test.l1, "epsilon": test.epsilon, "alpha": test.alpha}
    return values if test.tuned else {}


def _summary(tests: Sequence[tuple[Run, Evaluation]]) -> dict[str, Any]:
    values = [test.return_mean for _, test in tests]
    result: dict[str, Any] = {
        "training_seeds": len(values),
        "episodes_per_seed": " ".join(sorted({str(test.episodes) for _, test in tests})),
        "return_mean": float(np.mean(values)),
        "std": float(np.std(values)),
        "return_values": " ".join(f"{value:.6g}" for value in values),
    }
    interval = mean_interval(values)
    if interval is not None:
        result |= {"return_low": interval.low, "return_high": interval.high}
    switches = 1000 * float(np.mean([test.switch_rate for _, test in tests]))
    if np.isfinite(switches):
        result["switches_per_1000_steps"] = switches
    return result


def _against_baseline(
    key: Key, tests: Mapping[Key, Sequence[tuple[Run, Evaluation]]]
) -> dict[str, Any]:
    if key[0] == BASELINE:
        return {}
    without = {run.path: test.return_mean for run, test in tests.get((BASELINE, *key[1:]), ())}
    return difference_summary(
        [test.return_mean - without[run.path] for run, test in tests[key] if run.path in without]
    )


def _published(run: Run, key: Key) -> dict[str, str]:
    l1, noise, bias, gain, policy, _ = key
    what = run.identity
    usual = (bias, gain, policy) == (0.0, 1.0, "stochastic")
    if not (usual and what.as_published and "sim_to_real" in facts(what.algorithm).tables):
        return {}
    cell = published_cell(what.task, what.noise, what.arm, noise, l1)
    return {} if cell is None else cell.columns()


def _order(key: Key, test: Evaluation) -> Key:
    l1, noise, bias, gain, policy, _ = key
    # By the values, where their texts would put 10 before 3.
    controller = (test.l1, test.epsilon or 0.0, test.alpha or 0.0) if test.tuned else (l1, 0.0, 0.0)
    return policy != "stochastic", noise_order(noise), bias, gain, l1 != BASELINE, controller
