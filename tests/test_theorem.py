"""Theorem 1 on plants with known constants, by the script of the documentation's page."""

from __future__ import annotations

import csv
import importlib
import math
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def read(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as handle:
        return list(csv.DictReader(handle))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs/results"))  # as when it is run from there
        module = importlib.import_module("theorem1")
    folder = tmp_path_factory.mktemp("theorem1")
    module.main(folder, quick=True)
    return folder


def test_the_error_is_proportional_to_the_sampling_time(results: Path) -> None:
    slopes = [
        float(row["slope"]) for row in read(results / "slopes.csv") if row["plant"] == "linear"
    ]
    assert slopes and all(abs(slope - 1) < 0.1 for slope in slopes)


def test_the_error_is_below_the_bound_and_its_floor_below_twice_epsilon(results: Path) -> None:
    floors = []
    for row in read(results / "slopes.csv"):
        if row["plant"] == "sampled actions":
            assert float(row["closest_to_print"]) > 1  # they break the assumption
            continue
        assert float(row["closest_to_bound"]) < 1 and float(row["closest_to_print"]) < 1
        ratio = float(row["floor_over_epsilon"])
        if not math.isnan(ratio):
            floors.append(ratio)
    assert 1.9 < max(floors) < 2.01


def test_the_weighted_estimate_is_at_the_cramer_rao_bound(results: Path) -> None:
    rows = read(results / "matched.csv")
    of = {(float(r["noise_ratio"]), r["estimator"]): float(r["over_cramer_rao"]) for r in rows}
    for (ratio, estimator), variance in of.items():
        if estimator == "weighted":
            assert 0.9 < variance < 1.1
        elif ratio > 50:
            assert variance > 50


def test_the_committed_results_are_those_of_the_full_script(results: Path) -> None:
    committed = ROOT / "docs/results/theorem1"
    for name in ("slopes.csv", "matched.csv"):
        assert read(committed / name)[0].keys() == read(results / name)[0].keys()
    linear = next(r for r in read(committed / "slopes.csv") if r["plant"] == "linear")
    assert f"| {float(linear['slope']):.3g} |" in (committed / "slopes.md").read_text()
