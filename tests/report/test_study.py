from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.report.identity import Identity
from torchrl_l1.report.runs import Run, find_runs
from torchrl_l1.report.study import Cell, Study, noise_order, studies, variant_text
from torchrl_l1.report.style import noise_words, title

WriteRun = Callable[..., Path]


def cells(tmp_path: Path) -> dict[tuple[str, str, str], list[int]]:
    """Seeds by noise, arm and variant."""
    return {
        (cell.noise, cell.arm, variant_text(cell.variant)): [r.identity.seed for r in runs]
        for cell, runs in Study(find_runs([tmp_path])).cells.items()
    }


def test_runs_of_other_settings_are_not_pooled(write_run: WriteRun, tmp_path: Path) -> None:
    for seed in (1, 0):
        write_run([1], "l1=off", seed=seed)
        write_run([1], "l1=paper", seed=seed)
        write_run([1], "l1=paper", "label=nominal", seed=seed)
        write_run([1], "l1=paper", "l1.epsilon=5", seed=seed)
    write_run([1], "l1=off", "trpo_iterations=7", seed=0)
    assert cells(tmp_path) == {
        ("none", "off", ""): [0, 1],
        ("none", "off", "trpo_iterations=7"): [0],
        ("none", "paper", ""): [0, 1],
        ("none", "paper", "l1.epsilon=5.0"): [0, 1],
        ("none", "paper", "label=nominal"): [0, 1],
    }


def test_the_controllers_settings_do_not_split_the_baseline(
    write_run: WriteRun, tmp_path: Path
) -> None:
    write_run([1], "l1=off", "l1.epsilon=2", seed=0)
    write_run([1], "l1=off", "l1.epsilon=3", seed=1)
    assert list(cells(tmp_path).values()) == [[0, 1]]


def test_compilation_of_plans_sets_no_runs_apart(write_run: WriteRun, tmp_path: Path) -> None:
    for seed, mode in enumerate(("auto", "true", "false")):
        overrides = ("l1=off", f"compile_plans={mode}")
        write_run([1], *overrides, recipe="pets/inverted_pendulum", seed=seed)
    assert list(cells(tmp_path).values()) == [[0, 1, 2]]


def test_main_settings_are_those_that_cover_most(write_run: WriteRun, tmp_path: Path) -> None:
    for noise in ("none", "action"):
        write_run([1], "l1=off", f"noise={noise}", "label=nominal")
    for seed in range(4):
        write_run([1], "l1=off", "label=executed", seed=seed)
    study = Study(find_runs([tmp_path]))
    assert study.main_settings("inverted_pendulum") == {"label": "nominal"}


def test_ties_go_to_the_default(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([1], "l1=off", "model=affine")
    write_run([1], "l1=off", "model=nonlinear")
    assert list(cells(tmp_path)) == [("none", "off", ""), ("none", "off", "model.form=affine")]


def test_of_equal_runs_the_furthest_counts(write_run: WriteRun, tmp_path: Path) -> None:
    short = write_run([1], iterations=3, name="a")
    long = write_run([1, 2, 3], iterations=3, name="b")
    equal = write_run([1, 2, 3], iterations=3, name="c")
    study = Study(find_runs([tmp_path]))
    assert [run.path for run in study.runs] == [long]
    assert {run.path for run in study.duplicates} == {short, equal}


def test_equal_runs_share_their_evaluations(write_run: WriteRun, tmp_path: Path) -> None:
    def tests(*biases: float) -> list[dict[str, Any]]:
        row = {"l1": "off", "noise": "none", "gain": 1.0, "policy": "stochastic", "episodes": 25}
        return [row | {"bias": bias, "return_mean": bias} for bias in biases]

    write_run([1, 2], name="a", iterations=2)
    write_run([1, 2], name="b", iterations=2, evaluations={"mine": tests(0), "ablation": tests(0)})
    write_run([1, 2], name="c", iterations=2, evaluations={"mine": tests(0, 1)})
    # Other returns: another policy, whose results do not mix with the first one's.
    write_run([1, 9], name="d", iterations=2, evaluations={"mine": tests(2), "late": tests(3)})
    # Not the final policy.
    write_run([1], name="e", iterations=2, evaluations={"early": tests(0)})
    study = Study(find_runs([tmp_path]))
    (run,) = study.runs
    assert run.path.name == "a"
    biases = {
        name: [test.disturbances["bias"] for test in found]
        for name, found in run.evaluations.items()
    }
    assert biases == {"mine": [0.0, 1.0], "ablation": [0.0], "late": [3.0]}
    assert sorted(run.path.name for run in study.duplicates) == ["b", "c", "d", "e"]


@pytest.mark.parametrize(("seed", "episodes"), [(0, 25), (1, 25), (0, 8)])
def test_evaluations_from_other_resets_are_not_merged(
    seed: int, episodes: int, write_run: WriteRun, tmp_path: Path
) -> None:
    row = {"l1": "off", "noise": "none", "gain": 1.0, "policy": "stochastic", "return_mean": 1.0}
    for name, bias, *drawn in (("a", 0.0, 0, 25), ("b", 1.0, seed, episodes)):
        tests = {"mine": [row | {"bias": bias, "episodes": drawn[1]}]}
        path = write_run([1, 2], name=name, iterations=2, evaluations=tests)
        (path / "evaluations/mine.yaml").write_text(f"{{iterations: 2, seed: {drawn[0]}}}")
    (run,) = Study(find_runs([tmp_path])).runs
    assert len(run.evaluations["mine"]) == 1 + ((seed, episodes) == (0, 25))


def test_every_task_has_a_main_cell(write_run: WriteRun, tmp_path: Path) -> None:
    # Most L1 runs have an epsilon that no run with the main label has.
    for noise in ("none", "action", "observation"):
        write_run([1], "l1=paper", f"noise={noise}", "label=nominal", "l1.epsilon=1")
        for seed in range(3):
            write_run([1], "l1=paper", "noise=none", "label=executed", "l1.epsilon=5", seed=seed)
    study = Study(find_runs([tmp_path]))
    assert study.main_settings("inverted_pendulum", "paper") == {
        "label": "nominal",
        "l1.epsilon": "1.0",
    }
    assert sum(not cell.variant for cell in study.cells) == 3


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(*(st.integers(0, 2) for _ in range(4))), min_size=1, max_size=12))
def test_whatever_was_run_a_task_has_a_main_cell(runs: list[tuple[int, int, int, int]]) -> None:
    made = []
    for seed, (noise, arm, label, epsilon) in enumerate(runs):
        name = ("off", "paper", "reference")[arm]
        l1 = {} if arm == 0 else {"l1.epsilon": str(epsilon)}
        identity = Identity(
            "metrpo", "swimmer", str(noise), name, seed, 1, {"label": str(label)}, l1, {}, name
        )
        empty = np.empty(0)
        made.append(Run(Path(str(seed)), identity, empty, empty, empty, {}, empty))
    assert any(not cell.variant for cell in Study(made).cells)


def test_a_sweep_of_the_filter_is_one_comparison(write_run: WriteRun, tmp_path: Path) -> None:
    for noise in ("none", "action"):
        write_run([1], "l1=paper", f"noise={noise}")
    written = [write_run([1], "l1=paper", f"l1.alpha={a}") for a in ("0.05", "0.1", "0.35")]
    study = Study(find_runs([tmp_path]))
    assert [run.path for run in study.duplicates] == written[2:]
    assert study.comparisons() == [("l1.alpha",)]
    found = [study.describe(cell, ("l1.alpha",)) for cell in study.compared(("l1.alpha",))]
    assert found == ["l1.alpha=0.35", "l1.alpha=0.05", "l1.alpha=0.1"]


def test_comparisons_hold_departures_against_the_main_cells(
    write_run: WriteRun, tmp_path: Path
) -> None:
    for arm in ("off", "paper"):
        for noise in ("none", "action"):
            write_run([1], f"l1={arm}", f"noise={noise}")
    write_run([1], "l1=paper", "l1.epsilon=5")
    write_run([1], "l1=paper", "l1.epsilon=5", "l1.alpha=0.2")
    write_run([1], "l1=paper", "label=nominal")
    study = Study(find_runs([tmp_path]))
    # The comparison by epsilon alone is part of that by alpha and epsilon.
    assert study.comparisons() == [("l1.alpha", "l1.epsilon"), ("label",)]
    found = study.compared(("l1.alpha", "l1.epsilon"))
    assert {cell.noise for cell in found} == {"none"}
    described = [study.describe(cell, ("l1.alpha", "l1.epsilon")) for cell in found]
    assert described == [
        "",
        "l1.alpha=0.35, l1.epsilon=1.0",
        "l1.alpha=0.35, l1.epsilon=5.0",
        "l1.alpha=0.2, l1.epsilon=5.0",
    ]


def test_baseline_has_the_same_seed_noise_and_settings(write_run: WriteRun, tmp_path: Path) -> None:
    partner = write_run([1], "l1=off", "label=nominal", seed=3)
    write_run([1], "l1=off", "label=executed", seed=3)
    write_run([1], "l1=off", "label=nominal", seed=4)
    write_run([1], "l1=off", "label=nominal", "noise=action", seed=3)
    mine = write_run([1], "l1=slow", "label=nominal", seed=3)
    lonely = write_run([1], "l1=slow", "label=nominal", seed=5)
    study = Study(find_runs([tmp_path]))
    by_path = {run.path: run for run in study.runs}
    baseline = study.baseline_of(by_path[mine])
    assert baseline is not None and baseline.path == partner
    assert study.baseline_of(by_path[lonely]) is None


def test_tasks_and_noises_come_in_the_papers_order(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([1], "l1=off", recipe="metrpo/half_cheetah")
    write_run([1], "l1=off", "noise=observation")
    write_run([1], "l1=off", "noise=action")
    write_run([1], "l1=paper", "noise=action")
    assert list(Study(find_runs([tmp_path])).cells) == [
        Cell("inverted_pendulum", "action", "off"),
        Cell("inverted_pendulum", "action", "paper"),
        Cell("inverted_pendulum", "observation", "off"),
        Cell("half_cheetah", "none", "off"),
    ]


def test_variants_come_in_the_order_of_their_numbers(write_run: WriteRun, tmp_path: Path) -> None:
    for epsilon in ("10", "1", "0.1", "3"):
        write_run([1], "l1=paper", f"l1.epsilon={epsilon}")
    write_run([1], "l1=paper", "noise=action", "l1.epsilon=1")
    study = Study(find_runs([tmp_path]))
    found = [study.describe(cell, ("l1.epsilon",)) for cell in study.compared(("l1.epsilon",))]
    assert found == [f"l1.epsilon={value}" for value in ("1.0", "0.1", "3.0", "10.0")]


def test_algorithms_are_never_pooled(write_run: WriteRun, tmp_path: Path) -> None:
    for recipe in ("dets/inverted_pendulum", "metrpo/inverted_pendulum", "pets/inverted_pendulum"):
        write_run([1], "l1=off", recipe=recipe)
    runs = find_runs([tmp_path])
    found = studies(runs)
    assert [study.algorithm for study in found] == ["metrpo", "pets", "dets"]
    for study in found:
        ((cell, mine),) = study.cells.items()
        assert cell.variant == () and len(mine) == 1 and not study.duplicates
    with pytest.raises(ValueError, match="one algorithm, got dets, metrpo, pets"):
        Study(runs)
    with pytest.raises(ValueError, match="got no runs"):
        Study([])


def test_noise_of_other_strengths_comes_last_by_kind_and_strength() -> None:
    order = [
        "none",
        "action",
        "observation",
        "both",
        "action 0.05",
        "action 0.3",
        "action 2",
        "action 10",
        "observation 0.2",
        "action 0.3, observation 0.1",
        "action 0.3, observation 1",
    ]
    shuffled = random.Random(0).sample(order, len(order))
    assert sorted(shuffled, key=noise_order) == order
    assert noise_words("action 0.3, observation 1") == "action noise 0.3 and observation noise 1"
    assert title("half_cheetah", "observation 0.2") == "Half cheetah, observation noise 0.2"


def test_runs_with_files_of_the_users_that_changed_are_no_seeds_of_each_other(
    write_run: WriteRun, tmp_path: Path
) -> None:
    for seed, (reward, data) in enumerate(("ac", "ac", "bc", "bc")):
        run = write_run([1], "l1=off", "reward=own.py:reward", seed=seed)
        digests = {"own.py": f"sha256 {reward}", "data.npz": f"sha256 {data}", "torch": str(seed)}
        (run / "versions.json").write_text(json.dumps(digests))
    (study,) = studies(find_runs([tmp_path]))
    seeds = {
        cell.variant: [run.identity.seed for run in runs] for cell, runs in study.cells.items()
    }
    assert seeds == {(): [0, 1], (("own.py", "sha256 b"),): [2, 3]}
