"""``torchrl-l1 report``."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchrl_l1.report.build import report


def report_command(options: argparse.Namespace) -> None:
    """Write the report and say where it is."""
    page = report(
        list(dict.fromkeys(map(Path, options.dir))),
        Path(options.output) if options.output else None,
        Path(options.reference_curves) if options.reference_curves else None,
    )
    print(f"Report: {page}")
    print(f"Tables (.csv) and figures (.png): {page.parent}")
