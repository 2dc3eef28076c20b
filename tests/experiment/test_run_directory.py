from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from torchrl_l1.experiment.errors import RunDirectoryInUse
from torchrl_l1.experiment.files import locked
from torchrl_l1.experiment.run_directory import RunDirectory, commit
from torchrl_l1.experiment.settings import differences

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


def test_commit_of_a_checkout_and_whether_it_was_changed(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    package = tmp_path / "package"
    package.mkdir()
    (package / "code.py").write_text("x = 1")
    assert commit(package) is None
    git("init")
    assert commit(package) is None  # no commit yet
    git("add", ".")
    git("commit", "-m", "first")
    head = git("rev-parse", "HEAD")
    assert commit(package) == head
    (tmp_path / "notes.md").write_text("beside the package")
    assert commit(package) == head
    (package / "code.py").write_text("x = 2")
    assert commit(package) == f"{head} with changes"


def test_installation_below_somebody_elses_checkout_has_no_commit(tmp_path: Path) -> None:
    subprocess.run(["git", "init", str(tmp_path)], check=True, capture_output=True)
    package = tmp_path / "venv" / "site-packages" / "package"
    package.mkdir(parents=True)
    assert commit(package) is None


def test_no_git_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".git").mkdir()
    monkeypatch.setenv("PATH", "")
    assert commit(tmp_path / "package") is None


def test_files_of_one_name_in_other_folders_are_compared(tmp_path: Path) -> None:
    for folder, text in (("one", "a = 1"), ("copy", "a = 1"), ("other", "a = 2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.py").write_text(text)
    one, copy, other = (
        {"algorithm": "pets", "task": "own.py:make", "search_path": [str(tmp_path / folder)]}
        for folder in ("one", "copy", "other")
    )
    assert differences(one, copy) == [] == differences(one, one)
    (found,) = differences(one, other)
    assert found.startswith("search_path: [") and str(tmp_path / "other") in found
    (tmp_path / "one/own.py").unlink()  # a project that has moved
    assert differences(one, other) == []


def test_a_run_goes_on_and_is_read_where_its_configuration_is_older_than_its_checkpoint() -> None:
    """One that a later version has gone on with: only the checkpoint knows the new setting."""
    newer = {"algorithm": "metrpo", "seed": 0, "threads": 1, "l1": {"enabled": True, "a_s": -1.0}}
    older = {"algorithm": "metrpo", "seed": 0, "l1": {"enabled": True}}
    assert differences(newer, older) == [] == differences(older, newer)
    (found,) = differences({**newer, "threads": 2}, older)
    assert found == "threads: 2 there, 1 now"
    (found,) = differences(older, {**newer, "l1": {"enabled": True, "a_s": -2.0}})
    assert found == "l1.a_s: -1.0 there, -2.0 now"


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
