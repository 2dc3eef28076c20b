"""Files: replaced atomically, locked, with names of bounded length, never written through links."""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
import yaml  # type: ignore[import-untyped]
from filelock import lock_descriptor, unlock_descriptor
from omegaconf import OmegaConf

from torchrl_l1.atomic import NO_FOLLOW, keep_file, write_atomically
from torchrl_l1.experiment.errors import RunDirectoryError

LONGEST_NAME = 120
"""Longest name made from settings, in characters; file systems take 255 bytes, some 143."""

# File systems allow names of this length, so that directories of older runs keep theirs.
_LONGEST_OVERRIDES = 230
_DIGEST = 10

# A recipe has a few hundred entries; aliases may expand a small file beyond memory.
_MOST_YAML_BYTES, _MOST_YAML_ENTRIES = 500_000, 50_000


def digest(text: str | bytes, length: int = 16) -> str:
    """The first hexadecimal digits of a text's SHA-256."""
    content = text.encode() if isinstance(text, str) else text
    return hashlib.sha256(content).hexdigest()[:length]


def bounded(name: str, longest: int = LONGEST_NAME) -> str:
    """A name that file systems accept: one that is too long is cut and ends in its digest.

    Examples:
        >>> bounded("by_label_half_cheetah")
        'by_label_half_cheetah'
        >>> bounded("by_" + 100 * "key_", longest=24)
        'by_key_key_ke_f5d1892ed6'
    """
    if len(name.encode()) <= longest:
        return name
    kept = name.encode()[: longest - _DIGEST - 1].decode(errors="ignore")
    return f"{kept}_{digest(name, _DIGEST)}"


def path_text(text: str) -> str:
    """A text as one part of a path: separators of folders become underscores.

    Examples:
        >>> path_text("task=gymnasium/Reacher-v5")
        'task=gymnasium_Reacher-v5'
    """
    return re.sub(r"[/\\:]", "_", text)


def bounded_overrides(dirname: str) -> str:
    """Hydra's name for a list of overrides; if too long, its shortest ones and a digest.

    Paths in it only lead down: ``..`` would remove what precedes it in the name.

    Examples:
        >>> bounded_overrides("l1=off,noise=action")
        'l1=off,noise=action'
        >>> bounded_overrides("cem.horizon=5,dataset=../../data/mine.npz")
        'cem.horizon=5,dataset=../__/data/mine.npz'
    """
    dirname = re.sub(r"/\.\.(?=/|$)", "/__", dirname)
    parts = [
        path_text(part) if part.startswith("task=") else part
        for part in re.split(r",(?=[\w+~][\w.@/+~-]*=)", dirname)
    ]
    if len(dirname.encode()) <= _LONGEST_OVERRIDES:
        return ",".join(parts)
    kept: set[int] = set()
    length = 0
    for index in sorted(range(len(parts)), key=lambda index: len(parts[index])):
        length += len(parts[index].encode()) + 1
        if length > LONGEST_NAME - _DIGEST:
            break
        kept.add(index)
    shown = [part for index, part in enumerate(parts) if index in kept]
    return ",".join([*shown, digest(dirname, _DIGEST)])


def refuse_link(path: Path) -> None:
    """Make sure that a file or folder of a run directory is not a symbolic link.

    Raises:
        RunDirectoryError: if it is one: files elsewhere would be written or deleted.
    """
    if path.is_symlink():
        raise RunDirectoryError(
            f"{path} is a symbolic link, which is not followed for writing; remove the link"
        )


def make_folder(folder: Path) -> None:
    """Make a folder and check, before hours of work, that results can be written to it.

    Raises:
        OSError: with the name of the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    probe = folder / ".writable"
    try:
        write_atomically(probe, "")
        probe.unlink(missing_ok=True)  # another process may have done so
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(folder)) from error


def make_place(file: Path) -> None:
    """Make the folder of a file to be written at the end, and check that it can be written.

    Raises:
        OSError: with the name of the obstacle.
    """
    if file.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(file))
    make_folder(file.parent)


@contextmanager
def locked(file: Path, mode: str = "a") -> Iterator[bool]:
    """Lock a file for the duration of the block, unless another process has locked it.

    The lock belongs to this process, not to its children, and the system releases it when the
    process ends, in whatever way.

    Args:
        file: the file; its contents do not matter.
        mode: the mode in which it is opened; by default it is created if missing.

    Yields:
        whether this process holds the lock.

    Raises:
        RunDirectoryError: if the file is a link or not a regular file.
        OSError: with the name of the file, also where the file system has no locks.
    """
    refuse_link(file)
    if file.exists() and not file.is_file():
        raise RunDirectoryError(f"{file} is in the way of a file; remove it")

    def opener(path: str, flags: int) -> int:
        return os.open(path, flags | NO_FOLLOW, 0o666)

    with open(file, mode, encoding="utf-8", opener=opener) as handle:
        try:
            ours = lock_descriptor(handle.fileno(), blocking=False)
        except OSError as error:
            raise type(error)(error.errno, error.strerror, str(file)) from error
        try:
            yield ours
        finally:
            if ours:
                unlock_descriptor(handle.fileno())


def table_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table as CSV; columns in order of first appearance."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_table(file: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a whole CSV atomically; columns in order of first appearance."""
    write_atomically(file, table_text(rows))


def copy_in_place(file: Path, at: Path) -> None:
    """Copy a file that is only ever replaced as a whole, by a hard link where possible.

    Raises:
        RunDirectoryError: if the copy's folder is a link.
        OSError: with the name of the copy.
    """
    refuse_link(at.parent)
    try:
        if at.exists() and os.path.samefile(file, at):
            return
        at.parent.mkdir(exist_ok=True)
        keep_file(file, at, moved=False)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(at)) from error


def saved(state: object) -> bytes:
    """The bytes that ``torch.save`` writes for an object."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def read_text(file: Path, most_bytes: int | None = None) -> str:
    """The text of a regular file: reading a pipe in its place would block forever.

    Raises:
        ValueError: if it is not a regular file, is too long, or is not UTF-8.
        OSError: if it cannot be read.
    """
    if not file.is_file():
        if not file.exists():
            raise FileNotFoundError(2, "No such file or directory", str(file))
        raise ValueError(f"{file} is not a regular file")
    if most_bytes is not None and file.stat().st_size > most_bytes:
        raise ValueError(f"{file} is longer than {most_bytes} bytes")
    return file.read_text(encoding="utf-8")


def yaml_text(file: Path) -> str:
    """The text of a YAML file that is small even after its aliases are expanded.

    Raises:
        ValueError: if it is not small or not YAML.
        OSError: if it cannot be read.
    """
    text = read_text(file, _MOST_YAML_BYTES)
    if "*" in text and "&" in text:
        try:
            if _entries(yaml.compose(text, yaml.SafeLoader), {}) > _MOST_YAML_ENTRIES:
                raise ValueError(f"{file} has aliases that expand it too far; remove them")
        except (yaml.YAMLError, RecursionError) as error:
            raise ValueError(f"{file} is not valid YAML: {problem(error)}") from error
    return text


class _PlainLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads numbers and words as OmegaConf does; with libyaml, in a tenth of the time."""


# YAML 1.1 would read 1e-3 as a string, and dates as dates.
_PlainLoader.yaml_implicit_resolvers = {
    letter: [entry for entry in entries if not entry[0].endswith(":timestamp")]
    for letter, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?\d+(_\d+)*(\.[\d_]*)?[eE][-+]?\d+$|\.\d+(_\d+)*([eE][-+]\d+)?$", re.ASCII),
    list("-+0123456789."),
)
# OmegaConf judges references, tags and interpolations; libyaml does not limit nesting.
_NOT_PLAIN = re.compile(r"[&*!\r\x85\u2028\u2029]|\$\{|^[ \t?:-]{60}|^---|^\.\.\.|^%", re.MULTILINE)
_MOST_BRACKETS = 200


def settings_content(file: Path) -> Any:
    """The content of a YAML file of settings, with unresolved interpolations.

    Raises:
        Exception: of many kinds, if it cannot be read or OmegaConf would not accept it.
    """
    text = yaml_text(file)
    if not _NOT_PLAIN.search(text) and text.count("[") + text.count("{") < _MOST_BRACKETS:
        # Let the one with the best message report what is wrong.
        with suppress(yaml.YAMLError, ValueError):
            node = yaml.compose(text, _PlainLoader)
            if _is_plain(node):
                return yaml.constructor.SafeConstructor().construct_document(node)
    return OmegaConf.to_container(OmegaConf.create(text))


def _is_plain(node: Any) -> bool:
    """Whether all keys in a mapping and in those nested in it are strings without duplicates."""
    if isinstance(node, yaml.SequenceNode):
        return all(isinstance(one, yaml.ScalarNode) or _is_plain(one) for one in node.value)
    if not isinstance(node, yaml.MappingNode):
        return False
    keys = [key.value for key, _ in node.value if key.tag == "tag:yaml.org,2002:str"]
    values = (value for _, value in node.value if not isinstance(value, yaml.ScalarNode))
    return len(node.value) == len(keys) == len(set(map(str, keys))) and all(map(_is_plain, values))


def problem(error: BaseException) -> str:
    """What is wrong with a YAML text, in one line."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    mark = getattr(error, "problem_mark", None)
    words = getattr(error, "problem", None) or str(error)
    place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark is not None else ""
    return place + " ".join(str(words).split())


def _entries(node: Any, known: dict[int, int]) -> int:
    """Number of nodes below one, counting each as often as it is referenced."""
    if id(node) not in known:
        known[id(node)] = (
            _MOST_YAML_ENTRIES + 1
        )  # met again while being counted: it contains itself
        parts: list[Any] = []
        if isinstance(node, yaml.SequenceNode):
            parts = node.value
        elif isinstance(node, yaml.MappingNode):
            parts = [part for pair in node.value for part in pair]
        known[id(node)] = 1 + sum(_entries(part, known) for part in parts)
    return known[id(node)]
