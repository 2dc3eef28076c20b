from __future__ import annotations

import csv
import json
import os
import random
import re
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

import torchrl_l1
from tests.conftest import TINY
from torchrl_l1.algorithms import METRPO, PETS
from torchrl_l1.algorithms.outcomes import OUTCOME_METRICS
from torchrl_l1.campaign.description import dump_yaml, read_campaign
from torchrl_l1.campaign.plan import plan
from torchrl_l1.cli import main
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.evaluate import evaluate, load_run
from torchrl_l1.experiment.files import saved, write_atomically
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.matrix import conditions
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory

METRICS = METRPO.facts.metrics.keys() - OUTCOME_METRICS.keys()

Recipe = Callable[..., DictConfig]

METRPO_RUN = ["outer_iterations=5", "fit.max_epochs=150", "fit.patience=150"]
# Two rounds of shooting, two of cloning, two of fine-tuning.
MBMF_RUN = [
    *("outer_iterations=6", "shooting_iterations=2", "cloning.iterations=2", "horizon=10"),
    *(
        "shooting_episodes=2",
        "fine_tuning.episodes=2",
        "fine_tuning.minibatches=2",
        "evaluation_episodes=2",
    ),
    *("shooting.candidates=16", "shooting.horizon=4", "model.hidden=[8]", "fit.max_epochs=20"),
    *("cloning.max_epochs=20", "fine_tuning.epochs=20", "wandb.mode=disabled"),
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a tiny run that nothing has broken off."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return run(compose("metrpo/inverted_pendulum", [*TINY, f"run_dir={folder}"]))


def snapshot(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def test_run_directory_has_what_is_promised(tiny_recipe: Recipe) -> None:
    directory = run(tiny_recipe("seed=5"))
    with (directory / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    assert set(rows[0]) == set(METRICS)
    config = OmegaConf.load(directory / "config.yaml")
    assert (config.seed, config.task, config.l1.enabled) == (5, "inverted_pendulum", True)
    versions = json.loads((directory / "versions.json").read_text())
    assert versions["torch"] == torch.__version__
    assert versions["torchrl-l1"] == torchrl_l1.__version__
    for name in ("model.pt", "policy.pt", "checkpoint.pt"):
        assert torch.load(directory / name, weights_only=True)
    page = (Path(__file__).parents[2] / "docs/recipes.md").read_text()
    (promised,) = re.findall(r"```text\nRUN_DIR/\n(.*?)```", page, re.DOTALL)
    names = set(re.findall(r"\b\w+\.(?:yaml|json|csv|pt)\b", promised))
    assert {file.name for file in directory.iterdir()} == names | {".lock"}


def test_finished_run_is_left_alone_and_found_complete(
    tiny_recipe: Recipe, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(tiny_recipe())
    before = snapshot(directory)
    with pytest.raises(RunDirectoryError, match="already holds a run"):
        run(tiny_recipe())
    with pytest.raises(RunDirectoryError, match=r"seed: 0 there, 1 now"):
        run(tiny_recipe("seed=1", "resume=true"))
    assert snapshot(directory) == before
    run(tiny_recipe("resume=true"))
    assert "complete" in capsys.readouterr().out
    assert snapshot(directory) == before


def test_foreign_directory_is_not_touched(tiny_recipe: Recipe, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("years of work")
    before = snapshot(tmp_path)
    for resume in ("true", "false"):
        with pytest.raises(RunDirectoryError, match="not empty"):
            run(tiny_recipe(f"resume={resume}"))
    assert snapshot(tmp_path) == before


def test_run_killed_before_its_first_checkpoint_starts_over(
    whole: Path, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    directory = tmp_path / "run"
    directory.mkdir()
    for name in ("versions.json", ".lock"):
        shutil.copy(whole / name, directory)
    assert run(tiny_recipe()) == directory
    assert (directory / "metrics.csv").read_text() == (whole / "metrics.csv").read_text()


@pytest.mark.parametrize("last", ["checkpoint.pt", "model.pt", "policy.pt", "timing.csv"])
def test_kill_among_the_files_of_the_last_iteration_leaves_no_stale_ones(
    last: str, whole: Path, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill right after each of them: the run is not finished, and all is right once it is."""
    run(tiny_recipe("outer_iterations=1"))
    replace = os.replace

    def replace_and_die(source: Path, target: Path) -> None:
        replace(source, target)
        if target.name == last:
            raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", replace_and_die)
    with pytest.raises(KeyboardInterrupt):
        run(tiny_recipe("resume=true"))
    monkeypatch.undo()
    assert RunDirectory(tmp_path / "run").iterations_done() == 1
    run(tiny_recipe("resume=true"))
    killed = tmp_path / "run"
    assert (killed / "metrics.csv").read_text() == (whole / "metrics.csv").read_text()
    assert len((killed / "timing.csv").read_text().splitlines()) == 3
    for name in ("model.pt", "policy.pt"):
        found, expected = (torch.load(folder / name) for folder in (killed, whole))
        torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_settings_that_are_newer_than_a_run_have_their_defaults(
    tiny_recipe: Recipe, tmp_path: Path
) -> None:
    directory = run(tiny_recipe("outer_iterations=1"))
    config = OmegaConf.load(directory / "config.yaml")
    del config.threads, config.model.box_margin
    OmegaConf.save(config, directory / "config.yaml")
    run(tiny_recipe("resume=true"))
    assert RunDirectory(directory).iterations_done() == 2
    del config.model.members  # 2 here, 5 by default
    OmegaConf.save(config, directory / "config.yaml")
    with pytest.raises(RunDirectoryError, match=r"model.members: 5 there, 2 now"):
        run(tiny_recipe("resume=true"))


def test_second_process_in_the_same_directory_is_refused(tmp_path: Path) -> None:
    first, second = RunDirectory(tmp_path / "run"), RunDirectory(tmp_path / "run")
    with (
        first.open({"seed": 0}, resume=False),
        pytest.raises(RunDirectoryError, match="another process"),
        second.open({"seed": 0}, resume=True),
    ):
        pass
    with second.open({"seed": 0}, resume=True):
        assert second.config_file.exists()


def test_bad_settings_are_refused_before_anything_is_written(
    tiny_recipe: Recipe, tmp_path: Path
) -> None:
    for override, message in [
        ("label=both", "label must be"),
        ("box_exit=bounce", "box_exit must be"),
        ("trpo_iterations=0", "trpo_iterations must be"),
        ("imagined_horizon=1000", "imagined_steps"),
        ("imagined_from_data=1.5", "imagined_from_data"),
        ("fit.batch_size=0", r"fit\.batch_size"),
        ("fit.validation_fraction=1.0", r"fit\.validation_fraction"),
        ("task=pendulum", "Unknown task"),
        ("wandb.mode=loud", "wandb.mode"),
        ("l1.on_switch=forget", "on_switch"),
        ("l1.epsilon=-1", "epsilon"),
        ("model.activation=gelu", "activation"),
        ("model.members=0", r"model\.members"),
        ("model.hidden=[8,0]", r"model\.hidden"),
        ("model.std_floor=0", r"model\.std_floor"),
        ("model.box_margin=-1", r"model\.box_margin"),
        ("policy.std=0", r"policy\.std"),
        ("policy.hidden=[0]", r"policy\.hidden"),
        ("perturbation.observation_noise=-0.1", r"perturbation\.observation_noise"),
        ("perturbation.actuator_bias=inf", r"perturbation\.actuator_bias"),
        ("threads=0", "threads"),
        ("horizon=0", "horizon"),
        ("clip_actions=false", "without L1"),
        ("device=tpu", "device must be"),
        ("l1.compile=maybe", r"l1\.compile"),
        ("trpo.fisher_fraction=0", r"trpo\.fisher_fraction"),
        ("trpo.max_kl=-1", r"trpo\.max_kl"),
        ("discount=2", "discount"),
    ]:
        with pytest.raises((ValueError, KeyError), match=message):
            run(tiny_recipe(override))
        assert not (tmp_path / "run").exists(), override


def wandb_records(raw: bytes) -> bytes:
    """The records of a ``.wandb`` file without the framing, which may cut a word in two.

    It is LevelDB's log format after a header of 7 bytes: blocks of 32 KiB, each part of a record
    after its checksum (4 bytes), length (2) and kind (1).
    """
    content, position = b"", 7
    while position + 7 <= len(raw):
        left_in_block = 32_768 - position % 32_768
        if left_in_block < 7:
            position += left_in_block
            continue
        length = int.from_bytes(raw[position + 4 : position + 6], "little")
        content += raw[position + 7 : position + 7 + length]
        position += 7 + length
    return content


def test_wandb_offline_keeps_everything(
    tiny_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    directory = run(tiny_recipe("wandb.mode=offline"))
    (record,) = directory.glob("wandb/offline-run-*/*.wandb")
    keys = (b"return_mean", b"l1/switch_rate", b"inverted_pendulum", b"max_gradient_steps")
    missing = keys
    # On a busy machine W&B's own process writes the last records after it has been closed.
    for _ in range(600):
        content = wandb_records(record.read_bytes())
        missing = tuple(key for key in keys if key not in content)
        if not missing:
            break
        time.sleep(0.1)
    assert not missing


def test_finished_run_may_grow(tiny_recipe: Recipe, tmp_path: Path) -> None:
    directory = run(tiny_recipe())
    run(tiny_recipe("outer_iterations=3", "resume=true"))
    grown = (directory / "metrics.csv").read_text()
    assert len(grown.splitlines()) == 4
    whole = run(tiny_recipe("outer_iterations=3", f"run_dir={tmp_path / 'whole'}"))
    assert (whole / "metrics.csv").read_text() == grown
    with pytest.raises(RunDirectoryError, match="outer_iterations: 3 there, 2 now"):
        run(tiny_recipe("resume=true"))


def test_interrupted_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "checkpoint.pt"
    write_atomically(file, saved({"iteration": 1}))

    def killed(descriptor: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(file, saved({"iteration": 2}))
    assert torch.load(file, weights_only=True) == {"iteration": 1}
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    ("recipe", "overrides", "rows_before_kill"),
    [
        # Before the first checkpoint, then at a random moment of a later iteration.
        ("metrpo/inverted_pendulum", METRPO_RUN, (0, 2)),
        # Once in each stage.
        ("mbmf/inverted_pendulum", MBMF_RUN, (1, 3, 5)),
    ],
    ids=["metrpo", "mbmf"],
)
def test_killed_run_resumes_to_the_same_metrics(
    tmp_path: Path,
    tiny_overrides: list[str],
    start_cli: Callable[..., Any],
    recipe: str,
    overrides: list[str],
    rows_before_kill: tuple[int, ...],
) -> None:
    tiny = tiny_overrides if recipe.startswith("metrpo") else []
    command = ["run", recipe, *tiny, *overrides, "--resume"]

    def start(folder: Path, anew: bool = False) -> Any:
        return start_cli([*command, f"run_dir={folder}"], anew=anew)

    unbroken, killed = tmp_path / "unbroken", tmp_path / "killed"
    # One of the interpreters is a new one, as users start it.
    assert start(unbroken, anew=recipe.startswith("metrpo")).wait(timeout=300) == 0
    iteration = mean_seconds(unbroken)
    rng = random.Random(0)
    for count in rows_before_kill:
        process = start(killed)
        while process.poll() is None and not reached(killed, count):
            time.sleep(0.002)
        time.sleep(rng.uniform(0, iteration))
        process.kill()
        assert process.wait() == -signal.SIGKILL
    assert rows(killed) < rows(unbroken)
    assert start(killed).wait(timeout=300) == 0
    assert (killed / "metrics.csv").read_text() == (unbroken / "metrics.csv").read_text()


def mean_seconds(folder: Path) -> float:
    with (folder / "timing.csv").open() as file:
        table = list(csv.DictReader(file))
    return sum(float(v) for row in table for k, v in row.items() if k != "iteration") / len(table)


def reached(folder: Path, count: int) -> bool:
    return (folder / "config.yaml").exists() and rows(folder) >= count


def rows(folder: Path) -> int:
    file = folder / "metrics.csv"
    return len(file.read_text().splitlines()) - 1 if file.exists() else 0


PETS_METRICS = PETS.facts.metrics.keys() - OUTCOME_METRICS.keys()

TINY_PETS = [
    "outer_iterations=2",
    "horizon=10",
    "random_episodes=2",
    "random_steps=8",
    "particles=2",
    "cem.horizon=3",
    "cem.candidates=8",
    "cem.elites=2",
    "cem.iterations=1",
    "model.members=2",
    "model.hidden=[8]",
    "fit.max_epochs=2",
    "fit.validation_fraction=0.3",
    "wandb.mode=disabled",
]
Make = Callable[..., DictConfig]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    def make(*overrides: str, recipe: str = "pets/inverted_pendulum") -> DictConfig:
        return compose(recipe, [*TINY_PETS, f"run_dir={tmp_path / 'run'}", *overrides])

    return make


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as handle:
        return list(csv.DictReader(handle))


@pytest.mark.parametrize("recipe", ["pets/inverted_pendulum", "dets/inverted_pendulum"])
def test_run_directory_of_a_planner_has_what_is_promised(
    recipe: str, make: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(make("precision=float32", recipe=recipe))
    rows = rows_of(directory / "metrics.csv")
    assert [int(row["real_steps"]) for row in rows] == [26, 36]
    assert set(rows[0]) == set(PETS_METRICS)
    assert set(rows_of(directory / "timing.csv")[0]) == {
        "iteration",
        "random",
        "fit",
        "collect",
        "evaluate",
    }
    assert torch.load(directory / "model.pt", weights_only=True)
    assert not (directory / "policy.pt").exists(), "a planner has no weights of its own"
    assert "device cpu, fit float32, precision float32" in capsys.readouterr().out


def test_interrupted_planner_goes_on_as_if_it_had_not_been(make: Make, tmp_path: Path) -> None:
    whole = run(make(f"run_dir={tmp_path / 'whole'}", "outer_iterations=3"))
    run(make("outer_iterations=1"))
    resumed = run(make("resume=true", "outer_iterations=3"))
    assert (resumed / "metrics.csv").read_text() == (whole / "metrics.csv").read_text()


def test_frozen_planner_is_evaluated_under_disturbances(
    make: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = run(make("l1=off"))
    capsys.readouterr()
    command = ["evaluate", str(directory), "--l1", "off", "paper", "--bias", "0", "1"]
    main([*command, "--episodes", "3"])
    # It acts in one way only, so sampled and mean actions would say the same twice.
    rows = rows_of(directory / "evaluation/evaluation.csv")
    assert [(row["policy"], row["l1"], float(row["bias"])) for row in rows] == [
        ("stochastic", "off", 0.0),
        ("stochastic", "paper", 0.0),
        ("stochastic", "off", 1.0),
        ("stochastic", "paper", 1.0),
    ]
    assert len({row["return_mean"] for row in rows}) == 4
    assert (directory / "evaluation/robustness.png").exists()


def test_bias_acts_after_the_planner(make: Make) -> None:
    trained = load_run(run(make("l1=off")))
    cells = conditions(l1=["off"], bias=[0.0, 2.9], policy=["stochastic"])
    first, second = evaluate(trained, cells, episodes=2)
    assert first["return_mean"] != second["return_mean"]
    again = next(evaluate(trained, cells, episodes=2))
    assert again["return_mean"] == first["return_mean"], "the same random numbers every time"


def test_campaign_over_two_algorithms(tmp_path: Path, start_cli: Callable[..., Any]) -> None:
    file = tmp_path / "both.yaml"
    matrix = {"l1": ["off", "paper"], "seed": [0]}
    recipes = ("pets/inverted_pendulum", "dets/inverted_pendulum")
    runs = [{"recipe": name, "overrides": TINY_PETS, "matrix": matrix} for name in recipes]
    file.write_text(dump_yaml({"runs": runs}))
    planned = plan(read_campaign(str(file)), tmp_path / "out")
    assert {one.config.model.head for one in planned} == {"gaussian", "deterministic"}
    command = ["campaign", str(file), "--output", str(tmp_path / "out"), "--workers", "2"]
    assert start_cli(command).wait() == 0, (tmp_path / "output").read_text()
    assert all(one.problem() is None for one in planned)
    settings = json.dumps([one.settings() for one in planned])
    assert '"algorithm": "pets"' in settings


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("cem.elites=9", "must be fewer"),
        ("propagation=ts2", "propagation"),
        ("precision=float16", "precision"),
        ("random_steps=0", "random_steps"),
        ("replan_every=4", "replan_every"),
        ("fit.weight_decay=[-1]", "weight_decay"),
    ],
)
def test_bad_settings_of_a_planner_are_named_before_anything_starts(
    override: str, message: str, make: Make, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        run(make(override))
    assert not (tmp_path / "run").exists()
