"""Campaign files: what they mean, and what is refused before anything starts."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchrl_l1.campaign.description import (
    CampaignError,
    RunMatrix,
    dump_yaml,
    load_yaml,
    read_campaign,
)
from torchrl_l1.campaign.jobs import LAUNCHERS, check_launcher, sweep
from torchrl_l1.campaign.plan import PlannedRun, check_machine, plan
from torchrl_l1.cli import main
from torchrl_l1.experiment.errors import RecipeError
from torchrl_l1.experiment.recipes import available_campaigns, available_recipes
from torchrl_l1.experiment.settings import L1Settings, l1_config

RUNS = "runs: [{recipe: metrpo/inverted_pendulum, matrix: {l1: [off, paper], seed: [0, 1]}}]\n"


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def write(text: str) -> str:
        file = tmp_path / "mine.yaml"
        file.write_text(text)
        return str(file)

    return write


def test_directories_are_in_matrix_order_with_the_seed_last(write: Any, tmp_path: Path) -> None:
    file = write(
        "runs:\n- recipe: metrpo/inverted_pendulum\n  overrides: [discount=0.9]\n"
        "  matrix: {seed: [3, 4], noise: [none], l1: [off, paper], l1.alpha: [1e-2]}\n"
    )
    runs = plan(read_campaign(file, ["outer_iterations=5"]), tmp_path / "out")
    folder = tmp_path / "out/metrpo/inverted_pendulum/noise=none"
    # Every cell has its first seed before any has its second.
    assert [run.directory.path for run in runs] == [
        folder / f"l1={on}" / "l1.alpha=0.01" / f"seed_{seed}"
        for seed in (3, 4)
        for on in ("off", "paper")
    ]
    last = runs[-1].config
    assert (last.seed, last.l1.enabled, last.l1.alpha) == (4, True, 0.01)
    assert (last.discount, last.outer_iterations, runs[-1].iterations) == (0.9, 5, 5)
    assert last.run_dir == str(runs[-1].directory.path)
    assert not (tmp_path / "out").exists()


def test_evaluations_go_to_the_runs_that_match(write: Any, tmp_path: Path) -> None:
    file = write(
        "runs:\n"
        "- {recipe: metrpo/inverted_pendulum, matrix: {l1: [off, paper]}}\n"
        "- {recipe: metrpo/half_cheetah, matrix: {noise: [none, both]}}\n"
        "evaluations:\n"
        "- {name: all}\n"
        "- {name: some, where: {l1: [off]}, bias: [0, 1]}\n"
        "- {name: some, where: {recipe: [metrpo/half_cheetah], noise: [both]}}\n"
    )
    found = {
        str(run): [settings.name for settings in run.evaluations]
        for run in plan(read_campaign(file), tmp_path)
    }
    assert found == {
        "metrpo/inverted_pendulum l1=off seed=0": ["all", "some"],
        "metrpo/inverted_pendulum l1=paper seed=0": ["all"],
        "metrpo/half_cheetah noise=none seed=0": ["all"],
        "metrpo/half_cheetah noise=both seed=0": ["all", "some"],
    }


@pytest.mark.parametrize(
    ("text", "values"), [("null", []), ("[]", []), ("3", [3.0]), ("[1e-1, 1]", [0.1, 1.0])]
)
def test_tuning_of_an_evaluation_is_a_list(text: str, values: list[float], write: Any) -> None:
    file = write(RUNS + f"evaluations: [{{name: e, epsilon: {text}}}]\n")
    (settings,) = read_campaign(file).evaluations
    assert (settings.matrix["epsilon"], settings.matrix["alpha"]) == (values, [])


def test_a_users_recipe_is_found_beside_the_campaign(write: Any, tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(
        "defaults: [metrpo_recipe, {l1: slow}, {noise: action}, {preset: cpu}, _self_]\n"
        "recipe: own\ntask: half_cheetah\n"
    )
    file = write("runs: [{recipe: own.yaml}]\nevaluations: [{name: e, where: {recipe: [own]}}]\n")
    campaign = read_campaign(file)
    (run,) = plan(campaign, tmp_path)
    assert run.directory.path == tmp_path / "own" / "seed_0"
    assert run.evaluations
    # What is stored in the output is itself a campaign, wherever it is read.
    elsewhere = tmp_path / "out" / "campaign.yaml"
    elsewhere.parent.mkdir()
    elsewhere.write_text(dump_yaml(campaign.to_dict()))
    again = read_campaign(str(elsewhere))
    assert (again.name, again.runs, again.evaluations) == (
        "mine",
        campaign.runs,
        campaign.evaluations,
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("runs: [", "not valid YAML"),
        ("just words", "expected keys and values"),
        ("description: nothing", "runs is missing"),
        ("runs: []", "runs must be a list with at least one entry"),
        (RUNS + "evaluation: []", "unknown key 'evaluation'. Did you mean evaluations"),
        (RUNS + RUNS, "appears twice"),
        ("runs: [{overrides: []}]", r"runs\[0\]: recipe is missing"),
        ("runs: [{recipe: 3}]", r"runs\[0\]: recipe must be the name of a recipe .* got 3"),
        ("runs: [{recipe: }]", "recipe must be the name of a recipe .* got None"),
        ("runs: [{recipe: [a]}]", r"recipe must be the name of a recipe .* got \['a'\]"),
        ("runs: [{recipe: offline/half_cheetah, overrides: [reward=learned]}]",
         "offline learning needs known rewards"),
        ("runs: [{recipe: metrpo/pendulum}]", "unknown recipe 'metrpo/pendulum'"),
        ("runs: [{recipe: mine2.yaml}]", "mine2.yaml does not exist"),
        (RUNS.replace("matrix", "matrices"), "Did you mean matrix"),
        (RUNS.replace("[0, 1]", "0"), "matrix.seed must be a list of values"),
        (RUNS.replace("[0, 1]", "[]"), "matrix.seed must be a list of values"),
        (RUNS.replace("[0, 1]", "[0, 0]"), "repeats a value: 0, 0"),
        (RUNS.replace("[0, 1]", "[many]"), "seed"),
        (RUNS.replace("[0, 1]", "['00', 0]"), "matrix.seed must hold whole numbers"),
        (RUNS.replace("[0, 1]", "[true]"), "matrix.seed must hold whole numbers"),
        (RUNS.replace("[0, 1]", "[010]"), "line 1, .*: 010 means 8 in YAML; write 8, or '010'"),
        (RUNS.replace("[0, 1]", "[1:30]"), "1:30 means 90 in YAML"),
        (RUNS + "evaluations: [{name: e, bias: [-01]}]", "-01 means -1 in YAML"),
        (RUNS.replace("matrix", "overrides: ['noise=[action, both]'], matrix"),
         r"a run has one noise; use -m noise=action,both .* campaign's matrix"),
        (RUNS.replace("paper", "../up"), "cannot name a folder"),
        (RUNS.replace("paper", "[8]"), "matrix.l1 holds"),
        (RUNS.replace("paper", "papr"), "papr"),
        (RUNS.replace("l1:", "l2:"), "l2"),
        (RUNS.replace("l1:", "run_dir:"), "run_dir is set by the campaign"),
        (RUNS.replace("l1:", "label:"), "label must be"),
        (RUNS.replace("matrix", "overrides: [seed=1], matrix"), "by overrides and by the matrix"),
        (RUNS.replace("matrix", "overrides: [epsillon=1], matrix"), "epsillon"),
        (RUNS.replace("matrix", "overrides: [resume=true], matrix"), "resume is set"),
        (RUNS.replace("matrix", "overrides: [l1.epsilon=-1], matrix"), "epsilon"),
        (RUNS.replace("[off, paper]", "[off]").replace("matrix", "overrides: [l1.alpha=7], matrix"),
         r"alpha must lie in \[0, 1\]"),
        (RUNS.replace("seed:", "l1.alpha: [0.1, 0.3], seed:"),
         r"runs\[0\]: matrix.l1.alpha has no effect while L1 is off: .* to another matrix"),
        (RUNS.replace("matrix", "overrides: ['discount=0.9,0.8'], matrix"), "weep"),
        (RUNS.replace("matrix", "overrides: [fast], matrix"), "KEY=VALUE"),
        (RUNS.replace("matrix", "overrides: [clip_actions=false], matrix"), "without L1"),
        (RUNS.replace("matrix", "overrides: [model.activation=reluu], matrix"), "activation"),
        (RUNS.replace("matrix", "overrides: [policy.std=0], matrix"), "policy.std"),
        (RUNS.replace("matrix", "overrides: [threads=0], matrix"), "threads"),
        (RUNS.replace("matrix", "overrides: [fit.elites=9], matrix"), "elites"),
        (RUNS.replace("matrix", "overrides: ['fit.weight_decay=[0.1]'], matrix"), "weight_decay"),
        (RUNS.replace("matrix", "overrides: ['reward=nomod:foo'], matrix"), "nomod"),
        (RUNS.replace("matrix", "overrides: [perturbation.action_noise=-1], matrix"), "noise"),
        (RUNS.replace("matrix", "overrides: [device=gpu], matrix"), "device must be 'cpu'"),
        (RUNS + RUNS.replace("runs: [", "- ").replace("]\n", "\n"), "not valid YAML"),
        (RUNS.replace("runs: [", "runs:\n- ").replace("}}]\n", "}}\n") * 1
         + "- {recipe: metrpo/inverted_pendulum, matrix: {l1: [off]}}", "would share"),
        (RUNS + "evaluations: [{l1: [off]}]", r"evaluations\[0\]: name is missing"),
        (RUNS + "evaluations: [{name: a/b}]", "name must be a word"),
        (RUNS + "evaluations: [{name: e, wher: {}}]", "Did you mean where"),
        (RUNS + "evaluations: [{name: e, l1: [pape]}]", r"\(e\): unknown l1 setting 'pape'"),
        (RUNS + "evaluations: [{name: e, l1: [robust], alpha: 0.1}]", r"\(e\): alpha is given"),
        (RUNS + "evaluations: [{name: e, mass: [1, -1]}]", "mass must be positive, got -1"),
        (RUNS + "evaluations: [{name: e, delay: [0.5]}]", "delay: .* must be whole"),
        (RUNS + "evaluations: [{name: e, noise: [loud]}]", "unknown noise setting 'loud'"),
        (RUNS + "evaluations: [{name: e, policy: [greedy]}]", "unknown policy 'greedy'"),
        (RUNS + "evaluations: [{name: e, episodes: 0}]", "episodes must be a whole number from 1"),
        (RUNS + "evaluations: [{name: e, bias: [high]}]", "bias holds 'high'"),
        (RUNS + "evaluations: [{name: e, bias: [true]}]", "bias holds True"),
        (RUNS + "evaluations: [{name: e, gain: [.inf]}]", "gain must be finite"),
        (RUNS + "evaluations: [{name: e, epsilon: .inf}]", "epsilon must be finite and not"),
        (RUNS + "evaluations: [{name: e, epsilon: [1, -1]}]", "epsilon must be finite and not"),
        (RUNS + "evaluations: [{name: e, suite: loud}]", "unknown suite 'loud'; there are quick"),
        (RUNS + "evaluations: [{name: e, suite: [full]}]", "unknown suite"),
        (RUNS + "evaluations: [{name: e, suite: full, bias: [1]}]", "suite and bias both set"),
        (RUNS + "evaluations: [{name: e, l1: [of]}]", "there are off, paper, .*oracle"),
        (RUNS + "evaluations: [{name: e, epsilon: true}]", "epsilon must be null, a number or a"),
        (RUNS + "evaluations: [{name: e, alpha: [slow]}]", "alpha must be null, a number or a"),
        (RUNS + "evaluations: [{name: e, alpha: 1.5}]", "alpha must be above 0 and at most 1"),
        (RUNS + "evaluations: [{name: e, stage: policy}]", "stage must be a list"),
        (RUNS + "evaluations: [{name: e, stage: [fine_tuning]}]",
         r"\(e\): .* no stage 'fine_tuning'; the stages of its algorithm are policy"),
        (RUNS + "evaluations: [{name: e, where: {l1: [slow]}}]", "no run has l1=slow; there are"),
        (RUNS + "evaluations: [{name: e, where: {l2: [off]}}]", "none with a l2"),
        (RUNS + "evaluations: [{name: e}, {name: e, where: {l1: [off]}}]", "another evaluation"),
    ],
)  # fmt: skip
def test_refused(text: str, message: str, write: Any, tmp_path: Path) -> None:
    with pytest.raises((CampaignError, RecipeError), match=message) as error:
        plan(read_campaign(write(text)), tmp_path / "out")
    assert "mine" in str(error.value)
    assert not (tmp_path / "out").exists()


def test_refused_on_the_command_line(
    write: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, output = write(RUNS), str(tmp_path / "out")
    for more, message in [
        (["--workers", "0"], "--workers must be at least 1"),
        (["seed=3"], "seed is set both by overrides and by the matrix"),
        (["hydra.launcher.n_jobs=2"], "give --launcher"),
        (["noise"], "KEY=VALUE"),
        (["--fast"], "unrecognized arguments: --fast"),
        (["--output", str(tmp_path / "${seed}")], "${ in a path would be read as an interpolation"),
        (["--launcher", "cloud"], "unknown launcher 'cloud'; there are joblib, "),
    ]:
        with pytest.raises(SystemExit) as exit_info:
            main(["campaign", file, "--output", output, *more])
        assert exit_info.value.code not in (0, None)
        assert message in capsys.readouterr().err
    with pytest.raises(RecipeError, match="Did you mean table1"):
        read_campaign("table_1")
    assert not (tmp_path / "out").exists()


def test_device_is_that_of_the_machine_that_trains(
    write: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    campaign = read_campaign(write(RUNS), ["device=cuda"])
    with pytest.raises(CampaignError, match=r"runs\[0\]: device=cuda .* no CUDA device"):
        check_machine(campaign, plan(campaign, tmp_path))


def test_a_dataset_must_be_there_for_what_is_to_be_trained(write: Any, tmp_path: Path) -> None:
    text = "runs: [{recipe: offline/inverted_pendulum, overrides: [dataset=DATA]}]"
    campaign = read_campaign(write(text.replace("DATA", "nothere.npz")))
    (run,) = plan(campaign, tmp_path)
    with pytest.raises(CampaignError, match=r"runs\[0\]: nothere\.npz: no such dataset"):
        check_machine(campaign, [run])
    run.directory.path.mkdir(parents=True)
    run.directory.checkpoint_file.write_text("holds the data")
    check_machine(campaign, [run])
    minari = read_campaign(write(text.replace("DATA", "hopper/medium-v0")))
    check_machine(minari, plan(minari, tmp_path / "minari"))


def test_planning_draws_no_random_numbers(write: Any, tmp_path: Path) -> None:
    before = torch.get_rng_state()
    plan(read_campaign(write(RUNS)), tmp_path)
    assert torch.equal(torch.get_rng_state(), before)


def test_no_run_of_the_switching_campaign_is_trained_twice(tmp_path: Path) -> None:
    seen: dict[str, PlannedRun] = {}
    for run in plan(read_campaign("switching"), tmp_path):
        settings = run.settings()
        controller = l1_config(L1Settings(**settings.pop("l1")), run.config.task)
        if controller is not None:
            gain = controller.filter_gain
            controller = replace(controller, alpha=gain, cutoff=None)
        key = f"{controller} {[v for k, v in settings.items() if k != 'run_dir']}"
        assert seen.setdefault(key, run) is run, f"{run} is {seen[key]}"
    assert sum("l1=off" in str(run) for run in seen.values()) == 5


def test_campaigns_of_mbmf_make_the_whole_table(tmp_path: Path) -> None:
    runs = [run for name in ("mbmf", "mbmf_rest") for run in plan(read_campaign(name), tmp_path)]
    cells = [(run.config.task, run.values["noise"], run.values["l1"]) for run in runs]
    tasks = ("inverted_pendulum", "swimmer", "half_cheetah", "hopper", "walker")
    noises = ("none", "action", "observation")
    assert set(cells) == set(product(tasks, noises, ("off", "paper")))
    assert len({run.directory.path for run in runs}) == len(runs)
    for run in runs:
        frozen = run.values["noise"] == "none" and run.values["l1"] == "off"
        pendulum = run.config.task == "inverted_pendulum"
        stages = ["shooting", "cloning", "fine_tuning"] if pendulum else ["shooting"]
        assert [e.matrix["stage"] for e in run.evaluations] == [stages] * frozen
        assert all(len(e.matrix["bias"]) == (4 if pendulum else 1) for e in run.evaluations)
        # 200 000 real steps, as in the paper.
        assert 190_000 < run.collected_steps(run.iterations) < 210_000


def test_launcher_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr("torchrl_l1.campaign.jobs.find_spec", nothing)
    with pytest.raises(CampaignError, match=r"pip install 'torchrl-l1\[submitit\]'"):
        check_launcher("submitit_slurm")
    check_launcher("basic")


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_sweep_passes_workers_and_settings_on(launcher: str) -> None:
    matrix = RunMatrix("metrpo/walker", ["noise=none"], {"l1": ["off"], "seed": [0, 1]})
    more = ["hydra.launcher.partition=cpu"]
    arguments = sweep(matrix, Path("/out"), launcher, 3, more)
    assert arguments[:3] == ["run", "metrpo/walker", "-m"]
    assert arguments[-1:] == more
    assert {"l1=off", "seed=0,1", "noise=none", "resume=true"} < set(arguments)
    parallel = [a for a in arguments if a.startswith("hydra.launcher.") and a not in more]
    expected = {"joblib": ["n_jobs=3"], "submitit_slurm": ["array_parallelism=3"]}
    assert parallel == [f"hydra.launcher.{text}" for text in expected.get(launcher, [])]


def test_shipped_campaigns_are_the_papers(capsys: pytest.CaptureFixture[str]) -> None:
    sizes = {}
    for name in available_campaigns():
        campaign = read_campaign(name)
        sizes[name] = 0
        for matrix in campaign.runs:
            cells = 1
            for values in matrix.matrix.values():
                cells *= len(values)
            sizes[name] += cells
            if not matrix.recipe.startswith("metrpo/"):
                continue
            # 50 000 and 204 000 real steps; clipping asks no question of the paper's.
            iterations = 9 if name == "clipping" else 19 if "pendulum" in matrix.recipe else 33
            if name == "pendulum_long":
                iterations = 80  # and the random data: the 202 500 of the authors' logs
            assert f"outer_iterations={iterations}" in matrix.overrides
    assert sizes["table1"] == 3 * 3 * 10 + 4 * (3 * 5 + 2 * 3 * 3)
    assert sizes["table1_first"] == 3 * 2 * 5 + 2 * 4 + 2 * 2
    assert sizes["figure2"] == 3 * 3 + 3 * 4
    assert sizes["pendulum_long"] == 3 * 3 * 3 + 4
    assert sizes["pets"] == 2 * 2 * 2 * 5
    assert sizes["pets_long"] == 2 * 2 * 3
    assert sizes["mbmf"] == 3 * 2 * 5 + 2 * 2 * 2
    assert sizes["mbmf_rest"] == 2 * 2 * 2 * 2 + 2 * 3 * 2 * 2
    main(["recipes"])
    shown = capsys.readouterr().out.split("Campaigns:")
    assert shown[0].split() == available_recipes()
    assert shown[1].split() == available_campaigns()


PLAIN = st.one_of(
    st.booleans(),
    st.integers(),
    st.floats(allow_nan=False),
    st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"])),
    st.sampled_from(["off", "on", "yes", "no", "none", "null", "true", "1e-3", "1.", "0x1f"]),
)


@given(values=st.lists(PLAIN))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_is_read_again(values: list[Any], tmp_path: Path) -> None:
    text = dump_yaml({"values": values})
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8")
    for read in (load_yaml(tmp_path / "a.yaml"), yaml.safe_load(text)):
        assert read == {"values": values}
        assert list(map(type, read["values"])) == list(map(type, values))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("off", "off"), ("On", "On"), ("yes", "yes"), ("none", "none"), ("true", True),
        ("False", False), ("1e-3", 1e-3), ("1E5", 1e5), ("-.5", -0.5), ("3", 3), ("1.", 1.0),
        ("0.10", 0.1), ("e5", "e5"), ("'off'", "off"), ("null", None), ("1-2", "1-2"),
        ("'010'", "010"), ("0x10", 16), ("1_000", 1000), ("-0", 0),
    ],
)  # fmt: skip
def test_words_and_numbers(text: str, value: object, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(f"[{text}]")
    assert load_yaml(tmp_path / "a.yaml") == [value]
    assert isinstance(load_yaml(tmp_path / "a.yaml")[0], type(value))
