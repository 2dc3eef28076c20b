"""A queue of subprocesses, of which several run at a time."""

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
from torchrl_l1.experiment.shutdown import RESUME_ME

# Status of a process whose work another one is doing; EX_UNAVAILABLE, which Windows lacks.
TAKEN = 69
POLL_SECONDS = 0.1
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
_STOPPING = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
GRACE_SECONDS = 10.0
_LAST_LINES = 15
# As much space as a few files of a tiny run.
_ROOM = 65_536


@dataclass
class Job:
    """A process to start.

    Attributes:
        name: name for messages.
        command: the command line.
        log: file to which its output is appended.
        held: whether a foreign process is doing the same work now.
        done: called once it has succeeded; the jobs that it returns are started next. It may raise
            :class:`Unfinished`.
    """

    name: str
    command: Sequence[str]
    log: Path
    held: Callable[[], bool]
    done: Callable[[], Iterable[Job]]


class Unfinished(Exception):
    """A process has succeeded, but its work is not done; the message says what is wrong."""


@dataclass
class Failure:
    """A failed job.

    Attributes:
        job: the job.
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
        """Why the log may lack the reason; empty if there was space for it."""
        probe = self.job.log.with_name(f"{self.job.log.name}.room")
        try:
            refuse_link(probe)
            write_atomically(probe, bytes(_ROOM))
            probe.unlink()
        except (OSError, RunDirectoryError) as error:
            # The probe is gone; it is the log that has no space.
            return message(error).replace(str(probe), str(self.job.log))
        return ""


class Stopped(Exception):
    """The campaign was told to stop; all its processes have ended."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signal_number).name}")
        self.signal_number = signal_number


class Workers:
    """Runs jobs, ``count`` at a time, in the calling thread.

    A process that ends with the status ``TAKEN`` has found another one doing its work; it is
    started again once that one has ended.

    Each process has one thread and its own session, so that Ctrl-C reaches only the campaign,
    which then ends the processes. The calling thread must be the main one: on Linux, the system
    ends processes together with the thread that started them.

    Args:
        count: number of parallel processes.
        on_tick: called repeatedly with the running jobs.
        on_wait: called once with each job that waits for a foreign process.
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
        """Run all jobs and those that follow from them.

        Returns:
            the failed jobs; the others continued.

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
                # Not even its log can be opened; those of others may.
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
            if status == TAKEN:
                self._queue.append(job)
            elif status == RESUME_ME:
                self._failures.append(Failure(job, "has made room, as it was asked"))
            elif status != 0:
                how = f"signal {-status}" if status < 0 else f"status {status}"
                self._failures.append(Failure(job, f"ended with {how}"))
            else:
                try:
                    self._queue.extendleft(reversed(list(job.done())))
                except Unfinished as error:
                    self._failures.append(Failure(job, f"succeeded, but {error}"))

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
            # Ignored signals, as under nohup, stay ignored.
            if signal.getsignal(number) is not signal.SIG_IGN
        }
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _end(process: subprocess.Popen[bytes], at_once: bool = False) -> None:
    if os.name == "nt":  # this system has no sessions
        process.kill()
        return
    # The session outlives a leader with children; it is gone once all processes are.
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL if at_once else signal.SIGTERM)


def available_cores() -> int:
    """CPU cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    return len(affinity(0)) if affinity else os.cpu_count() or 1
