"""Ablation bars, disturbance charts and sweeps: what is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import pytest
from matplotlib.figure import Figure

from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.report import evaluation_figures, report
from torchrl_l1.report.evaluation_figures import (
    RANGES,
    plot_disturbances,
    plot_tuning,
    tuning_rows,
)
from torchrl_l1.report.identity import facts

WriteRun = Callable[..., Path]
METRPO = facts("metrpo")


def row(l1: str, bias: float = 0.0, gain: float = 1.0, **values: Any) -> dict[str, Any]:
    return {"l1": l1, "noise": "none", "bias": bias, "gain": gain, "policy": "stochastic", **values}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    figures: list[Figure] = []
    save = evaluation_figures.save
    monkeypatch.setattr(
        evaluation_figures,
        "save",
        lambda figure, file: (figures.append(figure), save(figure, file))[1],
    )
    return figures


def test_each_return_stands_above_what_l1_adds_to_it(drawn: list[Figure], tmp_path: Path) -> None:
    rows = [
        *(row("off", bias=bias, return_mean=-100 * bias) for bias in (0.0, 0.5, 1.0)),
        *(
            row(
                "paper",
                bias=bias,
                return_mean=-bias,
                difference_mean=99 * bias,
                difference_low=90 * bias,
                difference_high=108 * bias,
            )
            for bias in (1.0, 0.0, 0.5)
        ),
        *(row("off", gain=gain, return_mean=-1 / gain) for gain in (0.5, 2.0)),
    ]
    assert (
        plot_disturbances(rows, "Task", tmp_path / "figure.png", METRPO) == tmp_path / "figure.png"
    )
    bias, gain, difference, _ = drawn[0].axes
    assert [axis.get_xlabel()[:13] for axis in (bias, gain)] == ["actuator bias", "actuator gain"]
    off, paper = bias.lines
    assert list(off.get_ydata()) == [0, -50, -100]
    assert list(paper.get_ydata()) == [0, -0.5, -1]
    (added,) = [line for line in difference.lines if line.get_marker() == "o"]
    assert list(added.get_xdata()) == [0, 0.5, 1]
    assert list(added.get_ydata()) == [0, 49.5, 99]
    assert difference.get_ylabel() == "return, less that with L1 off"
    # Returns between 0 and far below are shown on a logarithmic scale, differences never.
    assert (bias.get_yscale(), difference.get_yscale()) == ("symlog", "linear")


def test_no_two_controllers_look_the_same(drawn: list[Figure], tmp_path: Path) -> None:
    tuned = [f"paper epsilon={value}" for value in range(9)]
    rows = [
        row(l1, bias=bias, return_mean=place - bias)
        for bias in (0.0, 1.0)
        for place, l1 in enumerate(("off", "paper", *tuned, "oracle"))
    ]
    plot_disturbances(rows, "Task", tmp_path / "a.png", METRPO)
    lines = drawn[0].axes[0].lines
    assert len({(line.get_color(), line.get_marker()) for line in lines}) == 12
    colors = [line.get_color() for line in lines]
    assert colors[0] not in colors[1:] and colors[-1] not in colors[:-1]

    swept = [
        row("paper", option="paper", epsilon=epsilon, alpha=alpha / 20, return_mean=1.0)
        for epsilon in (0.1, 1.0)
        for alpha in range(1, 9)
    ]
    plot_tuning(swept, "Task", tmp_path / "b.png")
    (axis,) = drawn[1].axes
    assert len({(line.get_color(), line.get_marker()) for line in axis.lines}) == 8


def test_limits_beyond_what_a_return_can_be_change_no_scale(
    drawn: list[Figure], tmp_path: Path
) -> None:
    rows = [
        row("off", bias=bias, return_mean=-60 * bias, return_low=-130 * bias, return_high=10 * bias)
        for bias in (0.0, 1.0)
    ]
    plot_disturbances(rows, "Task", tmp_path / "figure.png", METRPO)
    (axis,) = drawn[0].axes
    assert axis.get_yscale() == "symlog"
    assert axis.get_ylim()[0] < -130


def test_nothing_varied_draws_nothing(tmp_path: Path) -> None:
    assert (
        plot_disturbances([row("off", return_mean=1.0)], "Task", tmp_path / "x.png", METRPO) is None
    )
    assert not (tmp_path / "x.png").exists()


def test_seeds_of_an_evaluation_are_drawn_by_the_same_hand(
    drawn: list[Figure], tmp_path: Path
) -> None:
    rows = [
        row(l1, bias=bias, noise=noise, return_median=-9 * bias, return_lowest=-20 * bias - 1)
        | {"return_highest": -bias / 10}
        for noise in ("none", "action")
        for l1 in ("off", "paper")
        for bias in (1.0, 0.0)
    ]
    rows += [{**r, "bias": 0.0, "gain": 0.6} for r in rows if r["bias"] == 1.0]
    plot_disturbances(rows, "Task", tmp_path / "a.png", METRPO, (RANGES,))
    panels = [axis for axis in drawn[0].axes if axis.get_visible()]
    assert [(axis.get_title(), axis.get_xlabel()) for axis in panels] == [
        (f"sampled actions{more}", f"actuator {what}")
        for more in ("", ", noise: action")
        for what in ("bias (action units)", "gain (factor)")
    ]
    off, paper = panels[0].lines
    assert list(off.get_xdata()) == list(paper.get_xdata()) == [0.0, 1.0]
    band = panels[0].collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (-21.0, 0.0)
    # One test alone still has a point to show, where it is asked for.
    assert plot_disturbances(rows[1:2], "Task", tmp_path / "b.png", METRPO, (RANGES,)) is None
    assert plot_disturbances(rows[1:2], "Task", tmp_path / "b.png", METRPO, (RANGES,), True)
    (axis,) = drawn[1].axes
    assert axis.get_xlabel() == "actuator bias (action units)"


def rows_of(
    epsilon: tuple[float | None, ...] = (0.1, 1.0, 10.0),
    alpha: tuple[float | None, ...] = (0.05, 0.35),
    policy: str = "deterministic",
    bias: tuple[float, ...] = (1.0, 0.0),
) -> list[dict[str, Any]]:
    """Rows as :func:`evaluation_rows` gives them, in an order that is not the figure's."""
    rows = []
    for b in bias:
        base = {"noise": "none", "bias": b, "gain": 1.0, "policy": policy}
        rows.append(base | {"l1": "off", "return_mean": -50.0 * b - 0.1})
        for a in alpha:
            for e in reversed(epsilon):
                controller = {"l1": f"paper {e} {a}", "option": "paper", "epsilon": e, "alpha": a}
                mean = -0.2 - (a or 0.0) - 30 * b - 0.001 * (e or 0.0)
                returns = {"return_mean": mean, "return_low": mean - 0.1, "return_high": mean + 0.1}
                switches = {"switches_per_1000_steps": 100 / (e or 1.0) + (a or 0.0)}
                rows.append(base | controller | returns | switches)
    return rows


def test_panels_hold_the_rows(drawn: list[Figure], tmp_path: Path) -> None:
    file = plot_tuning(rows_of(), "Task", tmp_path / "figure.png")
    assert file is not None and matplotlib.image.imread(file).std() > 0.05
    switches, quiet, biased = (axis for axis in drawn[0].axes if axis.get_visible())
    titles = [axis.get_title() for axis in (switches, quiet, biased)]
    assert titles == ["switches, undisturbed", "return, undisturbed", "return, bias 1"]
    assert {axis.get_xscale() for axis in (switches, quiet, biased)} == {"log"}
    assert [line.get_label() for line in switches.get_lines()] == [
        "L1 paper alpha=0.05",
        "L1 paper alpha=0.35",
    ]
    slow = switches.get_lines()[0]
    assert slow.get_xdata() == pytest.approx([0.1, 1.0, 10.0])
    assert slow.get_ydata() == pytest.approx([1000.05, 100.05, 10.05])
    for axis, bias in ((quiet, 0.0), (biased, 1.0)):
        *lines, off = axis.get_lines()
        assert (off.get_label(), off.get_linestyle()) == ("L1 off", "--")
        assert list(off.get_ydata()) == [-50.0 * bias - 0.1] * 2
        fast = lines[1]
        expected = [-0.55 - 30 * bias - 0.001 * e for e in (0.1, 1.0, 10.0)]
        assert fast.get_ydata() == pytest.approx(expected)
        # Moved aside by less than the way to the next value.
        assert fast.get_xdata() == pytest.approx([0.1, 1.0, 10.0], rel=0.5)
        spans = axis.collections[1].get_segments()
        assert [s[1, 1] - s[0, 1] for s in spans] == pytest.approx([0.2] * 3)
        assert [s[0, 0] for s in spans] == pytest.approx(fast.get_xdata())


def test_a_tolerance_of_zero_stands_a_step_below_the_others(
    drawn: list[Figure], tmp_path: Path
) -> None:
    plot_tuning(rows_of((0.0, 0.1, 1.0), (0.35,)), "Task", tmp_path / "figure.png")
    switches, quiet, _ = (axis for axis in drawn[0].axes if axis.get_visible())
    for axis in (switches, quiet):
        assert list(axis.get_lines()[0].get_xdata()) == pytest.approx([0.01, 0.1, 1.0])
        assert list(axis.get_xticks()) == pytest.approx([0.01, 0.1, 1.0])
        assert [label.get_text() for label in axis.get_xticklabels()] == ["0", "0.1", "1"]


def test_of_many_disturbances_those_with_several_magnitudes_are_drawn(
    drawn: list[Figure], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["lag", "play", "load", "sway"]
    for name in names:
        entry = replace(DISTURBANCES["bias"], name=name, setting=f"actuator_{name}")
        monkeypatch.setitem(DISTURBANCES, name, entry)
    nothing = dict.fromkeys(names, 0.0)
    levels = {"bias": (1.0, 2.0), **{name: (1.0, 2.0) for name in names}, "gain": (0.5,)}
    rows = [row("off", return_mean=0.0, **nothing)] + [
        {**row("off", return_mean=-value, **nothing), name: value}
        for name, values in levels.items()
        for value in values
    ]
    rows += [{**one, "l1": "paper", "difference_mean": 1.0} for one in rows]
    plot_disturbances(rows, "Task", tmp_path / "figure.png", METRPO)
    panels = [axis for axis in drawn[0].axes if axis.get_visible()]
    found = [(axis.get_xlabel().split()[1], axis.get_ylabel()[:10]) for axis in panels]
    # Four across, each difference below its return.
    first, last = ["bias", "lag", "play", "load"], ["sway"]
    assert found == [
        (name, words)
        for group in (first, last)
        for words in ("return (su", "return, le")
        for name in group
    ]
    left = {round(axis.get_position().x0, 2) for axis in panels}
    assert len(left) == 4


def test_alpha_alone_takes_the_axis(drawn: list[Figure], tmp_path: Path) -> None:
    for epsilon in ((None,), (0.3,)):
        assert plot_tuning(rows_of(epsilon), "Task", tmp_path / "figure.png")
        switches = drawn[-1].axes[0]
        assert "alpha" in switches.get_xlabel()
        (line,) = switches.get_lines()
        assert line.get_xdata() == pytest.approx([0.05, 0.35])
    assert line.get_label() == "L1 paper epsilon=0.3"


def test_nothing_swept_or_no_switches_known(drawn: list[Figure], tmp_path: Path) -> None:
    file = tmp_path / "figure.png"
    assert plot_tuning(rows_of((0.3,), (0.1,)), "Task", file) is None
    assert plot_tuning([row for row in rows_of() if "option" not in row], "Task", file) is None
    assert plot_tuning([], "Task", file) is None
    assert not file.exists()
    rows = [{k: v for k, v in row.items() if "switch" not in k} for row in rows_of()]
    assert plot_tuning(rows, "Task", file)
    assert [axis.get_title()[:6] for axis in drawn[0].axes if axis.get_visible()] == ["return"] * 2


def test_sampled_actions_come_first() -> None:
    both = rows_of(policy="stochastic", bias=(2.0,)) + rows_of(policy="deterministic")
    policy, rows = tuning_rows(both)
    assert policy == "stochastic"
    assert {row["bias"] for row in rows} == {2.0}
    assert tuning_rows(rows_of(policy="deterministic"))[0] == "deterministic"


@pytest.mark.parametrize("policy", ["stochastic", "deterministic"])
def test_report_shows_the_sweep_in_its_section(
    write_run: WriteRun, tmp_path: Path, policy: str
) -> None:
    base = {"noise": "none", "gain": 1.0, "bias": 0.0, "episodes": 5, "policy": policy}
    nothing = {"epsilon": "", "alpha": "", "l1/switch_rate": ""}
    for seed in range(3):
        tests = [base | nothing | {"l1": "off", "return_mean": -1.0 - seed}]
        for epsilon in (0.1, 10.0):
            swept = {"epsilon": epsilon, "alpha": "", "l1/switch_rate": 0.1}
            tests.append(base | swept | {"l1": "paper", "return_mean": -0.5 - epsilon * seed})
        plain = [base | {"l1": "off", "return_mean": -1.0}]
        write_run([1.0], "l1=off", seed=seed, evaluations={"tolerance": tests, "plain": plain})
    page = report([tmp_path / "runs"])
    section = page.read_text().split("\n## Evaluation `tolerance`\n")[1].split("\n## ")[0]
    picture = "sweep_tolerance_inverted_pendulum_none_off.png"
    actions = {"stochastic": "sampled actions", "deterministic": "mean action"}[policy]
    assert f"L1 off; tested with {actions}]({picture})" in section
    assert "dashed: the same policies without L1" in section
    assert "| paper | 0.1 |" in section
    assert [file.name for file in page.parent.glob("sweep_*")] == [picture]
