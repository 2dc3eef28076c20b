"""Writing files in one step: whole or not at all, and never through somebody's link."""

from __future__ import annotations

import io
import os
import secrets
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

# Links are followed where a system lacks this, as Windows does, where few may make any.
NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)

TEMPORARY = f"*.{8 * '[0-9a-f]'}.tmp"
"""Pattern of the names under which files are written before they replace others."""


def write_atomically(file: Path, content: str | bytes, keep: Path | None = None) -> None:
    """Replace a file in one step.

    A link in its place is replaced: nothing is written through it. Several processes may write the
    file at once; it is that of the last.

    Args:
        file: the file.
        content: all of it; text as UTF-8, with the bytes of paths escaped that are none.
        keep: where the file stays that is replaced; there is one or the other at any moment.

    Raises:
        OSError: with the name of the file, which is as it was.
    """
    temporary = _beside(file)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | NO_FOLLOW | getattr(os, "O_BINARY", 0)
    try:
        with os.fdopen(os.open(temporary, flags, 0o666), "wb") as handle:
            handle.write(content if isinstance(content, bytes) else _utf8(content))
            handle.flush()
            os.fsync(handle.fileno())
        if keep is not None and file.exists():
            keep_file(file, keep)
        os.replace(temporary, file)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(file)) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _beside(file: Path) -> Path:
    """A name beside a file that no other process uses, not even one of another machine."""
    return file.with_name(f"{file.name}.{secrets.token_hex(4)}.tmp")


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
    second = _beside(at)
    try:
        os.link(file, second)
    except OSError:
        if moved:
            os.replace(file, at)
        else:
            write_atomically(at, file.read_bytes())
    else:
        try:
            os.replace(second, at)
        finally:  # it is still there where both were the same file
            second.unlink(missing_ok=True)
