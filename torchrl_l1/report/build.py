"""From run directories to a report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl_l1.experiment.run_directory import write_atomically
from torchrl_l1.report.algorithm_sections import algorithm_sections
from torchrl_l1.report.campaigns import find_campaigns
from torchrl_l1.report.evaluation_sections import evaluation_sections
from torchrl_l1.report.finding import Findings, find_readable_runs
from torchrl_l1.report.page import Page
from torchrl_l1.report.reference_curves import ReferenceCurves
from torchrl_l1.report.study import Study, studies
from torchrl_l1.report.training_sections import training_sections
from torchrl_l1.report.training_tables import run_rows


def report(
    folders: Sequence[Path], output: Path | None = None, reference_curves: Path | None = None
) -> Path:
    """Write tables, figures and a page of all runs in or below some folders.

    Each algorithm has sections of its own. Where there are several, their headings and files are
    named after it, and a last section compares them.

    Everything is read before anything is written. Files that cannot be read are left out, and
    the page lists them.

    Args:
        folders: where to look.
        output: folder of the results; ``report`` in the first folder by default.
        reference_curves: learning curves to draw behind, see :class:`ReferenceCurves`.

    Returns:
        the page, ``report.md``.

    Raises:
        FileNotFoundError: if a folder or file does not exist, or no run is found.
        RunDirectoryError: if no run can be read.
        ValueError: if the output folder is a run directory, or the curves cannot be read.
    """
    output = folders[0] / "report" if output is None else output
    if (output / "config.yaml").exists():
        raise ValueError(f"{output} is a run directory; choose another --output")
    if output.exists() and not output.is_dir():
        raise ValueError(f"--output {output} is a file; give a folder")
    reference = None if reference_curves is None else ReferenceCurves(reference_curves)
    found = find_readable_runs(folders)
    runs = found.runs
    campaigns = find_campaigns(folders, runs)
    every = studies(runs)
    output.mkdir(parents=True, exist_ok=True)

    page = Page(output)
    _introduction(page, every, found, _command(folders, output, reference_curves))
    page.campaigns(campaigns)
    for study in every:
        part = page.part(study.facts.name) if len(every) > 1 else page
        training_sections(part, study, reference)
        evaluation_sections(part, study)
    algorithm_sections(page, every)
    page.heading("Versions", "What the runs ran with, from their `versions.json`.")
    page.versions(runs)
    file = output / "report.md"
    write_atomically(file, page.render())
    return file


def _introduction(page: Page, every: Sequence[Study], found: Findings, command: str) -> None:
    runs = [run for study in every for run in study.runs]
    unfinished = sum(not run.finished for run in runs)
    page.text(
        f"{len(runs)} runs, of which {len(runs) - unfinished} are finished; only "
        "these enter means, intervals and differences. Every run's settings are in the "
        "`config.yaml` of its directory.",
        f"```console\n$ {command}\n```",
    )
    page.text(_algorithms(every))
    page.csv("runs", _run_rows(every))
    duplicates = [run for study in every for run in study.duplicates]
    if duplicates:
        left_out = "\n".join(f"- {run.path}" for run in duplicates)
        page.text(
            "Left out, since another run has the same settings and seed (what it was evaluated in "
            f"and the other was not counts for the other):\n\n{left_out}"
        )
    if found.errors:
        errors = "\n".join(f"- {error}" for error in found.errors)
        page.text(f"Left out, since they cannot be read:\n\n{errors}")


def _algorithms(every: Sequence[Study]) -> str:
    """Which algorithms there are; nothing to say where it is METRPO alone."""
    if len(every) == 1:
        (study,) = every
        return "" if study.algorithm == "metrpo" else f"The algorithm is {study.facts.name}."
    numbers = ", ".join(f"{study.facts.name} ({len(study.runs)} runs)" for study in every)
    return (
        f"Algorithms: {numbers}. Their runs are never pooled: each has sections of its own, with "
        "its name in the headings, and tables and figures are named after it."
    )


def _run_rows(every: Sequence[Study]) -> list[dict[str, Any]]:
    if len(every) == 1:
        return run_rows(every[0])
    return [{"algorithm": study.facts.name, **row} for study in every for row in run_rows(study)]


def _command(folders: Sequence[Path], output: Path, reference_curves: Path | None) -> str:
    words = ["torchrl-l1 report", *map(str, folders)]
    if output != folders[0] / "report":
        words.append(f"--output {output}")
    if reference_curves is not None:
        words.append(f"--reference-curves {reference_curves}")
    return " ".join(words)
