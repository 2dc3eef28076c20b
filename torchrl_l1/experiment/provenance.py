"""Provenance of a run: packages, commit, settings, and the user's own code and data."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torchrl_l1
from torchrl_l1.envs import code_digests, file_digest, same_code
from torchrl_l1.experiment.settings import NAMING_KEYS, VOLATILE_KEYS, flatten, schema_defaults

PACKAGES = ("torch", "tensordict", "torchrl", "gymnasium", "mujoco", "numpy")

MAY_GROW = "outer_iterations"
"""A run continues if more of them are requested; no other setting may change."""


def versions() -> dict[str, str]:
    """Versions of Python, the platform and the packages that a result depends on.

    In a git checkout of this package they include the commit, see :func:`commit`. They are looked
    up once per process, since its code does not change.
    """
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    found = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        # Not from the metadata of an installation, which may be another copy.
        "torchrl-l1": torchrl_l1.__version__,
    }
    package = Path(torchrl_l1.__file__).parent
    at = commit(package)
    if at is not None:
        found["torchrl-l1 commit"] = at
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def commit(package: Path) -> str | None:
    """The commit of the git checkout with a package's folder at its top level.

    Args:
        package: the folder.

    Returns:
        its hash, followed by ``with changes`` if files of the package differ from it;
        ``None`` without a checkout or without git.
    """
    if not (package.parent / ".git").exists():
        return None
    # Without locks: many runs may ask at once, while the user runs git too.
    git = ["git", "--no-optional-locks", "-C", str(package.parent)]
    try:
        head = _output([*git, "rev-parse", "HEAD"])
        changes = _output([*git, "status", "--porcelain", "--", package.name])
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{head} with changes" if changes else head


def _output(command: list[str]) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def code_versions(config: Mapping[str, Any]) -> dict[str, str]:
    """Digests of the user's code that settings name, such as ``sha256 12ab...``, by name.

    Examples:
        >>> code_versions({"task": "hopper", "reward": "builtin"})
        {}
    """
    names = [str(config.get(key)) for key in NAMING_KEYS]
    folders = [str(folder) for folder in config.get("search_path") or ()]
    return {name: f"sha256 {code}" for name, code in code_digests(names, folders).items()}


def data_version(config: Mapping[str, Any]) -> dict[str, str]:
    """The digest of the dataset that an offline run names, if it is a file."""
    file = Path(str(config.get("dataset") or ""))
    return {str(config["dataset"]): f"sha256 {file_digest(file)}"} if file.is_file() else {}


def differences(
    before: Mapping[str, Any], now: Mapping[str, Any], may_grow: bool = False
) -> list[str]:
    """The settings that differ between two runs and affect the result, a text for each.

    Settings missing from the first run, because it is older than they are, have the schema's
    defaults.

    Args:
        before: configuration of the first run.
        now: configuration of the second.
        may_grow: whether the second may have more outer iterations.

    Examples:
        >>> before = {"seed": 0, "outer_iterations": 2, "run_dir": "here"}
        >>> now = {"seed": 1, "outer_iterations": 3, "run_dir": "there"}
        >>> differences(before, now)
        ['outer_iterations: 2 there, 3 now', 'seed: 0 there, 1 now']
        >>> differences(before, now, may_grow=True)
        ['seed: 0 there, 1 now']
    """
    defaults = schema_defaults(now)
    other_code = [] if same_code_in(before, now) else ["search_path"]
    before, now = flatten(before), flatten(now)
    # Either may be older than a setting: stored configurations are not updated by newer versions.
    before, now = (
        {k: v for k, v in defaults.items() if k in other} | own
        for own, other in ((before, now), (now, before))
    )
    had, has = before.get(MAY_GROW, 0), now.get(MAY_GROW, 0)
    # A damaged configuration may hold anything.
    if may_grow and isinstance(had, int) and isinstance(has, int) and had < has:
        before[MAY_GROW] = has
    return [
        f"{key}: {before.get(key, '(absent)')} there, {now.get(key, '(absent)')} now"
        for key in sorted(before.keys() | now.keys())
        if key in other_code
        or (before.get(key) != now.get(key) and key.split(".")[0] not in VOLATILE_KEYS)
    ]


def same_code_in(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether the files and modules named in both settings are the same; paths may differ."""
    paths = [list(map(str, config.get("search_path") or ())) for config in (before, now)]
    return same_code([str(now.get(key)) for key in NAMING_KEYS], *paths)
