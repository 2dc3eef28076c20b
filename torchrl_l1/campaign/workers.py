"""A queue of subprocesses, some of them at a time."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from torchrl_l1.experiment.errors import RunDirectoryError, message
from torchrl_l1.experiment.files import refuse_link, write_atomically

# A process that found another one at its work; EX_TEMPFAIL, a name that Windows does not have.
TEMPORARY_FAILURE = 75
POLL_SECONDS = 0.1
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
_STOPPING = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
GRACE_SECONDS = 10.0
_LAST_LINES = 15
# As much as a few files of a tiny run take.
_ROOM = 65_536


@dataclass
class Job:
    """A process to be started.

    Attributes:
        name: for messages.
        command: what is started.
        log: file that its output is appended to.
        held: whether a process that is not ours is at the same work now.
        done: called once it has ended well; what it gives is started next. It may raise
            :class:`Unfinished`.
    """

    name: str
    command: Sequence[str]
    log: Path
    held: Callable[[], bool]
    done: Callable[[], Iterable[Job]]


class Unfinished(Exception):
    """A process has ended well, but its work is not done; the message says what is wrong."""


@dataclass
class Failure:
    """A job that ended badly.

    Attributes:
        job: which.
        how: how it ended.
    """

    job: Job
    how: str

    def __str__(self) -> str:
        """Name, how it ended, and the end of the log."""
        log = self.job.log
        try:
            lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return f"{self.job.name} {self.how}; there is no log"
        parts = [f"{self.job.name} {self.how}"]
        if problem := self._no_room():
            parts.append(problem)
        if lines or not problem:
            tail = (f"\n    {line}" for line in lines[-_LAST_LINES:])
            parts.append("".join([f"the end of {log}:", *tail]))
        return "; ".join(parts)

    def _no_room(self) -> str:
        """Why the log may lack the very reason; empty if there was room for it."""
        probe = self.job.log.with_name(f"{self.job.log.name}.room")
        try:
            refuse_link(probe)
            write_atomically(probe, bytes(_ROOM))
            probe.unlink()
        except (OSError, RunDirectoryError) as error:
            # The probe is gone; it is the log that has no room.
            return message(error).replace(str(probe), str(self.job.log))
        return ""


class Stopped(Exception):
    """The campaign was told to stop; all its processes have ended."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signal_number).name}")
        self.signal_number = signal_number


class Workers:
    """Runs jobs, ``count`` at a time, in the calling thread.

    A process that ends with the status ``TEMPORARY_FAILURE`` has found another one at its work; it
    is started again once that has ended.

    Each process has one thread and a session of its own, so that a Ctrl-C reaches the campaign
    alone, which then ends them. It must be the main thread: on Linux the system ends the
    processes when the thread that started them does.

    Args:
        count: processes at a time.
        on_tick: called again and again with the jobs that are running.
        on_wait: called once with each job that waits for a process that is not ours.
    """

    def __init__(
        self,
        count: int,
        on_tick: Callable[[Sequence[Job]], None],
        on_wait: Callable[[Job], None],
    ) -> None:
        self.count = count
        self._on_tick, self._on_wait = on_tick, on_wait
        self._queue: deque[Job] = deque()
        self._running: list[tuple[Job, subprocess.Popen[bytes]]] = []
        self._waiting: set[int] = set()
        self._failures: list[Failure] = []
        self._stop: int | None = None

    def work(self, jobs: Iterable[Job]) -> list[Failure]:
        """Run all jobs and what they lead to.

        Returns:
            the jobs that ended badly; the others went on.

        Raises:
            Stopped: after SIGINT, SIGTERM, SIGHUP or SIGUSR1, unless it is ignored, once every
                process has ended.
        """
        self._queue.extend(jobs)
        with self._signals():
            try:
                while self._queue or self._running:
                    if self._stop is not None:
                        raise Stopped(self._stop)
                    self._start()
                    self._collect()
                    self._on_tick([job for job, _ in self._running])
                    time.sleep(POLL_SECONDS)
            finally:
                self._end_all()
        return self._failures

    def _start(self) -> None:
        for job in list(self._queue):
            if len(self._running) >= self.count:
                break
            try:
                if job.held():
                    if id(job) not in self._waiting:
                        self._waiting.add(id(job))
                        self._on_wait(job)
                    continue
                self._queue.remove(job)
                process = self._process(job)
            except (OSError, RunDirectoryError) as error:
                # It cannot even have a log; the others may.
                if job in self._queue:
                    self._queue.remove(job)
                self._failures.append(Failure(job, f"could not be started: {message(error)}"))
            else:
                self._running.append((job, process))

    def _process(self, job: Job) -> subprocess.Popen[bytes]:
        job.log.parent.mkdir(parents=True, exist_ok=True)
        refuse_link(job.log)
        with job.log.open("ab") as log:
            return subprocess.Popen(
                job.command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
                start_new_session=True,
            )

    def _collect(self) -> None:
        for entry in list(self._running):
            job, process = entry
            status = process.poll()
            if status is None:
                continue
            self._running.remove(entry)
            if status == TEMPORARY_FAILURE:
                self._queue.append(job)
            elif status != 0:
                how = f"signal {-status}" if status < 0 else f"status {status}"
                self._failures.append(Failure(job, f"ended with {how}"))
            else:
                try:
                    self._queue.extendleft(reversed(list(job.done())))
                except Unfinished as error:
                    self._failures.append(Failure(job, f"ended well, but {error}"))

    def _end_all(self) -> None:
        for _, process in self._running:
            _end(process)
        deadline = time.monotonic() + GRACE_SECONDS
        for _, process in self._running:
            try:
                process.wait(max(deadline - time.monotonic(), 0))
            except subprocess.TimeoutExpired:
                _end(process, at_once=True)
                process.wait()
        self._running.clear()

    @contextmanager
    def _signals(self) -> Iterator[None]:
        def note(signal_number: int, frame: FrameType | None) -> None:
            self._stop = signal_number

        before = {
            number: signal.signal(number, note)
            for number in _STOPPING
            # What is ignored, as by nohup, stays so.
            if signal.getsignal(number) is not signal.SIG_IGN
        }
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _end(process: subprocess.Popen[bytes], at_once: bool = False) -> None:
    if os.name == "nt":  # there are no sessions
        process.kill()
        return
    # The session outlives its leader if that had children; once all are gone there is none.
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL if at_once else signal.SIGTERM)


def available_cores() -> int:
    """CPU cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    return len(affinity(0)) if affinity else os.cpu_count() or 1
