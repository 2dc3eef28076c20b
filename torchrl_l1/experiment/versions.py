"""What a run ran with: packages, platform, and the commit of a checkout."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torchrl_l1

PACKAGES = ("torch", "tensordict", "torchrl", "gymnasium", "mujoco", "numpy")


def versions() -> dict[str, str]:
    """Versions of Python, the platform and the packages that a result depends on.

    In a git checkout of this package the commit joins them, see :func:`commit`.
    """
    found = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        # Not from the metadata of an installation: it may be that of another copy.
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
    """The commit of the git checkout that a package's folder lies at the top of.

    Args:
        package: the folder.

    Returns:
        its hash, followed by ``with changes`` where files of the package differ from it;
        ``None`` where there is no checkout or no git.
    """
    if not (package.parent / ".git").exists():
        return None
    # Without locks: many runs may ask at once, and beside somebody's own git.
    git = ["git", "--no-optional-locks", "-C", str(package.parent)]
    try:
        head = _output([*git, "rev-parse", "HEAD"])
        changes = _output([*git, "status", "--porcelain", "--", package.name])
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{head} with changes" if changes else head


def _output(command: list[str]) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
