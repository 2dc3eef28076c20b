"""What a process runs that was forked from one with the package loaded, as ``python -m`` would.

Loading the package takes seconds of CPU, a fork none. A campaign that runs here forks the processes
of its workers in turn. Of a process started anew they keep all that counts: an id, a parent, a
session, signals, standard streams and the end.
"""

from __future__ import annotations

import gc
import os
import runpy
import signal
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import SimpleNamespace
from typing import IO, Any, ClassVar


class Fork:
    """As much of ``subprocess.Popen`` as the workers of a campaign use.

    Attributes:
        kept: file descriptors that are not closed in the child, those of the fork server.
    """

    kept: ClassVar[set[int]] = set()

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        module, arguments, stdout, env = asked_for(command, **options)
        self.status: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            os.setsid()
            os.environ.update(env)
            _write_to(stdout.fileno())
            # What a new program does not get from its parent: handlers, files, locks.
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            for descriptor in open_descriptors() - Fork.kept:
                with suppress(OSError):
                    os.close(descriptor)
            os._exit(status_of(module, arguments))

    def poll(self) -> int | None:
        if self.status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.status = os.waitstatus_to_exitcode(status) if pid else None
        return self.status

    def wait(self, timeout: float | None = None) -> int:
        if self.status is None:
            _, status = os.waitpid(self.pid, 0)
            self.status = os.waitstatus_to_exitcode(status)
        return self.status


def asked_for(
    command: Sequence[str],
    *,
    stdin: int,
    stdout: IO[bytes],
    stderr: int,
    env: Mapping[str, str],
    start_new_session: bool,
) -> tuple[str, list[str], IO[bytes], Mapping[str, str]]:
    """Module, arguments, output and environment of what a campaign asks ``Popen`` for."""
    interpreter, option, module, *arguments = command
    assert (interpreter, option) == (sys.executable, "-m")
    assert (stdin, stderr) == (subprocess.DEVNULL, subprocess.STDOUT) and start_new_session
    return module, arguments, stdout, env


def open_descriptors() -> set[int]:
    return {int(name) for name in os.listdir("/proc/self/fd")}


def status_of(module: str, arguments: Sequence[str]) -> int:
    """Run a module to its end, and say with which status its process would end."""
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        print(end.code, file=sys.stderr)
        return 1
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


Place = tuple[str, list[str], bool]


def main(module: str, arguments: Sequence[str], output: str, place: Place | None = None) -> None:
    """Run a module, with its standard output and error in a file.

    Args:
        module: its name.
        arguments: of the command line.
        output: the file.
        place: the folder, what Python searches, and whether it is the worker of a campaign in
            another process: then it has a session of its own, and its parent is not the campaign.
    """
    import torch

    from torchrl_l1.campaign import workers

    gc.freeze()  # else a collection would copy every page of what is loaded
    torch.set_num_threads(1)
    if place is not None:
        folder, sys.path[:], worker = place
        os.chdir(folder)
        if worker:
            os.setsid()
            arguments = [str(os.getppid()), *arguments[1:]]
    workers.subprocess = SimpleNamespace(
        Popen=Fork,
        DEVNULL=subprocess.DEVNULL,
        STDOUT=subprocess.STDOUT,
        TimeoutExpired=subprocess.TimeoutExpired,
    )
    Fork.kept = open_descriptors()
    _write_to(os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND))
    sys.exit(status_of(module, arguments))


def _write_to(descriptor: int) -> None:
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)


if __name__ == "__main__":
    main(*REQUEST)  # type: ignore[name-defined]  # noqa: F821
