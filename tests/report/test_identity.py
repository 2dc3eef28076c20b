from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from torchrl_l1.experiment.settings import SCHEMAS
from torchrl_l1.report.identity import ALGORITHMS, facts
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.study import studies

WriteRun = Callable[..., Path]


def test_identity_comes_from_the_configuration(write_run: WriteRun, tmp_path: Path) -> None:
    expected = {
        write_run([1], "l1=off"): ("none", "off"),
        write_run([1], "l1=paper", "noise=action"): ("action", "paper"),
        write_run([1], "l1=reference", "noise=both"): ("both", "reference"),
        write_run([1], "l1=slow", "noise=observation"): ("observation", "paper"),
        write_run([1], "l1=paper", "l1.alpha=0.1"): ("none", "paper"),
        write_run([1], "l1=reference", "l1.cutoff=1"): ("none", "reference"),
        write_run([1], "l1=paper", "l1.epsilon=7"): ("none", "paper"),
        write_run([1], "l1=paper", "l1.on_switch=reset"): ("none", "paper"),
        write_run([1], "perturbation.action_noise=0.3"): ("action 0.3", "paper"),
        write_run([1], "perturbation.observation_noise=0.05"): ("observation 0.05", "paper"),
        write_run([1], "noise=action", "perturbation.observation_noise=1"): (
            "action 0.1, observation 1",
            "paper",
        ),
    }
    runs = {run.path: run.identity for run in find_runs([tmp_path])}
    assert {path: (what.noise, what.arm) for path, what in runs.items()} == expected
    assert {what.task for what in runs.values()} == {"inverted_pendulum"}


def test_equal_filters_are_equal_however_they_are_given(
    write_run: WriteRun, tmp_path: Path
) -> None:
    # The pendulum's step takes 0.04 s.
    default = ("", "l1.alpha=0.35", "l1.cutoff=8.75")
    slow = ("l1.alpha=0.1", "l1.cutoff=2.5", "l1=slow")
    gains = {}
    for text, given in (("0.35", default), ("0.1", slow)):
        for overrides in given:
            gains[write_run([1], "l1=paper", *filter(None, [overrides]))] = text
    runs = find_runs([tmp_path])
    assert {run.path: run.identity.l1["l1.alpha"] for run in runs} == gains
    assert all("l1.cutoff" not in run.identity.l1 for run in runs)
    assert len({tuple(sorted(run.identity.l1.items())) for run in runs}) == 2
    shipped = {gains[run.path]: run.identity.shipped for run in runs}
    assert shipped == {"0.35": "paper", "0.1": "slow"}
    departures = {gains[run.path]: dict(run.identity.departures) for run in runs}
    assert departures == {"0.35": {}, "0.1": {"l1.alpha": "0.1"}}


def test_settings_that_do_not_touch_the_result_are_left_out(
    write_run: WriteRun, tmp_path: Path
) -> None:
    write_run([1], "l1=off", "threads=4", "device=cuda", "wandb.mode=offline", "l1.epsilon=9")
    write_run([1], "l1=off", "threads=1", "device=cpu", "resume=true", seed=8)
    first, second = (run.identity for run in find_runs([tmp_path]))
    assert first.shared == second.shared
    assert first.l1 == second.l1 == {}
    assert (first.seed, second.seed) == (0, 8)


def test_a_configuration_older_than_a_setting_has_its_default(
    write_run: WriteRun, tmp_path: Path
) -> None:
    old, new = write_run([1], "model=nonlinear"), write_run([1], "model=affine")
    text = (old / "config.yaml").read_text()
    assert text.count("  form: nonlinear\n") == 1
    (old / "config.yaml").write_text(text.replace("  form: nonlinear\n", ""))
    forms = {run.path: run.identity.model_form for run in find_runs([tmp_path])}
    assert forms == {old: "nonlinear", new: "affine"}


def test_a_run_older_than_the_setting_is_of_metrpo(write_run: WriteRun, tmp_path: Path) -> None:
    file = write_run([1], "l1=off") / "config.yaml"
    text = file.read_text()
    assert text.count("algorithm: metrpo\n") == 1
    file.write_text(text.replace("algorithm: metrpo\n", ""))
    write_run([1], "l1=off", seed=1)
    (study,) = studies(find_runs([tmp_path]))
    assert study.algorithm == "metrpo" and len(study.cells) == 1


def test_every_algorithm_is_known_with_its_ways_to_act() -> None:
    assert set(SCHEMAS) <= set(ALGORITHMS)
    expected = {"metrpo": True, "mbmf": True, "pets": False, "dets": False, "offline": True}
    assert {name: facts(name).samples for name in ALGORITHMS} == expected
    stages = {name: [stage.name for stage in facts(name).named_stages] for name in SCHEMAS}
    # In the order of the stages as users type them.
    assert stages == {
        "metrpo": [], "pets": [], "mbmf": ["shooting", "cloning", "fine_tuning"], "offline": [],
    }  # fmt: skip
    with pytest.raises(ValueError, match="'nothing'; there are metrpo, mbmf, offline, pets, dets"):
        facts("nothing")


def test_runs_with_code_of_other_folders_are_no_seeds_of_each_other(
    write_run: WriteRun, tmp_path: Path
) -> None:
    for seed, place in enumerate(("one", "one", "other")):
        write_run([1], f"search_path=[{place}]", seed=seed)
    (study,) = studies(find_runs([tmp_path]))
    assert sorted(len(runs) for runs in study.cells.values()) == [1, 2]


@pytest.mark.parametrize(
    "departure",
    [
        "perturbation.actuator_bias=0.9",
        "perturbation.actuator_delay=2",
        "horizon=50",
        "reward=own.py:reward",
        "termination=none",
    ],
)
def test_only_runs_of_the_papers_task_stand_beside_its_numbers(
    departure: str, write_run: WriteRun, tmp_path: Path
) -> None:
    noise = ("noise=action", "perturbation.observation_noise=0.3")
    usual = [write_run([1], "l1=off"), write_run([1], "l1=paper", *noise)]
    other = write_run([1], "l1=off", departure)
    found = {run.path: run.identity for run in find_runs([tmp_path])}
    assert [found[path].as_published for path in (*usual, other)] == [True, True, False]
    key, _, value = departure.partition("=")
    departures = found[other].recipe_departures
    assert departures.pop(key) in (value, f"{value}.0")
    assert found[usual[1]].recipe_departures == departures
