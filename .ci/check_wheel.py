"""Check that a wheel holds the package, its type marker, its licence and every recipe."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path


def main(wheel: str) -> None:
    """Compare the wheel with the source tree; exit non-zero with what is missing."""
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {
        path.as_posix()
        for path in Path("torchrl_l1").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    recipes = {
        f"torchrl_l1/{path.as_posix()}" for path in Path("recipes").rglob("*") if path.is_file()
    }
    if not recipes:
        sys.exit("error: no recipe in recipes/")
    missing = sorted((expected | recipes) - names)
    if not any(name.endswith("licenses/LICENSE") for name in names):
        missing.append("LICENSE")
    if missing:
        sys.exit(f"error: {wheel} lacks {', '.join(missing)}")
    print(f"{wheel}: {len(expected)} package files and {len(recipes)} recipes, all present")


if __name__ == "__main__":
    main(sys.argv[1])
