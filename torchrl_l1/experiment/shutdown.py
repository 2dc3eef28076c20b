"""Ending a process on a signal: a line, an orderly exit, and a status that says what to do."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

RESUME_ME = 75
"""Exit status of a run asked to make room: it has saved its work; start it with --resume."""

_ENDING = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
_WARNING = [getattr(signal, n) for n in ("SIGUSR1",) if hasattr(signal, n)]

_asked = False


def asked_to_make_room() -> bool:
    """Whether SIGUSR1 has arrived, which schedulers send before they end a job."""
    return _asked


@contextmanager
def orderly_end() -> Iterator[None]:
    """Exit in an orderly way on signals during the block.

    SIGINT, SIGTERM and SIGHUP write a line and raise ``SystemExit`` with 128 plus their number, so
    that loggers are closed; a second one ends the process at once. After SIGUSR1 the outer
    iteration is finished first, see :func:`asked_to_make_room`. Threads other than the main one
    receive no signals: nothing changes there.
    """
    global _asked
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        for each in _ENDING:
            if signal.getsignal(each) is not signal.SIG_IGN:
                signal.signal(each, signal.SIG_DFL)
        _say(f"torchrl-l1: stopped by {signal.Signals(number).name}")
        raise SystemExit(128 + number)

    def note(number: int, frame: FrameType | None) -> None:
        global _asked
        _asked = True
        _say("torchrl-l1: asked to make room; the outer iteration is finished and saved first")

    _asked = False
    handlers = {**dict.fromkeys(_ENDING, end), **dict.fromkeys(_WARNING, note)}
    before = {
        number: signal.signal(number, handler)
        for number, handler in handlers.items()
        # Ignored signals, as under nohup, stay ignored.
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        # The signal's request has been met, or can no longer be met.
        _asked = False
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _say(line: str) -> None:
    if sys.stderr is None:
        return
    # A full disk or a closed terminal costs the line, not the orderly end.
    with suppress(OSError, ValueError):
        if sys.stderr is sys.__stderr__:
            # The signal may have come while something else was being written through it.
            os.write(2, f"{line}\n".encode())
        else:
            print(line, file=sys.stderr)
