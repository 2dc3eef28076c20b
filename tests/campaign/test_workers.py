"""The queue of subprocesses, with processes that take no time to start."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from torchrl_l1.campaign.workers import (
    TAKEN,
    Job,
    Stopped,
    Unfinished,
    Workers,
    available_cores,
)
from torchrl_l1.experiment.shutdown import RESUME_ME

MakeJob = Callable[..., Job]


@pytest.fixture
def make_job(tmp_path: Path) -> MakeJob:
    def make(
        script: str,
        then: Callable[[], Iterable[Job]] = list,
        held: Callable[[], bool] = lambda: False,
    ) -> Job:
        return Job(script, ["sh", "-c", script], tmp_path / "deep" / "run.log", held, then)

    return make


def workers(count: int, ticks: list[int] | None = None) -> Workers:
    seen = [] if ticks is None else ticks
    return Workers(count, lambda running: seen.append(len(running)), lambda job: None)


def test_failures_are_told_with_their_log_and_stop_nothing(make_job: MakeJob) -> None:
    ended: list[str] = []
    jobs = [
        make_job("echo out; echo wrong >&2; exit 3"),
        make_job("kill -9 $$"),
        make_job("exit 0", lambda: [make_job("true", lambda: ended.append("late") or [])]),
    ]
    failures = workers(1).work(jobs)
    assert [failure.how for failure in failures] == ["ended with status 3", "ended with signal 9"]
    assert str(failures[0]).startswith("echo out; echo wrong >&2; exit 3 ended with status 3")
    assert str(failures[0]).splitlines()[1:] == ["    out", "    wrong"]
    assert ended == ["late"]


def test_a_job_that_cannot_write_its_log_is_named_and_stops_nothing(
    make_job: MakeJob, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "elsewhere").write_text("years of work")
    (tmp_path / "link.log").symlink_to(tmp_path / "elsewhere")
    ended: list[str] = []
    below = replace(make_job("echo in"), log=tmp_path / "file" / "run.log")
    linked = replace(make_job("echo out"), log=tmp_path / "link.log")
    last = make_job("true", lambda: ended.append("last") or [])
    first, second = workers(1).work([below, linked, last])
    assert "echo in could not be started" in str(first)
    assert str(tmp_path / "file") in str(first) and "in the way" in str(first)
    assert "symbolic link" in str(second)
    assert ended == ["last"] and (tmp_path / "elsewhere").read_text() == "years of work"


def test_no_more_processes_than_workers_and_what_follows_comes_first(make_job: MakeJob) -> None:
    order: list[str] = []

    def note(name: str, *then: Job) -> Callable[[], list[Job]]:
        return lambda: order.append(name) or list(then)

    ticks: list[int] = []
    evaluation = make_job("sleep 0.3", note("a's evaluation"))
    jobs = [make_job("sleep 0.3", note("a", evaluation)), make_job("sleep 0.3", note("b"))]
    workers(1, ticks).work(jobs)
    assert order == ["a", "a's evaluation", "b"]
    assert max(ticks) == 1
    workers(3, ticks).work([make_job("sleep 0.5") for _ in range(5)])
    assert max(ticks) == 3


def test_waits_for_a_process_that_is_not_its_own(make_job: MakeJob, tmp_path: Path) -> None:
    orphan = tmp_path / "orphan"
    orphan.touch()
    waited: list[str] = []
    threading.Timer(0.3, orphan.unlink).start()
    script = f"test ! -e {orphan}"
    pool = Workers(1, lambda running: None, lambda job: waited.append(job.name))
    assert pool.work([make_job(script, held=orphan.exists)]) == []
    assert waited == [script]


def test_tries_again_if_another_process_was_quicker(make_job: MakeJob, tmp_path: Path) -> None:
    started = tmp_path / "started"
    ended: list[str] = []
    # The first attempt finds that another process has the directory, which then ends at once: by
    # the time the workers look, nobody holds it any more.
    script = f"test -e {started} || {{ touch {started}; exit {TAKEN}; }}"
    job = make_job(script, lambda: ended.append("done") or [])
    assert workers(1).work([job]) == []
    assert ended == ["done"]


def test_a_process_that_was_asked_to_make_room_is_not_started_again(
    make_job: MakeJob, tmp_path: Path
) -> None:
    started = tmp_path / "started"
    (failure,) = workers(1).work([make_job(f"echo once >> {started}; exit {RESUME_ME}")])
    assert "has made room, as it was asked" in str(failure)
    assert started.read_text() == "once\n"


def test_good_end_without_the_work_is_a_failure(make_job: MakeJob) -> None:
    def done() -> list[Job]:
        raise Unfinished("it has 3 of 4 iterations")

    ended: list[str] = []
    jobs = [make_job("echo bye", done), make_job("true", lambda: ended.append("next") or [])]
    (failure,) = workers(1).work(jobs)
    assert str(failure).startswith("echo bye succeeded, but it has 3 of 4 iterations")
    assert ended == ["next"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1])
def test_signal_ends_all_processes(
    number: signal.Signals, make_job: MakeJob, tmp_path: Path
) -> None:
    before = signal.getsignal(number)
    pids = tmp_path / "pids"
    # A run may have processes of its own.
    jobs = [make_job(f"echo $$ >> {pids}; sleep 1000 & wait") for _ in range(3)]

    def stop() -> None:
        while not pids.exists() or len(pids.read_text().split()) < 2:
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=stop)
    thread.start()
    with pytest.raises(Stopped, match=number.name):
        workers(2).work(jobs)
    thread.join()
    assert len(pids.read_text().split()) == 2, "a process was started after the signal"
    for pid in map(int, pids.read_text().split()):
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert signal.getsignal(number) == before


def test_an_ignored_signal_ends_nothing(make_job: MakeJob) -> None:
    """As SIGHUP is with nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        jobs = [make_job(f"kill -HUP {os.getpid()}"), make_job("true")]
        assert workers(1).work(jobs) == []
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_environment_has_one_thread(make_job: MakeJob) -> None:
    job = make_job("echo $OMP_NUM_THREADS $MKL_NUM_THREADS")
    assert workers(1).work([job]) == []
    assert job.log.read_text() == "1 1\n"
    assert 1 <= available_cores() <= (os.cpu_count() or 1)


def test_a_log_without_room_is_told_with_the_remedy(
    make_job: MakeJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "deep/run.log.room"))
    (silent,) = workers(1).work([make_job("exit 1")])
    (cut,) = workers(1).work([make_job("echo begun; exit 1")])
    assert "No space" not in str(silent) and not list(tmp_path.rglob("*.room"))
    monkeypatch.setattr("torchrl_l1.campaign.workers.write_atomically", Mock(side_effect=full))
    log = tmp_path / "deep/run.log"
    line = f"; {log}: No space left on device; free some space"
    assert line in str(cut) and str(cut).endswith("\n    begun")
    log.write_text("")
    assert line in str(silent) and "\n" not in str(silent)
