"""Names of objects that users supply: ``MODULE:NAME`` and ``FILE.py:NAME``."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import import_module, invalidate_caches
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium


def require(module: str, extra: str) -> ModuleType:
    """Import an optional package.

    Raises:
        ValueError: if it is not installed, naming the extra that provides it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ValueError(
            f"{module} cannot be imported ({error}): pip install 'torchrl-l1[{extra}]'"
        ) from None


@contextmanager
def making(name: str) -> Iterator[None]:
    """Report in one line that a package is missing that Gymnasium needs for an environment.

    Raises:
        ValueError: with the name of the environment and Gymnasium's message.
    """
    try:
        yield
    except (gymnasium.error.Error, ImportError) as error:
        raise ValueError(f"{name}: {' '.join(str(error).split())}") from error


def load_attribute(name: str, search_path: Sequence[str | Path] = ()) -> Any:
    """The object that ``MODULE:NAME`` or ``FILE.py:NAME`` names.

    Args:
        name: such as ``my_package.envs:make_env`` or ``envs.py:make_env``.
        search_path: folders in which to look for files, and for modules that are not on Python's
            own path; the working directory comes after them.

    Raises:
        ValueError: if it does not exist.

    Examples:
        >>> load_attribute("math:hypot")(3, 4)
        5.0
    """
    module, _, attribute = name.rpartition(":")
    found = find_attribute(name, search_path)
    if found is None:
        raise ValueError(f"{module} has no {attribute!r}")
    return found


def find_attribute(name: str, search_path: Sequence[str | Path] = ()) -> Any:
    """As :func:`load_attribute`; ``None`` if the module exists, but not the name in it."""
    module, _, attribute = name.rpartition(":")
    return getattr(load_module(module, search_path), attribute, None)


def load_module(name: str, search_path: Sequence[str | Path] = ()) -> ModuleType:
    """A module, by its name or file.

    Raises:
        ValueError: if it does not exist, or cannot be imported.
    """
    if name.endswith(".py"):
        file = next((place for place in _places(name, search_path) if place.is_file()), None)
        if file is None:
            where = ", ".join(
                dict.fromkeys(str(place.parent) for place in _places(name, search_path))
            )
            raise ValueError(f"there is no file {name} (looked for in {where})")
        return _of_file(file.resolve(), file.stat().st_mtime_ns)
    _extend_path(name.partition(".")[0], search_path)
    try:
        return import_module(name)
    except (ImportError, TypeError, ValueError) as error:
        raise ValueError(f"there is no module {name!r} ({error})") from None
    except Exception as error:
        raise ValueError(_broken(name, error)) from error


def folders_of(names: Iterable[str], folders: Iterable[Path]) -> list[str]:
    """The folders that contain what one of these names begins with.

    A name that begins with a package on Python's own path needs no folder.

    Args:
        names: such as ``envs.py:make_env``, ``my_package:MyEnv-v0`` or ``gymnasium/Reacher-v5``.
        folders: where to look.
    """
    found = []
    for folder in dict.fromkeys(folder.resolve() for folder in folders):
        for name in names:
            module = name.removeprefix("gymnasium/").rpartition(":")[0]
            if module.endswith(".py"):
                there = not Path(module).is_absolute() and (folder / module).is_file()
            else:
                there = bool(module) and _holds(folder, module.partition(".")[0])
            if there and str(folder) not in found:
                found.append(str(folder))
    return found


def same_code(names: Iterable[str], one: Sequence[str | Path], other: Sequence[str | Path]) -> bool:
    """Whether names mean the same on two search paths, as far as their files can be found.

    Args:
        names: such as ``envs.py:make_env`` or ``my_package:MyEnv-v0``.
        one: a search path.
        other: another one.
    """
    for name in names if list(one) != list(other) else ():
        found = [_file_of(name.rpartition(":")[0], folders) for folders in (one, other)]
        if None not in found and len({file.read_bytes() for file in found if file}) > 1:
            return False
    return True


def code_digests(names: Iterable[str], folders: Sequence[str | Path]) -> dict[str, str]:
    """Digests of the files and modules with which names begin, as far as they can be found.

    Args:
        names: such as ``envs.py:make_env`` or ``my_package:MyEnv-v0``.
        folders: where to look; the working directory comes after them.
    """
    found = {}
    for module in dict.fromkeys(name.rpartition(":")[0] for name in names):
        file = _file_of(module, (*folders, Path.cwd()))
        if file is not None:
            found[module] = file_digest(file)
    return found


def file_digest(file: Path) -> str:
    """The first digits of a file's SHA-256; read again if its time or size has changed."""
    about = file.stat()
    return _digest(file.resolve(), about.st_mtime_ns, about.st_size)


@cache
def _digest(file: Path, changed: int, size: int) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()[:16]


def _file_of(module: str, folders: Sequence[str | Path]) -> Path | None:
    """The first file of a module or of this name in the given folders."""
    name = module if module.endswith(".py") else module.replace(".", "/")
    endings = ("",) if module.endswith(".py") else (".py", "/__init__.py")
    places = (Path(folder, name + ending) for folder in folders for ending in endings if module)
    return next((place for place in places if place.is_file()), None)


def _places(name: str, search_path: Sequence[str | Path]) -> list[Path]:
    return [Path(folder, name) for folder in (*search_path, Path.cwd())]


def _extend_path(package: str, search_path: Sequence[str | Path]) -> None:
    """Let Python find a package that only the search path has, now and in later imports."""
    if package in sys.modules:
        return
    invalidate_caches()
    try:
        if importlib.util.find_spec(package) is not None:
            return
    except (ImportError, ValueError):
        return
    for folder in (*map(Path, search_path), Path.cwd()):
        if _holds(folder, package):
            sys.path.append(str(folder.resolve()))
            return


def _holds(folder: Path, package: str) -> bool:
    return (folder / f"{package}.py").is_file() or (folder / package).is_dir()


@cache
def _of_file(file: Path, changed: int) -> ModuleType:
    """Loaded once, and again after it has changed."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # As in an import: code in the file may look up its own module.
    is_ours = sys.modules.setdefault(file.stem, module) is module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        if is_ours:
            sys.modules.pop(file.stem, None)
        raise ValueError(_broken(str(file), error)) from error
    return module


def _broken(name: str, error: Exception) -> str:
    said = f"{type(error).__name__}: {error}"
    return f"{name} cannot be imported ({' '.join(said.split())})"
