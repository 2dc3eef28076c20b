"""Recipes are data, overrides are checked, and errors are a line."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from hydra.core.plugins import Plugins

import torchrl_l1
from torchrl_l1.campaign.description import CampaignError, read_campaign
from torchrl_l1.campaign.plan import plan
from torchrl_l1.cli import main
from torchrl_l1.experiment.errors import RecipeError
from torchrl_l1.experiment.launch import compose, launch
from torchrl_l1.experiment.recipes import recipes_dir

PENDULUM = "metrpo/inverted_pendulum"
OWN = "defaults: [metrpo_recipe, _self_]\nrecipe: own\ntask: inverted_pendulum\n"
CALLBACK = """
hydra:
  callbacks:
    harm:
      _target_: hydra.experimental.callbacks.PickleJobInfoCallback
"""


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def line_of(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What a refused command says: a single line."""
    with pytest.raises(SystemExit) as exit_info:
        main(arguments)
    assert exit_info.value.code == 1
    printed = capsys.readouterr()
    lines = printed.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("torchrl-l1 "), printed.err
    return lines[0]


FORMS: dict[str, dict[str, str]] = {
    "a section": {"own.yaml": OWN + CALLBACK},
    "another section": {"own.yaml": OWN + "hydra: {job_logging: {root: {level: DEBUG}}}\n"},
    "a file that it includes": {
        "own.yaml": OWN.replace("metrpo_recipe", "metrpo_recipe, other@_global_"),
        "other.yaml": CALLBACK,
    },
    "a file in a package of Hydra's": {
        "own.yaml": OWN.replace("_self_", "_self_, other@hydra.callbacks"),
        "other.yaml": "harm: {_target_: builtins.print}\n",
    },
    "a launcher of its own": {
        "own.yaml": OWN.replace("_self_", "override hydra/launcher: mine, _self_").replace(
            "override hydra/launcher: mine", "{override hydra/launcher: mine}"
        ),
        "hydra/launcher/mine.yaml": "_target_: builtins.print\n",
    },
    "a launcher in the place of another": {
        "own.yaml": OWN,
        "hydra/launcher/basic.yaml": "_target_: builtins.print\n",
        "hydra/job_logging/disabled.yaml": "root: {level: DEBUG}\nversion: 1\n",
    },
}


@pytest.mark.parametrize("form", list(FORMS))
def test_a_recipe_that_sets_up_hydra_is_refused(
    form: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for name, text in FORMS[form].items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    for more in ([], ["-m", "seed=0,1"]):
        line = line_of(["run", "own.yaml", "run_dir=x", *more], capsys)
        assert "--trust" in line and "hydra" in line
    assert not (tmp_path / "x").exists()


def test_who_trusts_a_recipe_may_run_it(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(OWN + CALLBACK)
    main(["run", "own.yaml", "--trust", "run_dir=x", "--cfg", "job"])
    assert "recipe: own" in capsys.readouterr().out
    with pytest.raises(RecipeError, match="--trust"):
        compose("own.yaml", ["run_dir=x"])
    assert compose("own.yaml", ["run_dir=x"], trusted=True).recipe == "own"


def test_a_campaign_is_data_too(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(OWN + CALLBACK)
    file = tmp_path / "mine.yaml"
    file.write_text("runs: [{recipe: own.yaml}]\n")
    with pytest.raises(CampaignError, match="--trust"):
        plan(read_campaign(str(file)), tmp_path)
    assert len(plan(read_campaign(str(file)), tmp_path, trusted=True)) == 1
    for entry in (
        "overrides: [hydra.callbacks.x._target_=os.abort]",
        "overrides: [+hydra/launcher=mine]",
        "matrix: {hydra.verbose: [true]}",
    ):
        file.write_text(f"runs: [{{recipe: {PENDULUM}, {entry}}}]\n")
        with pytest.raises(CampaignError, match="configures Hydra"):
            read_campaign(str(file))


@pytest.mark.parametrize(
    ("override", "hint"),
    [("+sed=1", "did you mean seed?"), ("+l1.epsillon=1", "l1.epsilon?"), ("+zz.y={a: 1}", "zz")],
)
def test_a_key_that_no_schema_knows_is_refused_with_a_plus_too(
    override: str, hint: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for more in ([], ["-m"], ["--cfg", "job"]):
        line = line_of(["run", PENDULUM, override, "run_dir=x", *more], capsys)
        assert "there is no key" in line and hint in line
    file = tmp_path / "mine.yaml"
    file.write_text(f"runs: [{{recipe: {PENDULUM}, overrides: ['{override}']}}]\n")
    line = line_of(["campaign", "mine.yaml", "--list"], capsys)
    assert "runs[0]" in line and "there is no key" in line
    assert {path.name for path in tmp_path.iterdir()} == {"mine.yaml"}


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["sed=3"], "there is no key 'sed'"),
        (["l1.epsillon=3"], "there is no key 'l1.epsillon'"),
        (["outer_iterations=many"], "outer_iterations=many"),
        (["l1=louder"], "off paper"),
        (["l1"], "'l1' is not an override: write KEY=VALUE, such as seed=3"),
        (["--seed", "3"], "'3' is not an override: write KEY=VALUE"),
        (["task=a=b"], "task=a=b: mismatched input '='"),
        (["task=a=b"], "quote a value with such characters: 'task=\"a=b\"'"),
        (["l1=[off"], "[off"),
        (["loggers=wandb"], "(write it as a list, [a,b])"),
        (["seed=0,1"], "Ambiguous value"),
        (["~nothing"], "does not exist"),
        (["label=both"], "label must be"),
        (["-m", "label=both"], "label must be"),
        (["-m", "seed=range(3,3)"], "matches nothing"),
        (["-m", "l1=glob(zz*)"], "matches nothing"),
        (["-m", "l1=glob(*"], "l1=glob("),
        (["-m", "nothing=glob(*)"], "matches nothing"),
        (["-m", "discount=interval(0.9,0.99)"], "interval"),
        (["l1.alpha=0.1", "l1.cutoff=3"], "cutoff"),
        (["-m", "l1.alpha=0.1", "l1.cutoff=3"], "cutoff"),
    ],
    ids=str,
)
def test_errors_are_a_line_that_does_not_repeat_the_command(
    overrides: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    line = line_of(["run", PENDULUM, "discount=0.987", "run_dir=x", *overrides], capsys)
    assert words in line
    assert "0.987" not in line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("defaults: [metrpo_recipe\nrecipe: own", "line 2, column"),
        ("recipe: own\ntask inverted", "line 2"),
        ("- a\n- b\n", "not a mapping of keys to values"),
        ("", "not a mapping of keys to values"),
        ("recipe: own\ntask: swimmer\n", "has no schema"),
        (OWN + "discont: 3\n", "discont"),
        (OWN + "discount: high\n", "high"),
        (OWN.replace("_self_", "_self_, nothing"), "nothing"),
        ("task: " + "[" * 3000, "nested too deeply"),
        (
            "a: &a [x, x]\n" + "".join(f"a{i}: &a{i} [*a, *a]\n" for i in range(9)) + "b: [\n",
            "line",
        ),
        ("a: &a [*a]\n", "expand it too far"),
        ("a: !!python/object/apply:os.mkdir [harm]\n" + OWN, "python"),
    ],
)
def test_a_slip_in_a_recipe_is_told_in_a_line(
    text: str, words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "own.yaml").write_text(text)
    assert words in line_of(["run", "own.yaml", "run_dir=x"], capsys)
    assert {path.name for path in tmp_path.iterdir()} == {"own.yaml"}


def test_names_that_lead_elsewhere_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "mine.yaml"
    start = f"runs: [{{recipe: {PENDULUM}, matrix: {{seed: [0]}}}}]\n"
    long = "x" * 300
    entries: list[Any] = [
        *("name: ../up", "name: /tmp/x", "name: ..", "name: [a]", f"name: {long}", "name: ''"),
        *("evaluations: [{name: ../up}]", f"evaluations: [{{name: {long}}}]"),
        "evaluations: [{name: e, noise: [../l1/off]}]",
        "evaluations: [{name: e, l1: [../l1/off]}]",
        "evaluations: [{name: e, stage: [../x]}]",
        "evaluations: [{name: e, suite: ../x}]",
    ]
    for entry in entries:
        file.write_text(start + entry + "\n")
        line_of(["campaign", str(file), "--list"], capsys)
    for matrix in ("../up: [1]", "l1: [../off]", f"l1: [{long}]", "a/../../b: [1]"):
        file.write_text(f"runs: [{{recipe: {PENDULUM}, matrix: {{{matrix}}}}}]\n")
        line_of(["campaign", str(file), "--list"], capsys)
    (tmp_path / "...yaml").write_text(OWN)
    file.write_text("runs: [{recipe: ...yaml}]\n")
    line_of(["campaign", str(file), "--list"], capsys)
    assert "not .yml" in line_of(["run", "own.yml"], capsys)
    assert {path.name for path in tmp_path.iterdir()} == {"mine.yaml", "...yaml"}


def test_the_package_may_lie_where_there_is_an_apostrophe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", "metrpo/inverted_pendulum", "l1=paper", "--cfg", "job"]
    main(command)
    expected = capsys.readouterr().out
    home = tmp_path / "o'brien"
    shutil.copytree(recipes_dir(), home / "recipes")
    monkeypatch.setattr(torchrl_l1, "__file__", str(home / "torchrl_l1" / "__init__.py"))
    assert recipes_dir() == home / "recipes"
    main(command)
    assert capsys.readouterr().out == expected


def test_launch_needs_a_recipe_that_there_is() -> None:
    with pytest.raises(RecipeError, match="Did you mean"):
        launch("metrpo/half_cheeta", [])


def test_a_sweeper_is_told_the_final_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_overrides: list[str]
) -> None:
    told: list[float] = []
    # Hydra loads its plug-ins in its own way: the class is not the one that could be imported.
    sweeper = Plugins.instance().class_name_to_class[
        "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
    ]
    sweep = sweeper.sweep

    def recorded(self: Any, arguments: list[str]) -> None:
        told.extend(job.return_value for batch in sweep(self, arguments) for job in batch)

    monkeypatch.setattr(sweeper, "sweep", recorded)
    own = [*tiny_overrides, "outer_iterations=4", "discount=0.9,0.99"]
    main(["run", PENDULUM, "-m", *own, "run_dir=runs/${discount}"])
    for value, discount in zip(told, ("0.9", "0.99"), strict=True):
        with (tmp_path / "runs" / discount / "metrics.csv").open() as file:
            returns = [float(row["return_mean"]) for row in csv.DictReader(file)]
        assert len(returns) == 4 and value == pytest.approx(sum(returns[-3:]) / 3)


@pytest.mark.filterwarnings("ignore")  # it asks for an old Optuna
def test_hydras_optuna_sweeper_looks_for_the_best_return(
    tmp_path: Path, tiny_overrides: list[str]
) -> None:
    optuna = pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    assert optuna
    own = [*tiny_overrides, "outer_iterations=1", "discount=interval(0.9,0.99)"]
    sweeper = ["hydra/sweeper=optuna", "hydra.sweeper.direction=maximize"]
    sweeper += ["hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=1", "hydra.sweep.dir=swept"]
    main(["run", PENDULUM, "-m", *own, *sweeper])
    best = yaml.safe_load((tmp_path / "swept" / "optimization_results.yaml").read_text())
    returns = []
    for metrics in (tmp_path / "runs").rglob("metrics.csv"):
        with metrics.open() as file:
            returns += [float(row["return_mean"]) for row in csv.DictReader(file)]
    assert len(returns) == 2
    assert best["best_value"] == pytest.approx(max(returns))


def test_a_sweep_by_a_pattern_runs_every_option_of_a_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of those that algorithms share, too, which are not beside the recipe."""
    monkeypatch.chdir(tmp_path)
    ran = []
    monkeypatch.setattr(
        "torchrl_l1.experiment.launch.run",
        lambda config: ran.append((config.l1.enabled, config.perturbation.action_noise)),
    )
    monkeypatch.setattr("torchrl_l1.experiment.launch.final_return", lambda run_dir: 0.0)
    patterns = ["l1=glob([o*,paper])", "noise=glob(*,exclude=[both,o*])"]
    main(["run", "metrpo/inverted_pendulum", "-m", *patterns])
    assert ran == [(False, 0.1), (False, 0.0), (True, 0.1), (True, 0.0)]
