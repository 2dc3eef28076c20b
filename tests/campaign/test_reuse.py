"""Runs that campaigns share: trained by one, copied by the others."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from torchrl_l1.campaign import reuse
from torchrl_l1.campaign.description import CampaignError, dump_yaml, read_campaign
from torchrl_l1.campaign.evaluation import evaluate_run, is_evaluated
from torchrl_l1.campaign.plan import PlannedRun, plan
from torchrl_l1.campaign.reuse import copy_run, find_reusable
from torchrl_l1.cli import main
from torchrl_l1.experiment.files import locked
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.experiment.wandb_files import draw_id, known_id
from torchrl_l1.report import find_runs
from torchrl_l1.report.study import Study

EVALUATION = {"name": "noisy", "l1": ["off"], "noise": ["action"], "episodes": 1}


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the campaigns' one run with seed 0 is kept, once it is trained."""
    return tmp_path_factory.mktemp("shared") / "seed_0"


@pytest.fixture
def write(tmp_path: Path, tiny_overrides: list[str]) -> Callable[..., Path]:
    def write(name: str, seeds: list[int], **entries: Any) -> Path:
        file = tmp_path / f"{name}.yaml"
        matrix = {"l1": ["off"], "seed": seeds}
        one = {"recipe": "metrpo/inverted_pendulum", "overrides": tiny_overrides, "matrix": matrix}
        file.write_text(dump_yaml({"runs": [one], "evaluations": [EVALUATION], **entries}))
        return file

    return write


@pytest.fixture
def first(write: Callable[..., Path], shared: Path, tmp_path: Path) -> PlannedRun:
    """The finished and evaluated run of a first campaign, and of its own for each test."""
    (this,) = planned(write("first", [0]), tmp_path / "first")
    if not shared.exists():
        run(OmegaConf.merge(this.config, {"run_dir": str(shared)}))
        evaluate_run(str(shared), "noisy", this.evaluations[0].of_a_run())
    shutil.copytree(shared, this.directory.path)
    this.directory.check_same(this.settings())
    return this


def planned(file: Path, output: Path, *overrides: str) -> list[PlannedRun]:
    return plan(read_campaign(str(file), overrides), output.resolve())


def contents(folder: Path) -> dict[str, bytes]:
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def command(file: Path, output: Path, *more: object) -> list[str]:
    return ["campaign", str(file), "--output", str(output), "--workers", "2", *map(str, more)]


def test_shared_runs_are_copied_and_the_others_trained(
    write: Callable[..., Path],
    first: PlannedRun,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    start_cli: Callable[..., Any],
) -> None:
    file, output = write("second", [0, 1]), tmp_path / "second"
    before = contents(first.directory.path)
    arguments = command(file, output, "--reuse", tmp_path)

    main([*arguments, "--list"])
    assert capsys.readouterr().out.splitlines() == [
        f"reused   metrpo/inverted_pendulum l1=off seed=0 from {first.directory.path}",
        "waiting  metrpo/inverted_pendulum l1=off seed=1",
        "2 runs: 0 finished, 1 reused, 0 begun, 1 waiting; 2 of 4 iterations",
    ]
    assert not output.exists()

    assert start_cli(arguments).wait() == 0
    lines = (tmp_path / "output").read_text().splitlines()
    assert f"reused metrpo/inverted_pendulum l1=off seed=0 from {first.directory.path}" in lines
    assert [line for line in lines if line.startswith("reused")] == lines[:1]
    copied, trained = planned(file, output)
    assert copied.problem() is None and trained.problem() is None
    assert not copied.directory.path.with_name("seed_0.log").exists(), "no process was needed"
    assert trained.directory.path.with_name("seed_1.log").exists()
    after = contents(copied.directory.path)
    # Nothing differs but the place: an unbroken run of the second campaign would be the same.
    assert after.keys() == before.keys() - {".lock"}
    assert [name for name in after if after[name] != before[name]] == ["config.yaml"]
    config = OmegaConf.load(copied.directory.config_file)
    assert config.run_dir == str(copied.directory.path)
    assert contents(first.directory.path) == before
    assert not list(output.rglob("*.copy"))

    study = Study(find_runs([tmp_path / "first", output]))
    assert sorted(one.identity.seed for one in study.runs) == [0, 1]
    assert [one.path for one in study.duplicates] == [copied.directory.path]
    main(["report", str(output), "--output", str(tmp_path / "report")])
    assert (tmp_path / "report/report.md").exists()

    before = contents(output)
    capsys.readouterr()
    main(arguments)
    assert contents(output) == before
    assert "reused" not in capsys.readouterr().out
    # It goes on like any other.
    (longer,) = planned(write("second", [0]), output, "outer_iterations=3")
    run(OmegaConf.merge(longer.config, {"resume": True}))
    assert longer.problem() is None


@pytest.mark.parametrize("setting", ["discount=0.9", "outer_iterations=1", "outer_iterations=3"])
def test_run_with_another_setting_is_not_taken(
    setting: str, write: Callable[..., Path], first: PlannedRun, tmp_path: Path
) -> None:
    output = (tmp_path / "second").resolve()
    file = write("second", [0])
    assert find_reusable(planned(file, output, setting), output, [tmp_path]) == {}
    (this,) = planned(file, output, "wandb.mode=offline")
    expected = {this.directory.path: first.directory.path}
    assert find_reusable([this], output, [tmp_path]) == expected


def test_unfinished_held_and_own_runs_are_not_taken(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path
) -> None:
    output = (tmp_path / "second").resolve()
    (this,) = planned(write("second", [0]), output)

    def found(output: Path = output) -> dict[Path, Path]:
        return find_reusable([this], output, [tmp_path])

    assert list(found().values()) == [first.directory.path]
    assert found(output=(tmp_path / "first").resolve()) == {}
    with locked(first.directory.path / ".lock") as ours:
        assert ours
        assert found() == {}
    assert found()
    config = first.directory.config_file.read_text()
    for broken in ("{", config.replace("outer_iterations: 2", ""), config.replace("seed: 0", "")):
        first.directory.config_file.write_text(broken)
        assert found() == {}
    first.directory.config_file.write_text(config)
    metrics = first.directory.metrics_file.read_text().splitlines(keepends=True)
    for rows in (metrics[:-1], [*metrics, metrics[-1]]):
        first.directory.metrics_file.write_text("".join(rows))
        assert found() == {}
    first.directory.metrics_file.write_text("".join(metrics))
    assert found()
    first.directory.checkpoint_file.unlink()
    assert found() == {}


def test_output_reached_by_a_link_is_still_the_campaigns_own(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path
) -> None:
    output = (tmp_path / "first").resolve()
    (tmp_path / "link").symlink_to(output)
    (this,) = planned(write("second", [0]), tmp_path / "elsewhere")
    assert find_reusable([this], output, [tmp_path / "link"]) == {}
    assert len(find_reusable([this], tmp_path / "elsewhere", [tmp_path / "link"])) == 1


def test_copy_goes_only_where_no_run_is(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path
) -> None:
    output = (tmp_path / "second").resolve()
    (this,) = planned(write("second", [0]), output)
    target = this.directory.path
    target.mkdir(parents=True)
    (target / "thesis.tex").write_text("years of work")
    assert find_reusable([this], output, [tmp_path]) == {}
    # Were it written meanwhile, it would still be safe.
    with pytest.raises(CampaignError, match="cannot copy"):
        copy_run(first.directory.path, this)
    assert contents(target.parent) == {"seed_0/thesis.tex": b"years of work"}
    # What a run leaves that is killed in its first moments is no run.
    (target / "thesis.tex").rename(target / ".lock")
    with locked(target / ".lock") as ours:
        assert ours
        assert find_reusable([this], output, [tmp_path]) == {}
    assert len(find_reusable([this], output, [tmp_path])) == 1
    copy_run(first.directory.path, this)
    assert this.problem() is None


def test_kill_while_copying_leaves_no_run_and_the_next_start_copies(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = (tmp_path / "second").resolve()
    (this,) = planned(write("second", [0]), output)

    class Killed(BaseException):
        pass

    def killed(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(reuse, "write_atomically", killed)
        with pytest.raises(Killed):
            copy_run(first.directory.path, this)
    half = this.directory.path.with_name(".seed_0.copy")
    assert half.is_dir() and not this.directory.path.exists()
    with pytest.raises(FileNotFoundError, match="no run"):
        find_runs([output])
    (half / "rest").write_text("of the first attempt")
    copy_run(first.directory.path, this)
    assert this.problem() is None and not half.exists()
    assert not (this.directory.path / "rest").exists()


def test_the_source_is_never_changed_through_links(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path
) -> None:
    source, elsewhere = first.directory.path, tmp_path / "elsewhere"
    (source / "evaluations").rename(elsewhere)
    (source / "evaluations").symlink_to(elsewhere)
    (source / "model.pt").rename(tmp_path / "model.pt")
    (source / "model.pt").symlink_to(tmp_path / "model.pt")
    (source / "wandb").symlink_to(tmp_path / "nowhere")
    before = contents(elsewhere)
    other = EVALUATION | {"name": "other"}
    (this,) = planned(write("second", [0], evaluations=[other]), tmp_path / "second")
    copy_run(source, this)
    assert this.problem() is None
    assert contents(elsewhere) == before and (tmp_path / "model.pt").exists()
    copied = list(this.directory.path.rglob("*"))
    assert copied and not any(path.is_symlink() for path in copied)
    assert (source / "evaluations").is_symlink()


def test_run_that_changes_while_it_is_copied_is_refused(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path
) -> None:
    (this,) = planned(write("second", [0]), tmp_path / "second")
    config = first.directory.config_file.read_text()
    longer = config.replace("outer_iterations: 2", "outer_iterations: 3")
    first.directory.config_file.write_text(longer)
    with pytest.raises(CampaignError, match="has changed meanwhile"):
        copy_run(first.directory.path, this)
    assert not list(this.directory.path.parent.iterdir())


@pytest.mark.parametrize("changed", ["noisy.csv", "noisy.yaml", "episodes/noisy.csv"])
def test_evaluation_made_again_while_it_is_copied_is_made_here_too(
    changed: str,
    write: Callable[..., Path],
    first: PlannedRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (this,) = planned(write("second", [0]), tmp_path / "second")
    read_config = reuse.read_config

    def change(file: Path) -> dict[str, Any]:
        with (first.directory.path / "evaluations" / changed).open("a") as handle:
            handle.write("\n")
        return read_config(file)

    monkeypatch.setattr(reuse, "read_config", change)
    copy_run(first.directory.path, this)
    (settings,) = this.evaluations
    # A table with another line is not the one that its settings have the checksum of.
    assert is_evaluated(first.directory, settings) == (changed == "noisy.yaml")
    assert not is_evaluated(this.directory, settings)


def test_only_the_evaluations_of_this_campaign_are_copied(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path
) -> None:
    other = EVALUATION | {"name": "other"}
    (this,) = planned(write("second", [0], evaluations=[other]), tmp_path / "second")
    copy_run(first.directory.path, this)
    assert this.problem() is None
    assert not list(this.directory.path.rglob("noisy.*"))
    assert list(first.directory.path.rglob("noisy.*"))


def test_reused_run_needs_no_device(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    first.config.device = "cuda"
    first.directory.config_file.write_text(OmegaConf.to_yaml(first.config))
    output = tmp_path / "second"
    main(command(write("second", [0]), output, "device=cuda", "--reuse", tmp_path / "first"))
    (directory,) = map(RunDirectory, output.rglob("seed_0"))
    assert directory.iterations_done() == 2


def test_unknown_folders_are_named_before_anything_starts(
    write: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file, output = write("second", [0]), tmp_path / "second"
    monkeypatch.chdir(tmp_path)
    for folders, culprit in [
        ([os.curdir, "nowhere"], "there is no folder nowhere"),
        (["second.yaml"], "there is no folder second.yaml"),
        ([os.curdir, "seed=3"], "there is no folder seed=3; overrides go before --reuse"),
    ]:
        with pytest.raises(SystemExit):
            main(command(file, output, "--reuse", *folders))
        printed = capsys.readouterr().err
        assert culprit in printed and "Traceback" not in printed
    assert not output.exists()


def test_a_copy_is_another_run_for_wandb(
    write: Callable[..., Path], first: PlannedRun, tmp_path: Path
) -> None:
    (this,) = planned(write("second", [0]), tmp_path / "second")
    source = first.directory.path
    (source / "wandb").mkdir()
    (source / "wandb" / "log").write_text("of the source")
    given = draw_id(source)
    copy_run(source, this)
    copied = known_id(this.directory.path)
    assert copied is not None and copied != given == known_id(source)
    assert not (this.directory.path / "wandb").exists()
