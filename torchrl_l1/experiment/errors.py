"""Errors caused by the request: reported in one line, without a traceback."""

from __future__ import annotations

import errno
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.errors import HydraException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException


class RecipeError(Exception):
    """A recipe does not exist or cannot be used; the message says why and what to do."""


class RunDirectoryError(Exception):
    """The run directory cannot be used as requested; the message says why and what to do."""


class RunDirectoryInUse(RunDirectoryError):
    """Another process is running in the run directory."""


@contextmanager
def fitting_into_memory(what: str) -> Iterator[None]:
    """Report in one line what is too large for this machine, as sizes in a file may be.

    Raises:
        ValueError: if memory cannot be allocated in the block.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
            raise
        raise ValueError(
            f"{what} does not fit into the memory of this machine; reduce the sizes of its "
            "networks and data (model.hidden, model.members, policy.hidden, horizon, episodes)"
        ) from error


USER_ERRORS = (
    HydraException,
    KeyError,
    OSError,
    OverflowError,
    OmegaConfBaseException,
    RecipeError,
    RunDirectoryError,
    ValueError,
)

_SPACE = "free some space; nothing is lost, and the same command continues"
_LOCKS = "this file system has no locks; choose another one, or have it mounted with flock"
_REMEDIES = {
    errno.ENOSYS: _LOCKS,
    errno.ENOLCK: _LOCKS,
    errno.EOPNOTSUPP: _LOCKS,
    errno.ENOSPC: _SPACE,
    errno.EDQUOT: _SPACE,
    errno.EROFS: "choose a place that can be written to",
    errno.EACCES: "change its permissions, or choose another place",
    errno.EPERM: "change its permissions, or choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EISDIR: "a folder is in the way of a file; move it away",
    errno.ENOTDIR: "a file is in the way of a folder; move it away",
    errno.EEXIST: "something is in the way; move it away",
    errno.ENOTEMPTY: "something is in the way; move it away",
    errno.ELOOP: "a symbolic link is in the way; remove it",
    errno.EMFILE: "too many files are open; raise the limit (ulimit -n)",
    errno.EFBIG: "raise the limit on file sizes (ulimit -f), and the same command continues",
    errno.EIO: "the disk is failing; choose another place",
}
_LONGEST = 2000


def message(error: BaseException) -> str:
    """The error's own message in one line, with a remedy if the system has refused something."""
    if isinstance(error, BrokenPipeError):
        return "the reader of the output has exited"
    if isinstance(error, OSError) and error.errno is not None:
        remedy = _REMEDIES.get(error.errno)
        where = f"{error.filename}: " if error.filename else ""
        return where + (error.strerror or str(error)) + (f"; {remedy}" if remedy else "")
    # ``KeyError`` would quote its message like a key.
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    cause = error.__cause__
    if isinstance(error, OverrideParseException):
        text = _of_override(text, str(error.override))
    elif isinstance(error, HydraException):
        text = _of_hydra(text, str(cause) if isinstance(cause, OmegaConfBaseException) else "")
    elif isinstance(error, OmegaConfBaseException):
        text = _of_hydra(text, "")
    line = " ".join(text.split()) or type(error).__name__
    return line if len(line) <= _LONGEST else line[:_LONGEST] + " ..."


def typed_override(key: str, value: str) -> str:
    """An override as typed in a shell, whatever characters the value has.

    Examples:
        >>> print(typed_override("run_dir", "runs/l1=off"))
        'run_dir="runs/l1=off"'
    """
    escaped = value.replace('"', '\\"')
    return shlex.quote(f'{key}="{escaped}"')


def _of_override(text: str, override: str) -> str:
    """Hydra's message with the override that it refers to, without the link to its grammar."""
    if "=" not in override:
        return f"{override!r} is not an override: write KEY=VALUE, such as seed=3"
    text = re.split(r"\s*See https://hydra", text)[0]
    where = "" if override in text else f"{override}: "
    key, _, value = override.partition("=")
    # Run directories are named after overrides, so paths often contain "=".
    word = typed_override(key, value)
    remedy = f"; quote a value with such characters: {word}" if value else ""
    return f"{where}{text}{remedy}"


def _of_hydra(text: str, cause: str) -> str:
    """Hydra's message without its search path and its advice to add keys that no schema knows."""
    unknown = re.search(r"Key '(\w+)' (?:is )?not in (?:struct|'\w+')", f"{text}\n{cause}")
    place = re.search(r"full_key: (\S+)", f"{text}\n{cause}")
    if unknown:
        return f"there is no key {(place or unknown)[1]!r}; --cfg job shows the existing ones"
    text = re.split(r"\n\s*Config search path:", text)[0]
    cause = re.split(r"\n\s*full_key:", cause)[0]
    lines = [line.strip() for line in text.splitlines()]
    kept = [
        line
        for line in lines
        if line and not line.startswith(("To append", "full_key: ", "object_type="))
    ]
    kept += ["(write it as a list, [a,b])"] if "is not a ListConfig" in f"{text}{cause}" else []
    where = f"{place[1]}: " if place and place[1] not in " ".join([*kept, cause]) else ""
    return where + " ".join([*kept, cause])
