"""Reports over runs of several algorithms."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.stats import ttest_1samp

from tests.report.conftest import run_directory
from torchrl_l1.report import curves, report
from torchrl_l1.report.comparison import (
    algorithm_pairs,
    algorithm_rows,
    compared_places,
    differing_settings,
    plot_algorithms,
)
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.study import studies

WriteRun = Callable[..., Path]
RNG = np.random.default_rng(0)

METRPO_PENDULUM, PETS_PENDULUM, DETS_PENDULUM = (
    f"{name}/inverted_pendulum" for name in ("metrpo", "pets", "dets")
)
STRONG = "perturbation.action_noise=0.3"
CURVES = "arm,setting,seed,iteration,total_train_samples,average_return\n" + "".join(
    f"{arm},Inverted_Pendulum,1,{i},{(i + 2) * 1666},{-60 + 10 * i}\n"
    for arm in ("L1_OFF", "L1_ON")
    for i in range(4)
)


def disturbed(*policies: str) -> dict[str, list[dict[str, Any]]]:
    base = {"gain": 1.0, "episodes": 10, "noise": "none"}
    rows = [
        base | {"l1": l1, "bias": bias, "policy": policy, "return_mean": -1 - 9 * bias}
        for policy in policies
        for l1 in ("off", "paper")
        for bias in (0.0, 1.0)
    ]
    return {"disturbances": rows, "sim_to_real": rows, "ablation": rows}


@contextmanager
def kept_figures() -> Iterator[dict[str, Figure]]:
    """Figures of learning curves that are drawn meanwhile, by the names of their files."""
    figures: dict[str, Figure] = {}
    save = curves.save

    def keep(figure: Figure, file: Path) -> Path:
        figures[file.stem] = figure
        return save(figure, file)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curves, "save", keep)
        yield figures


@pytest.fixture
def drawn() -> Iterator[dict[str, Figure]]:
    with kept_figures() as figures:
        yield figures


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Figure]]:
    """The report of METRPO, PETS and DETS on the pendulum, and PETS alone on HalfCheetah."""
    folder = tmp_path_factory.mktemp("whole")
    runs = (folder / "runs" / f"run_{number:03}" for number in itertools.count())
    rest = {"random": 0.1, "collect": 2.0, "evaluate": 0.25}
    for recipe, policies, phase in (
        (METRPO_PENDULUM, ("stochastic", "deterministic"), {"trpo": 3.0}),
        (PETS_PENDULUM, ("stochastic",), {}),
        (DETS_PENDULUM, ("stochastic",), {}),
    ):
        timings = [{"iteration": i, "fit": 1.0, **rest, **phase} for i in range(3)]
        for noise in ("noise=none", STRONG):
            for arm in ("off", "paper"):
                for seed in range(3):
                    run_directory(
                        next(runs), (-np.geomspace(80, 0.1 + seed, 3)).tolist(), f"l1={arm}",
                        noise, recipe=recipe, seed=seed, timings=timings,
                        evaluations=disturbed(*policies), steps=2500 if phase else 100,
                    )  # fmt: skip
    run_directory(next(runs), [1, 2, 3], "l1=off", recipe="pets/half_cheetah")
    (folder / "curves.csv").write_text(CURVES)
    with kept_figures() as figures:
        page = report([folder / "runs"], folder / "out", folder / "curves.csv")
    return page, figures


def labels(figure: Figure) -> list[str]:
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


def test_report_has_sections_of_each_algorithm_and_compares_them(
    whole: tuple[Path, dict[str, Figure]],
) -> None:
    page, _ = whole
    text = page.read_text()
    assert "METRPO (12 runs), PETS (13 runs), DETS (12 runs)" in text
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    sections = ["Training", "L1 less baseline", "Learning curves", "Where the time goes"]
    sections += ["Sim to real", "Ablation", "Disturbances"]
    expected = [f"{name}: {section}" for name in ("METRPO", "PETS", "DETS") for section in sections]
    assert headings == [*expected, "Algorithms", "Versions"]

    figures = re.findall(r"!\[[^]]+]\(([^)]+)\)", text)
    assert "algorithms_inverted_pendulum.png" in figures
    assert "algorithms_half_cheetah.png" not in figures
    for figure in ("learning_curves_inverted_pendulum", "ablation_paper"):
        assert {f"{name}_{figure}.png" for name in ("metrpo", "pets", "dets")} <= set(figures)
    assert len(figures) == len(set(figures))
    for figure in figures:
        assert matplotlib.image.imread(page.parent / figure).std() > 0.05
    linked = re.findall(r"\(\./([^)]+\.csv)\)", text)
    assert len(linked) == len(set(linked))
    assert set(linked) == {file.name for file in page.parent.glob("*.csv")}
    with (page.parent / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["algorithm"] for row in rows] == ["METRPO"] * 12 + ["PETS"] * 13 + ["DETS"] * 12


def test_what_is_published_stands_beside_its_own_algorithm_only(
    whole: tuple[Path, dict[str, Figure]],
) -> None:
    page, drawn = whole
    text = page.read_text()
    grey = {name for name, figure in drawn.items() if "authors' logs" in str(labels(figure))}
    assert len(drawn) == 5 and grey == {"metrpo_learning_curves_inverted_pendulum"}
    dashed = {name for name, figure in drawn.items() if "mean action" in labels(figure)}
    assert dashed == grey
    found = {
        heading: section
        for heading, section in re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    }
    for heading, section in found.items():
        mine = heading.startswith("METRPO")
        headers = re.findall(r"^\|(.*)\|\n\|--", section, re.M)
        columns = {column.strip() for header in headers for column in header.split("|")}
        assert mine or not any(column.startswith("paper") for column in columns), heading
        for words in ("authors' logs", "the paper's Table"):
            assert words not in section or mine, (heading, words)
        if not mine:
            assert "mean action" not in section and "sampled actions" not in section, heading
            assert "TRPO" not in section.replace("METRPO", ""), heading
            assert " stochastic " not in section, heading
    assert "| authors' logs |" in found["METRPO: Training"]
    assert "| paper, L1 off |" in found["METRPO: Sim to real"]
    for name in ("metrpo", "pets", "dets"):
        for table in ("training", "sim_to_real", "ablation"):
            header = page.with_name(f"{name}_{table}.csv").read_text().splitlines()[0]
            assert ("paper_mean" in header) == (name == "metrpo")


def test_one_algorithm_alone_is_named_once(write_run: WriteRun, tmp_path: Path) -> None:
    for arm in ("off", "paper"):
        write_run([-2, -1], f"l1={arm}", recipe=DETS_PENDULUM)
    page = report([tmp_path / "runs"])
    text = page.read_text()
    assert "The algorithm is DETS." in text
    assert "\n## Training\n" in text and "## Algorithms" not in text
    names = {file.name for file in page.parent.iterdir()}
    assert {"training.csv", "pairs.csv", "learning_curves_inverted_pendulum.png"} <= names
    assert not any(name.startswith("dets") for name in names)


def test_algorithms_without_a_common_task_are_not_compared(
    write_run: WriteRun, tmp_path: Path
) -> None:
    write_run([1], "l1=off", recipe=PETS_PENDULUM)
    write_run([1], "l1=off", STRONG, recipe=DETS_PENDULUM)
    text = report([tmp_path / "runs"]).read_text()
    assert "## PETS: Training" in text and "## DETS: Training" in text
    assert "## Algorithms" not in text


def test_pairs_of_algorithms_against_numpy(write_run: WriteRun, tmp_path: Path) -> None:
    returns = {
        (recipe, noise, arm): RNG.normal(-50, 10, (5, 4))
        for recipe in (PETS_PENDULUM, DETS_PENDULUM)
        for noise in ("noise=none", STRONG)
        for arm in ("off", "paper")
    }
    for (recipe, noise, arm), values in returns.items():
        for seed, curve in enumerate(values):
            if (recipe, arm, seed) not in ((PETS_PENDULUM, "off", 2), (DETS_PENDULUM, "paper", 4)):
                write_run(curve, noise, f"l1={arm}", recipe=recipe, seed=seed)
    # Settings of their own: no main run, and no part of the comparison.
    write_run([7, 7, 7, 7, 7], "l1=off", recipe=PETS_PENDULUM, seed=2)
    found = studies(find_runs([tmp_path]))
    rows = algorithm_pairs(found)
    assert [(row["noise"], row["of"], row["less"]) for row in rows] == [
        (noise, *names)
        for noise in ("none", "action 0.3")
        for names in (("DETS", "PETS"), ("L1-DETS", "PETS"), ("L1-DETS", "L1-PETS"))
    ]
    arms = {"DETS": "off", "L1-DETS": "paper", "PETS": "off", "L1-PETS": "paper"}
    for row in rows:
        noise = "noise=none" if row["noise"] == "none" else STRONG
        ours = returns[DETS_PENDULUM, noise, arms[row["of"]]][:, 1:].mean(axis=1)
        base = returns[PETS_PENDULUM, noise, arms[row["less"]]][:, 1:].mean(axis=1)
        alone = [2] * (row["less"] == "PETS") + [4] * (row["of"] == "L1-DETS")
        kept = [seed for seed in range(5) if seed not in alone]
        differences = (ours - base)[kept]
        assert row["seeds"].split() == list(map(str, kept))
        assert row["without_pair"].split() == list(map(str, alone))
        assert row["difference_mean"] == pytest.approx(differences.mean())
        interval = ttest_1samp(differences, 0.0).confidence_interval(0.95)
        assert (row["difference_low"], row["difference_high"]) == pytest.approx(
            (interval.low, interval.high)
        )

    table = {(row["noise"], row["algorithm"], row["l1"]): row for row in algorithm_rows(found)}
    assert len(table) == 8
    row = table["action 0.3", "DETS", "paper"]
    values = returns[DETS_PENDULUM, STRONG, "paper"][:4, 1:]
    assert row["return_mean"] == pytest.approx(values.mean())
    assert row["published_spread"] == pytest.approx(values.std(axis=0).mean())
    assert (row["seeds"], row["real_steps"]) == (4, 5 * 2500)


def test_comparison_says_which_settings_differ(write_run: WriteRun, tmp_path: Path) -> None:
    for arm in ("off", "paper"):
        write_run([1], f"l1={arm}", "cem.candidates=50", recipe=PETS_PENDULUM)
        write_run([1], f"l1={arm}", "cem.candidates=60", "l1.epsilon=3", recipe=DETS_PENDULUM)
    write_run([1], "l1=robust", "cem.candidates=50", "l1.epsilon=2", recipe=PETS_PENDULUM)
    write_run([1], "l1=robust", "cem.candidates=60", "l1.epsilon=0.5", recipe=DETS_PENDULUM)
    assert differing_settings(studies(find_runs([tmp_path])), "inverted_pendulum") == {
        "cem.candidates": {"PETS": "50", "DETS": "60"},
        "model.head": {"PETS": "gaussian", "DETS": "deterministic"},
        "l1.epsilon": {
            "L1-PETS": "1.0",
            "L1-DETS": "3.0",
            "L1-PETS (robust)": "2.0",
            "L1-DETS (robust)": "0.5",
        },
    }
    text = report([tmp_path / "runs"]).read_text()
    assert "`cem.candidates` 50 (PETS), 60 (DETS);" in text


def test_only_common_places_are_compared(write_run: WriteRun, tmp_path: Path) -> None:
    for noise in (STRONG, "noise=observation", "noise=none"):
        write_run([1], "l1=off", noise, recipe=PETS_PENDULUM)
    for noise in (STRONG, "noise=none", "perturbation.action_noise=0.05"):
        write_run([1], "l1=off", noise, recipe=DETS_PENDULUM)
    write_run([1], "l1=off", recipe="pets/half_cheetah")
    found = studies(find_runs([tmp_path]))
    assert compared_places(found) == {"inverted_pendulum": ["none", "action 0.3"]}


def test_curves_have_the_algorithms_colour_and_the_arms_style(
    write_run: WriteRun, drawn: dict[str, Figure], tmp_path: Path
) -> None:
    for recipe, steps in ((PETS_PENDULUM, 100), (DETS_PENDULUM, 100), (METRPO_PENDULUM, 2500)):
        for arm in ("off", "paper"):
            for seed in range(2):
                write_run([-9, -5 + seed], f"l1={arm}", recipe=recipe, seed=seed, steps=steps)
        if recipe != METRPO_PENDULUM:
            write_run([-9, -1], "l1=off", STRONG, recipe=recipe, steps=steps)
    found = studies(find_runs([tmp_path]))
    file = tmp_path / "figure.png"
    noises = ["none", "action 0.3"]
    assert plot_algorithms(found, "inverted_pendulum", noises, file) == file
    none, strong = (axis for axis in drawn["figure"].axes if axis.get_visible())
    assert [axis.get_title() for axis in (none, strong)] == [
        "Inverted pendulum, no noise",
        "Inverted pendulum, action noise 0.3",
    ]
    bold = {line.get_label(): line for line in none.lines if not line.get_label().startswith("_")}
    assert list(bold) == ["METRPO", "L1-METRPO", "PETS", "L1-PETS", "DETS", "L1-DETS"]
    colors = {name: line.get_color() for name, line in bold.items()}
    assert all(colors[name] == colors[f"L1-{name}"] for name in ("METRPO", "PETS", "DETS"))
    assert len(set(colors.values())) == 3
    styles = {name.startswith("L1-"): set() for name in bold}
    for name, line in bold.items():
        styles[name.startswith("L1-")].add(line.get_linestyle())
    assert styles == {True: {"-"}, False: {"--"}}
    assert list(bold["PETS"].get_ydata()) == [-9, -4.5]
    assert len(none.lines) == 6 * (2 + 1)
    # 7500 steps and 300 are not told apart on the same linear axis.
    assert (none.get_xscale(), strong.get_xscale()) == ("log", "linear")
    assert labels(drawn["figure"]) == list(bold)
