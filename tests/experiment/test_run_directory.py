from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from torchrl_l1.experiment.errors import RunDirectoryError, RunDirectoryInUse
from torchrl_l1.experiment.files import locked
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory

HOLD = """
import subprocess, sys, time
from pathlib import Path
from torchrl_l1.experiment.files import locked
with locked(Path(sys.argv[1])) as ours:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    print(ours, child.pid, flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds ``tmp_path / '.lock'``; it has a child that outlives it."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / ".lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        ours, child = process.stdout.readline().split()
        assert ours == "True"
        yield process
        process.kill()
        os.kill(int(child), 9)


def test_a_lock_ends_with_its_process_and_not_with_its_children(
    holder: subprocess.Popen[str], tmp_path: Path
) -> None:
    directory = RunDirectory(tmp_path)
    assert directory.held()
    with pytest.raises(RunDirectoryInUse, match="another process is running"):
        directory.open({"seed": 0}, resume=False).__enter__()
    assert not directory.config_file.exists()
    holder.kill()
    holder.wait()
    assert not directory.held()
    with directory.open({"seed": 0}, resume=False):
        assert directory.held()


def test_looking_for_a_lock_makes_none(tmp_path: Path) -> None:
    assert not RunDirectory(tmp_path).held()
    assert not list(tmp_path.iterdir())


def test_the_lock_of_a_directory_that_is_not_ours_is_seen(tmp_path: Path) -> None:
    lock = tmp_path / ".lock"
    with locked(lock) as ours:
        assert ours
        lock.chmod(0o400)
        assert RunDirectory(tmp_path).held()
    assert not RunDirectory(tmp_path).held()
    assert lock.exists()


def test_locks_of_older_versions_count(tmp_path: Path) -> None:
    fcntl = pytest.importorskip("fcntl")
    with (tmp_path / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert RunDirectory(tmp_path).held()
    assert not RunDirectory(tmp_path).held()
    with (
        locked(tmp_path / ".lock"),
        (tmp_path / ".lock").open() as lock,
        pytest.raises(BlockingIOError),
    ):
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)


def test_data_that_have_changed_since_a_run_began_are_known(tmp_path: Path) -> None:
    """By those who would copy the run; one that goes on has them in its checkpoint."""
    data, run = tmp_path / "data.npz", RunDirectory(tmp_path / "run")
    config = {"algorithm": "offline", "task": "hopper", "seed": 0, "dataset": str(data)}
    data.write_bytes(b"first")
    with run.open(config, resume=False):
        pass
    copy = tmp_path / "copy.npz"
    shutil.copyfile(data, copy)
    os.replace(copy, data)  # another file with what was in the first
    assert run.changed_files(config, data=True) == []
    data.write_bytes(b"other")
    assert run.changed_files(config, data=True) == [str(data)]
    assert run.changed_files(config) == []
    data.unlink()
    assert run.changed_files(config, data=True) == []


def test_files_of_the_system_occupy_no_directory(tmp_path: Path) -> None:
    for name in (".DS_Store", ".nfs00000000a1b2c3d400000001"):
        (tmp_path / name).touch()
    assert RunDirectory(tmp_path).free()
    (tmp_path / ".profile").touch()
    assert not RunDirectory(tmp_path).free()


def test_what_a_kill_has_left_is_removed_where_a_run_begins(tmp_path: Path) -> None:
    for name in ("config.yaml.0123abcd.tmp", "config.yaml.tmp", "versions.json"):
        (tmp_path / name).touch()
    with RunDirectory(tmp_path).open({"seed": 0}, resume=False):
        left = (tmp_path / "checkpoint.pt.89abcdef.tmp", tmp_path / "notes.tmp")
        for file in left:
            file.touch()
    with RunDirectory(tmp_path).open({"seed": 0}, resume=True):
        assert [file.exists() for file in left] == [False, True]
    assert not (tmp_path / "config.yaml.0123abcd.tmp").exists()


def test_a_directory_is_refused_before_any_data_are_read(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("mine")
    overrides = ["dataset=nowhere.npz", f"run_dir={tmp_path}", "wandb.mode=disabled"]
    with pytest.raises(RunDirectoryError, match="is not empty and holds no run"):
        run(compose("offline/inverted_pendulum", overrides))
    assert [file.name for file in tmp_path.iterdir()] == ["letter.txt"]
