"""Writing files in one step: whole or not at all, and never through somebody's link."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

# Links are followed where a system lacks this, as Windows does, where few may make any.
NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)


def write_atomically(file: Path, content: str | bytes, keep: Path | None = None) -> None:
    """Replace a file in one step.

    The target, and what an earlier attempt may have left beside it, are replaced where they are
    links: nothing is written through them.

    Args:
        file: the file.
        content: all of it; text as UTF-8, with the bytes of paths escaped that are none.
        keep: where the file stays that is replaced; there is one or the other at any moment.

    Raises:
        OSError: with the name of the file, which is as it was.
    """
    temporary = file.with_name(file.name + ".tmp")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | NO_FOLLOW | getattr(os, "O_BINARY", 0)
    try:
        temporary.unlink(missing_ok=True)
        with os.fdopen(os.open(temporary, flags, 0o666), "wb") as handle:
            handle.write(content if isinstance(content, bytes) else _utf8(content))
            handle.flush()
            os.fsync(handle.fileno())
        if keep is not None and file.exists():
            keep_file(file, keep)
        os.replace(temporary, file)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise type(error)(error.errno, error.strerror, str(file)) from error


def _utf8(text: str) -> bytes:
    return text.encode(errors="backslashreplace")


def write_through(file: Path, write: Callable[[io.BytesIO], object]) -> None:
    """Replace a file in one step by what a function writes to an open one.

    Args:
        file: the file.
        write: such as ``lambda buffer: figure.savefig(buffer, format="png")``.

    Raises:
        OSError: as :func:`write_atomically`.
    """
    buffer = io.BytesIO()
    write(buffer)
    write_atomically(file, buffer.getvalue())


def keep_file(file: Path, at: Path, moved: bool = True) -> None:
    """Let a file stay at another place too; it takes no room where there are hard links.

    Args:
        file: what is only ever replaced as a whole.
        at: the other place; what is there is replaced in one step.
        moved: whether the file may be gone afterwards where there are no hard links.
    """
    second = at.with_name(at.name + ".tmp")
    second.unlink(missing_ok=True)
    try:
        os.link(file, second)
    except OSError:
        if moved:
            os.replace(file, at)
        else:
            write_atomically(at, file.read_bytes())
    else:
        os.replace(second, at)
