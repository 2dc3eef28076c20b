"""A disturbance that is declared once is there for users everywhere."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.envs import Transform

from torchrl_l1.campaign.description import load_yaml, read_campaign
from torchrl_l1.campaign.evaluation import evaluate_run, is_evaluated
from torchrl_l1.cli import main
from torchrl_l1.envs import DISTURBANCES, Perturbation, make_env
from torchrl_l1.envs.perturbations import disturbance, disturbances_of
from torchrl_l1.experiment import evaluate as evaluate_module
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.report import evaluation_figures, report

Recipe = Callable[..., DictConfig]


class Backlash(Transform):
    """Takes a constant off the action's absolute value."""

    def __init__(self, width: float | Sequence[float]) -> None:
        super().__init__()
        self.width = width

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"]
        return tensordict.set("action", action.sign() * (action.abs() - self.width).clamp(min=0))


@dataclass
class WithToy(Perturbation):
    """What a line in :class:`Perturbation` would make of it."""

    actuator_backlash: float = disturbance(
        "toy", Backlash, neutral=0.0, units="toy units", help="toy widths"
    )


@pytest.fixture(autouse=True)
def _declared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DISTURBANCES, "toy", disturbances_of(WithToy)["toy"])
    monkeypatch.setattr(evaluate_module, "Perturbation", WithToy)


def read(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as handle:
        return list(csv.DictReader(handle))


def test_environment_and_recipe_key() -> None:
    assert OmegaConf.structured(WithToy).actuator_backlash == 0.0
    env = make_env("inverted_pendulum", 1, actuator_backlash=0.1, actuator_bias=0.5, seed=0)
    assert [type(transform).__name__ for transform in env.transform] == ["Backlash", "ActuatorBias"]
    with pytest.raises(TypeError, match=r"'viscosity'; its disturbances are actuator_bias, .*lash"):
        make_env("inverted_pendulum", viscosity=0.1)


def test_command_campaign_and_report(
    tiny_recipe: Recipe,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: dict[str, Figure] = {}
    save = evaluation_figures.save

    def keep(figure: Figure, file: Path) -> Path:
        drawn[file.stem] = figure
        return save(figure, file)

    monkeypatch.setattr(evaluation_figures, "save", keep)
    directory = run(tiny_recipe())
    table = directory / "evaluations" / "disturbances.csv"

    # The command: option, column, printed table and chart.
    options = ["--policy", "stochastic", "--episodes", "2", "--l1", "off"]
    main(["evaluate", str(directory), "--toy", "0", "9", *options])
    rows = read(directory / "evaluation" / "evaluation.csv")
    columns = [name for name in rows[0] if name not in DISTURBANCES or name in ("bias", "toy")]
    assert columns[2:6] == ["l1", "noise", "bias", "toy"]
    assert [(row["bias"], row["gain"], row["toy"]) for row in rows] == [
        ("0.0", "1.0", "0.0"),
        ("0.0", "1.0", "9.0"),
    ]
    assert rows[0]["return_mean"] != rows[1]["return_mean"]
    assert "| toy |" in capsys.readouterr().out
    assert drawn["robustness"].axes[0].get_xlabel() == "actuator backlash (toy units)"
    with pytest.raises(SystemExit):
        main(["evaluate", "--help"])
    assert "toy widths" in capsys.readouterr().out

    # The campaign: key, checks, table, and tables that are older than the disturbance.
    file = tmp_path / "mine.yaml"
    runs = "runs: [{recipe: metrpo/inverted_pendulum}]\n"
    own = "name: disturbances, policy: [stochastic], episodes: 2"
    file.write_text(f"{runs}evaluations: [{{{own}, toy: [0, 9]}}, {{{own}}}]")
    toy, plain = read_campaign(str(file)).evaluations
    evaluate_run(str(directory), "disturbances", toy.of_a_run())
    assert [row["toy"] for row in read(table)] == ["0.0", "0.0", "9.0", "9.0"]
    assert is_evaluated(RunDirectory(directory), toy)
    assert not is_evaluated(RunDirectory(directory), plain)
    described = table.with_suffix(".yaml")
    assert load_yaml(described)["toy"] == [0.0, 9.0]
    described.write_text(described.read_text().replace("toy:\n- 0.0\n- 9.0\n", ""))
    assert is_evaluated(RunDirectory(directory), plain)
    file.write_text(f"{runs}evaluations: [{{{own}, toy: [.nan]}}]")
    with pytest.raises(ValueError, match="toy must be finite"):
        read_campaign(str(file))

    # The report: chart and column of a table; other tables read as neutral.
    (table.parent / "mine.csv").write_text(table.read_text())
    lines = [line.split(",") for line in table.read_text().splitlines()]
    place = lines[0].index("toy")
    old = [",".join(cells[:place] + cells[place + 1 :]) for cells in lines if cells[place] != "9.0"]
    (table.parent / "old.csv").write_text("\n".join(old) + "\n")
    page = report([directory], tmp_path / "report")
    section = page.read_text().split("## Disturbances")[1].split("## ")[0]
    assert "against an actuator backlash that" in section
    (chart,) = (figure for name, figure in drawn.items() if name.startswith("disturbances"))
    assert chart.axes[0].get_xlabel() == "actuator backlash (toy units)"
    assert list(chart.axes[0].lines[0].get_xdata()) == [0.0, 9.0]
    mine, older = (
        page.read_text().split(f"## Evaluation `{name}`")[1].split("## ")[0]
        for name in ("mine", "old")
    )
    assert "| toy |" in mine and "| 9 |" in mine
    assert "toy" not in older
    assert {row["toy"] for row in read(page.parent / "old.csv")} == {"0.0"}
    spoilt = (table.parent / "mine.csv").read_text().replace(",9.0,", ",often,")
    (table.parent / "mine.csv").write_text(spoilt)
    assert "toy is 'often', not a finite number" in report([directory], tmp_path / "r").read_text()
