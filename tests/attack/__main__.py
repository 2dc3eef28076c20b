"""``python -m tests.attack [--quick] [--seed N] [--only GROUP ...]``: what the package survives.

Kills at random moments, disks that fail, hostile files, numbers that are none: each kind is tried
many times. The table says how often, how often it was survived, and whether anything was lost; the
status is 1 unless all is well. The whole takes minutes, ``--quick`` tries some of each kind.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tests.attack import hostile, kills, numeric, storage
from tests.attack.outcome import Attack, Row, table

GROUPS: dict[str, Callable[[Attack], list[Row]]] = {
    "kills": kills.rows,
    "storage": storage.rows,
    "hostile": hostile.rows,
    "numeric": numeric.rows,
}


def attack(
    root: Path, quick: bool, seed: int, groups: list[str] | None = None, match: str = ""
) -> list[Row]:
    """All rows of the table; work goes on below ``root``, which others may look into."""
    rows = []
    for name, group in GROUPS.items():
        if groups and name not in groups:
            continue
        folder = root / name
        folder.mkdir()
        start = time.monotonic()
        found = group(Attack(folder, quick, seed, match))
        seconds = time.monotonic() - start
        print(f"{name}: {seconds:.0f} s", file=sys.stderr, flush=True)
        rows += found
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.attack", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="some of each kind")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of kills")
    parser.add_argument("--only", nargs="+", choices=list(GROUPS), help="these groups")
    parser.add_argument("--match", default="", help="only what has this in its name")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as root:
        # Another user must get to what that user may not write.
        Path(root).chmod(0o755)
        rows = attack(Path(root), options.quick, options.seed, options.only, options.match)
    if not any(row.tried for row in rows):
        parser.error(f"nothing has {options.match!r} in its name there")
    print(table(rows))
    sys.exit(any(row.failures for row in rows))


if __name__ == "__main__":
    main()
