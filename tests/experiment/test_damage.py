"""Run directories whose files were damaged, exchanged, locked away or replaced by links."""

from __future__ import annotations

import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.files import bounded_overrides, write_atomically
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory

Recipe = Callable[..., DictConfig]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, not to be changed."""
    from tests.conftest import TINY

    folder = tmp_path_factory.mktemp("whole") / "run"
    return run(compose("metrpo/inverted_pendulum", [*TINY, f"run_dir={folder}"]))


@pytest.fixture
def damaged(whole: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to be damaged."""
    shutil.copytree(whole, tmp_path / "run")
    return tmp_path / "run"


def same_files(one: Path, other: Path) -> bool:
    names = ("metrics.csv", "timing.csv", "model.pt", "policy.pt", "checksums.json")
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in names)


def cut_last(content: bytes) -> bytes:
    return content[:-100]


def another_digit(content: bytes) -> bytes:
    """A cell of the last row that reads as another number."""
    head, _, last = content.rstrip(b"\n").rpartition(b"\n")
    place = max(last.rfind(bytes([digit])) for digit in b"123456789")
    return head + b"\n" + last[:place] + b"0" + last[place + 1 :] + b"\n"


def garbage_line(content: bytes) -> bytes:
    head, _, last = content.rstrip(b"\n").rpartition(b"\n")
    return head + b"\n" + bytes(reversed(last)) + b"\n"


def one_more_line(content: bytes) -> bytes:
    return content + content.splitlines(keepends=True)[-1]


@pytest.mark.parametrize("name", ["metrics.csv", "timing.csv", "model.pt", "policy.pt"])
@pytest.mark.parametrize(
    "damage", [cut_last, another_digit, garbage_line, one_more_line, lambda content: b""]
)
def test_what_differs_from_the_checkpoint_is_seen_and_written_again(
    name: str,
    damage: Callable[[bytes], bytes],
    damaged: Path,
    whole: Path,
    tiny_recipe: Recipe,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = damaged / name
    assert RunDirectory(damaged).intact()
    changed = damage(file.read_bytes())
    assert changed != file.read_bytes()
    file.write_bytes(changed)
    assert not RunDirectory(damaged).intact()
    if name == "metrics.csv":
        assert RunDirectory(damaged).iterations_done() < 2
    run(tiny_recipe("resume=true"))
    assert f"rewritten from the checkpoint: {name}" in capsys.readouterr().out
    assert same_files(damaged, whole)


def test_a_lost_table_of_checksums_is_made_again(
    damaged: Path, whole: Path, tiny_recipe: Recipe
) -> None:
    for content in (None, b"", b"[1]", b'{"metrics.csv": 3}'):
        (damaged / "checksums.json").unlink()
        if content is not None:
            (damaged / "checksums.json").write_bytes(content)
            assert not RunDirectory(damaged).intact()
        run(tiny_recipe("resume=true"))
        assert same_files(damaged, whole)


def truncated(content: bytes) -> bytes:
    return content[: len(content) // 2]


def flipped(content: bytes) -> bytes:
    """Bits of weights: they load, and torch does not notice."""
    # More than fits between two entries of the archive, which nothing reads.
    place, length = len(content) // 2, 128
    damaged = bytes(byte ^ 1 for byte in content[place : place + length])
    return content[:place] + damaged + content[place + length :]


class Harmful:
    """Runs a command when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.target),)


SPOILT: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "truncated": truncated,
    "flipped": flipped,
    "garbage": lambda content: b"\x00garbage" * 100,
    "a list": lambda content: saved([1, 2]),
}


def saved(state: object) -> bytes:
    from torchrl_l1.experiment.files import saved as save

    return save(state)


@pytest.mark.parametrize("kind", list(SPOILT))
def test_the_checkpoint_before_is_used_in_place_of_one_that_cannot_be_read(
    kind: str,
    damaged: Path,
    whole: Path,
    tiny_recipe: Recipe,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = damaged / "checkpoint.pt"
    file.write_bytes(SPOILT[kind](file.read_bytes()))
    with pytest.raises(RunDirectoryError, match="resume the run"):
        load_run(damaged, last=True)
    assert load_run(damaged).algorithm.iteration == 1
    assert "checkpoint_previous.pt of 1 iterations is used instead" in capsys.readouterr().err
    run(tiny_recipe("resume=true"))
    lines = [line for line in capsys.readouterr().out.splitlines() if "cannot be read" in line]
    assert len(lines) == 1 and str(file) in lines[0]
    assert (damaged / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    # One that cannot be read has not taken the place of the one that can.
    assert len(torch.load(damaged / "checkpoint_previous.pt")["metrics"]) == 1


def test_code_in_a_checkpoint_is_not_run(
    damaged: Path, tmp_path: Path, tiny_recipe: Recipe, capsys: pytest.CaptureFixture[str]
) -> None:
    harm = Harmful(tmp_path / "harm")
    for content in (pickle.dumps(harm), saved(harm)):
        (damaged / "checkpoint.pt").write_bytes(content)
        run(tiny_recipe("resume=true"))
        assert "checkpoint_previous.pt of" in capsys.readouterr().out
    assert not (tmp_path / "harm").exists()


def test_a_run_without_any_checkpoint_is_not_started_over_its_results(
    damaged: Path, tiny_recipe: Recipe
) -> None:
    before = (damaged / "metrics.csv").read_bytes()
    (damaged / "checkpoint.pt").unlink()
    (damaged / "checkpoint_previous.pt").write_bytes(b"")
    for _ in range(2):
        with pytest.raises(RunDirectoryError, match="but there are results") as error:
            run(tiny_recipe("resume=true"))
        assert "\n" not in str(error.value)
        (damaged / "checkpoint_previous.pt").unlink(missing_ok=True)
    assert (damaged / "metrics.csv").read_bytes() == before


def test_without_results_a_broken_first_checkpoint_is_started_over(
    damaged: Path, whole: Path, tiny_recipe: Recipe, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("metrics.csv", "timing.csv", "model.pt", "policy.pt", "checkpoint_previous.pt"):
        (damaged / name).unlink()
    (damaged / "checkpoint.pt").write_bytes(b"PK")
    run(tiny_recipe("resume=true"))
    assert "the run starts over" in capsys.readouterr().out
    assert (damaged / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()


def test_a_checkpoint_of_another_run_is_refused_and_one_of_another_torch_is_told(
    damaged: Path, whole: Path, tiny_recipe: Recipe, capsys: pytest.CaptureFixture[str]
) -> None:
    file = damaged / "checkpoint.pt"
    state = torch.load(file)
    for key, value in (("seed", 7), ("discount", 0.5)):
        other = {**state, "settings": {**state["settings"], key: value}}
        torch.save(other, file)
        with pytest.raises(RunDirectoryError, match=f"another configuration: {key}: {value} there"):
            run(tiny_recipe("resume=true"))
        with pytest.raises(RunDirectoryError, match="another configuration"):
            load_run(damaged)
    # Those that are older say nothing of their settings, but have other weights.
    older = {key: state[key] for key in ("algorithm", "metrics", "timings")}
    torch.save({**older, "algorithm": {**state["algorithm"], "policy": {}}}, file)
    with pytest.raises(RunDirectoryError, match="does not fit the run"):
        run(tiny_recipe("resume=true"))
    torch.save({**state, "torch": "1.0"}, file)
    run(tiny_recipe("resume=true"))
    assert "was written with torch 1.0" in capsys.readouterr().out


def test_links_are_not_followed_for_writing(damaged: Path, tmp_path: Path) -> None:
    outside = tmp_path / "thesis.tex"
    outside.write_text("years of work")
    for name in ("metrics.csv", "metrics.csv.tmp"):
        (damaged / name).unlink(missing_ok=True)
        (damaged / name).symlink_to(outside)
        write_atomically(damaged / "metrics.csv", "new")
        assert (damaged / "metrics.csv").read_text() == "new"
        assert not (damaged / "metrics.csv").is_symlink()
    (damaged / ".lock").unlink(missing_ok=True)
    (damaged / ".lock").symlink_to(tmp_path / "made")
    with pytest.raises(RunDirectoryError, match="symbolic link"):
        run(compose_again(damaged))
    assert not (tmp_path / "made").exists()
    assert outside.read_text() == "years of work"


def compose_again(directory: Path) -> DictConfig:
    config = OmegaConf.load(directory / "config.yaml")
    whole = compose("metrpo/inverted_pendulum", [f"run_dir={directory}"])
    own = {"resume": True, "run_dir": str(directory)}
    return OmegaConf.merge(whole, config, own)  # type: ignore[return-value]


@pytest.mark.parametrize("name", ["evaluations", "evaluation", "wandb"])
def test_folders_that_are_links_are_not_written_into(
    name: str, damaged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_l1.campaign.evaluation import evaluate_run
    from torchrl_l1.cli import main

    outside = tmp_path / "outside"
    outside.mkdir()
    (damaged / name).symlink_to(outside)
    if name == "evaluations":
        with pytest.raises(RunDirectoryError, match="symbolic link"):
            evaluate_run(str(damaged), "mine", {"l1": ["off"], "episodes": 1})
    elif name == "evaluation":
        with pytest.raises(SystemExit):
            main(["evaluate", str(damaged), "--l1", "off", "--episodes", "1"])
        assert "symbolic link" in capsys.readouterr().err
    else:
        config = compose_again(damaged)
        config.outer_iterations, config.wandb.mode = 3, "offline"
        with pytest.raises(RunDirectoryError, match="symbolic link"):
            run(config)
    assert not list(outside.iterdir())


def test_a_file_in_the_way_and_a_full_disk_are_told_with_path_and_remedy(
    damaged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    from torchrl_l1.cli import main
    from torchrl_l1.experiment.files import os as os_of_files

    def said(*arguments: str) -> str:
        with pytest.raises(SystemExit) as exit_info:
            main(list(arguments))
        assert exit_info.value.code == 1
        text = capsys.readouterr().err
        (line,) = [part for part in text.splitlines() if part.startswith("torchrl-l1 ")]
        assert "Traceback" not in text
        return line

    (tmp_path / "file").write_text("")
    evaluate = ("evaluate", str(damaged), "--l1", "off", "--episodes", "1")
    assert "in the way" in said(*evaluate, "--output", str(tmp_path / "file" / "below"))
    assert "shorter name" in said(*evaluate, "--output", str(tmp_path / ("x" * 300)))
    report = ("report", str(damaged))
    assert "in the way" in said(*report, "--output", str(tmp_path / "file" / "below"))

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    before = {file.name: file.read_bytes() for file in damaged.iterdir() if file.is_file()}
    monkeypatch.setattr(os_of_files, "fsync", full)
    line = said(*report, "--output", str(tmp_path / "out"))
    assert str(tmp_path / "out") in line and "free some space" in line
    line = said(*evaluate)
    assert f"{damaged / 'evaluation'}: " in line and "free some space" in line
    with pytest.raises(OSError, match=r"checkpoint\.pt"):
        RunDirectory(damaged).save_checkpoint({})
    monkeypatch.undo()
    after = {file.name: file.read_bytes() for file in damaged.iterdir() if file.is_file()}
    assert after == before


def test_long_lists_of_overrides_get_a_short_name() -> None:
    parts = [f"a.very.long.key_{i}={i}" for i in range(30)]
    name = bounded_overrides(",".join(["l1=off", "model.hidden=[8,8]", *parts]))
    assert len(name) < 140 and name.startswith("l1=off,model.hidden=[8,8],")
    others = [*parts[:-1], parts[-1] + "0"]
    assert bounded_overrides(",".join(["l1=off", "model.hidden=[8,8]", *others])) != name
