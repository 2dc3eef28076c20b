"""Files: replaced in one step, locked, named within bounds, and never through somebody's link."""

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
"""Characters of a name that is made from settings; file systems take 255 bytes, some 143."""

# File systems take these, so the directories of older runs are found again.
_LONGEST_OVERRIDES = 230
_DIGEST = 10

# A recipe has a few hundred entries; what aliases make of a small file may not fit into memory.
_MOST_YAML_BYTES, _MOST_YAML_ENTRIES = 500_000, 50_000


def digest(text: str | bytes, length: int = 16) -> str:
    """The first hexadecimal digits of a text's SHA-256."""
    content = text.encode() if isinstance(text, str) else text
    return hashlib.sha256(content).hexdigest()[:length]


def bounded(name: str, longest: int = LONGEST_NAME) -> str:
    """A name that a file system takes: one that is too long is cut and ends in its digest.

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
    """A text as a part of a path: what separates folders becomes an underscore.

    Examples:
        >>> path_text("task=gymnasium/Reacher-v5")
        'task=gymnasium_Reacher-v5'
    """
    return re.sub(r"[/\\:]", "_", text)


def bounded_overrides(dirname: str) -> str:
    """Hydra's name for a list of overrides, with the shortest of them and a digest if it is long.

    A path among them leads down only: ``..`` would take away what stands before it in the name.

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
        RunDirectoryError: if it is one: what would be written or deleted lies elsewhere.
    """
    if path.is_symlink():
        raise RunDirectoryError(
            f"{path} is a symbolic link, which is not followed for writing; remove the link"
        )


def make_folder(folder: Path) -> None:
    """Make a folder, and find out before hours of work whether results can be written to it.

    Raises:
        OSError: with the name of the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    probe = folder / ".writable"
    try:
        write_atomically(probe, "")
        probe.unlink()
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(folder)) from error


def make_place(file: Path) -> None:
    """Make the folder of a file that work will end with, and find out whether it can be written.

    Raises:
        OSError: with the name of what is in the way.
    """
    if file.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(file))
    make_folder(file.parent)


@contextmanager
def locked(file: Path, mode: str = "a") -> Iterator[bool]:
    """Lock a file for as long as the block lasts, or say that another process has.

    The lock is this process's, not its children's, and the system frees it when the process ends,
    however it does.

    Args:
        file: the file; what is in it does not matter.
        mode: how it is opened; by default it is made where there is none.

    Yields:
        whether the lock is ours.

    Raises:
        RunDirectoryError: if the file is a link, or something that is no file.
    """
    refuse_link(file)
    if file.exists() and not file.is_file():
        raise RunDirectoryError(f"{file} is in the way of a file; remove it")

    def opener(path: str, flags: int) -> int:
        return os.open(path, flags | NO_FOLLOW, 0o666)

    with open(file, mode, encoding="utf-8", opener=opener) as handle:
        ours = lock_descriptor(handle.fileno(), blocking=False)
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
    """Make a copy of a file that is replaced as a whole and never changed; it takes no room.

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
    """What ``torch.save`` writes of something."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def read_text(file: Path, most_bytes: int | None = None) -> str:
    """The text of a regular file: a pipe in its place would be waited for for ever.

    Raises:
        ValueError: if it is no regular file, too long, or no UTF-8.
        OSError: if it cannot be read.
    """
    if not file.is_file():
        if not file.exists():
            raise FileNotFoundError(2, "No such file or directory", str(file))
        raise ValueError(f"{file} is no file")
    if most_bytes is not None and file.stat().st_size > most_bytes:
        raise ValueError(f"{file} is longer than {most_bytes} bytes")
    return file.read_text(encoding="utf-8")


def yaml_text(file: Path) -> str:
    """The text of a YAML file that is small, whatever its aliases make of it.

    Raises:
        ValueError: if it is not, or no YAML.
        OSError: if it cannot be read.
    """
    text = read_text(file, _MOST_YAML_BYTES)
    if "*" in text and "&" in text:
        try:
            if _entries(yaml.compose(text, yaml.SafeLoader), {}) > _MOST_YAML_ENTRIES:
                raise ValueError(f"{file} has aliases that make it too large")
        except (yaml.YAMLError, RecursionError) as error:
            raise ValueError(f"{file} is not valid YAML: {problem(error)}") from error
    return text


class _PlainLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads numbers and words as OmegaConf does, where libyaml is there in a tenth of the time."""


# YAML 1.1 takes 1e-3 for a word, and dates for dates.
_PlainLoader.yaml_implicit_resolvers = {
    letter: [entry for entry in entries if not entry[0].endswith(":timestamp")]
    for letter, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?\d+(_\d+)*(\.[\d_]*)?[eE][-+]?\d+$|\.\d+(_\d+)*([eE][-+]\d+)?$", re.ASCII),
    list("-+0123456789."),
)
# References, tags and interpolations are OmegaConf's to judge; libyaml's nesting has no bounds.
_NOT_PLAIN = re.compile(r"[&*!\r\x85\u2028\u2029]|\$\{|^[ \t?:-]{60}|^---|^\.\.\.|^%", re.MULTILINE)
_MOST_BRACKETS = 200


def settings_content(file: Path) -> Any:
    """The content of a YAML file of settings, interpolations as they are written.

    Raises:
        Exception: of many kinds, if it cannot be read or is nothing that OmegaConf would take.
    """
    text = yaml_text(file)
    if not _NOT_PLAIN.search(text) and text.count("[") + text.count("{") < _MOST_BRACKETS:
        # What is wrong is told by the one that says it best.
        with suppress(yaml.YAMLError, ValueError):
            node = yaml.compose(text, _PlainLoader)
            if _is_plain(node):
                return yaml.constructor.SafeConstructor().construct_document(node)
    return OmegaConf.to_container(OmegaConf.create(text))


def _is_plain(node: Any) -> bool:
    """Whether all keys in a mapping, and in those below it, are words, each once."""
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
    """Nodes below one, each as often as it is named."""
    if id(node) not in known:
        known[id(node)] = _MOST_YAML_ENTRIES + 1  # while it is counted: it is part of itself
        parts: list[Any] = []
        if isinstance(node, yaml.SequenceNode):
            parts = node.value
        elif isinstance(node, yaml.MappingNode):
            parts = [part for pair in node.value for part in pair]
        known[id(node)] = 1 + sum(_entries(part, known) for part in parts)
    return known[id(node)]
