"""Building a report from run directories."""

from __future__ import annotations

import argparse
import gc
import math
import operator
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_l1.campaign import CampaignError, RunMatrix, read_campaign
from torchrl_l1.campaign.description import load_yaml
from torchrl_l1.campaign.plan import levels
from torchrl_l1.experiment.errors import RunDirectoryError, message
from torchrl_l1.experiment.files import refuse_link, write_atomically
from torchrl_l1.experiment.recipes import available_campaigns
from torchrl_l1.report.comparison import algorithm_sections
from torchrl_l1.report.evaluations import evaluation_sections
from torchrl_l1.report.page import Page, markdown, plain
from torchrl_l1.report.published import ReferenceCurves
from torchrl_l1.report.runs import Findings, Run, find_readable_runs
from torchrl_l1.report.study import Study, studies
from torchrl_l1.report.training import run_rows, training_sections


def report_command(options: argparse.Namespace) -> None:
    """Write the report and print its path."""
    # Imported packages stay. With them frozen, what figures leave soon dominates and is collected.
    gc.freeze()
    gc.collect()
    page = report(
        list(dict.fromkeys(map(Path, options.dir))),
        Path(options.output) if options.output else None,
        Path(options.reference_curves) if options.reference_curves else None,
    )
    print(f"Report: {page}")
    print(f"Tables (.csv) and figures (.png): {page.parent}")


def report(
    folders: Sequence[Path], output: Path | None = None, reference_curves: Path | None = None
) -> Path:
    """Write tables, figures and a page on all runs in some folders and their subfolders.

    Each algorithm has its own sections. If there are several, headings and files are named after
    the algorithm, and a last section compares them.

    Everything is read before anything is written. Unreadable files are left out and listed on the
    page.

    Args:
        folders: the folders to search.
        output: folder for the results; ``report`` in the first folder by default.
        reference_curves: learning curves to draw in the background, see :class:`ReferenceCurves`.

    Returns:
        the page, ``report.md``.

    Raises:
        FileNotFoundError: if a folder or file does not exist, or no run is found.
        RunDirectoryError: if no run can be read.
        ValueError: if the output folder is a run directory, or the curves cannot be read.
    """
    output = folders[0] / "report" if output is None else output
    if (folders[0] / "config.yaml").exists() and output.parent == folders[0]:
        refuse_link(output)
    if (output / "config.yaml").exists():
        raise ValueError(f"{output} is a run directory; choose another --output")
    if output.exists() and not output.is_dir():
        raise ValueError(f"--output {output} is a file; give a folder")
    reference = None if reference_curves is None else ReferenceCurves(reference_curves)
    found = find_readable_runs(folders)
    runs = [*found.runs, *found.lost]
    campaigns = find_campaigns(folders, runs, found.errors)
    every = studies(runs)
    output.mkdir(parents=True, exist_ok=True)

    page = Page(output)
    _introduction(page, every, found, _command(folders, output, reference_curves))
    _campaigns(page, campaigns)
    for study in every:
        part = page.part(study.facts.name) if len(every) > 1 else page
        training_sections(part, study, reference)
        evaluation_sections(part, study)
    if len(every) > 1:
        algorithm_sections(page, every)
    _versions(page, runs)
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
        f"```console\n$ {_one_line(command)}\n```",
    )
    page.text(_algorithms(every))
    page.csv("runs", _run_rows(every))
    duplicates = [run for study in every for run in study.duplicates]
    if duplicates:
        left_out = "\n".join(f"- {plain(run.path)}" for run in duplicates)
        page.text(
            "Left out, since another run has the same settings and seed (evaluations that only the "
            f"left-out run has are counted for the other):\n\n{left_out}"
        )
    diverged = "\n".join(f"- {plain(r.path)}: {plain(r.diverged)}" for r in runs if r.diverged)
    if diverged:
        page.text(f"Trainings that diverged:\n\n{diverged}")
    if found.errors:
        errors = "\n".join(f"- {plain(error)}" for error in found.errors)
        page.text(f"Left out, since they cannot be read:\n\n{errors}")


def _algorithms(every: Sequence[Study]) -> str:
    """A sentence on the algorithms; empty if METRPO is the only one."""
    if len(every) == 1:
        (study,) = every
        return "" if study.algorithm == "metrpo" else f"The algorithm is {study.facts.name}."
    numbers = ", ".join(f"{study.facts.name} ({len(study.runs)} runs)" for study in every)
    return (
        f"Algorithms: {numbers}. Their runs are never pooled: each has its own sections, with "
        "its name in the headings, and its tables and figures are named after it."
    )


def _run_rows(every: Sequence[Study]) -> list[dict[str, Any]]:
    if len(every) == 1:
        return run_rows(every[0])
    return [{"algorithm": study.facts.name, **row} for study in every for row in run_rows(study)]


def _command(folders: Sequence[Path], output: Path, reference_curves: Path | None) -> str:
    words = ["torchrl-l1", "report", *map(str, folders)]
    if output != folders[0] / "report":
        words += ["--output", str(output)]
    if reference_curves is not None:
        words += ["--reference-curves", str(reference_curves)]
    return shlex.join(words)


@dataclass(frozen=True)
class CampaignState:
    """A campaign and its progress.

    Attributes:
        name: its name.
        description: one line.
        command: the command that makes or completes it.
        expected: number of runs that it asks for.
        finished: number of finished runs.
        begun: number of runs begun but not finished.
        others: number of runs in its folder that it does not ask for.
    """

    name: str
    description: str
    command: str
    expected: int
    finished: int
    begun: int
    others: int


def find_campaigns(
    folders: Sequence[Path], runs: Sequence[Run], errors: list[RunDirectoryError]
) -> list[CampaignState]:
    """Every ``campaign.yaml`` in some folders and their subfolders.

    Args:
        folders: the folders to search.
        runs: the runs found.
        errors: problems with invalid campaign files are appended to these.
    """
    found: dict[Path, CampaignState] = {}
    for folder in folders:
        for path, below, files in os.walk(folder):
            inside_a_run = "config.yaml" in files
            below[:] = sorted(n for n in below if not (n.startswith(".") or inside_a_run))
            if "campaign.yaml" in files and Path(path).resolve() not in found:
                try:
                    found[Path(path).resolve()] = _read_campaign(Path(path), runs)
                except (OSError, ValueError) as error:
                    errors.append(RunDirectoryError(message(error)))
    return list(found.values())


def _read_campaign(folder: Path, runs: Sequence[Run]) -> CampaignState:
    file = folder / "campaign.yaml"
    content = load_yaml(file)
    try:
        name = str(content.get("name", folder.name))
        asked = [
            levels(RunMatrix(entry["recipe"], matrix=entry.get("matrix") or {}))
            for entry in content["runs"]
        ]
    except (AttributeError, IndexError, KeyError, TypeError, CampaignError) as error:
        raise ValueError(f"{file} is not a campaign file: {error!r}") from error
    given: str | Path = file
    if name in available_campaigns():
        # The file in the folder includes the overrides of its command; the shipped one does not.
        same = read_campaign(name).to_dict()["runs"] == content["runs"]
        given = name if same else file
    below = [run for run in runs if _campaign_of(run.path.resolve()) == folder.resolve()]
    mine = [
        run
        for run in below
        if _is_one_of(run.path.resolve().relative_to(folder.resolve()).parts, asked)
    ]
    return CampaignState(
        name,
        str(content.get("description", "")),
        shlex.join(["torchrl-l1", "campaign", str(given), "--output", str(folder)]),
        sum(math.prod(map(len, names)) for names in asked),
        sum(run.finished for run in mine),
        sum(not run.finished for run in mine),
        len(below) - len(mine),
    )


def _is_one_of(place: Sequence[str], asked: Sequence[Sequence[Sequence[str]]]) -> bool:
    """Whether a path belongs to one of these matrices; all paths might not fit into memory."""
    return any(
        len(place) == len(names) and all(map(operator.contains, names, place)) for names in asked
    )


def _campaign_of(run: Path) -> Path | None:
    """The folder of a run's campaign: the nearest one above it with a ``campaign.yaml``."""
    return next((above for above in run.parents if (above / "campaign.yaml").is_file()), None)


def _one_line(command: str) -> str:
    return " ".join(command.split()).replace("```", "'''")


def _campaigns(page: Page, campaigns: Sequence[CampaignState]) -> None:
    """The progress of each campaign, and its command."""
    for campaign in campaigns:
        left = campaign.expected - campaign.finished - campaign.begun
        state = f"{campaign.finished} of {campaign.expected} runs finished"
        state += f", {campaign.begun} unfinished" * (campaign.begun > 0)
        state += f", {left} not begun" * (left > 0)
        state += f", {campaign.others} others in its folder" * (campaign.others > 0)
        page.text(
            f"Campaign **{plain(campaign.name)}** ({state}). {plain(campaign.description)}".strip(),
            f"```console\n$ {_one_line(campaign.command)}\n```",
        )


def _versions(page: Page, runs: Sequence[Run]) -> None:
    """Versions used by the runs, a line per package and version."""
    page.heading("Versions", "Versions that the runs used, from their `versions.json`.")
    seen: dict[tuple[str, str], int] = {}
    for run in runs:
        for package, version in run.versions.items():
            seen[package, version] = seen.get((package, version), 0) + 1
    rows = [
        {"package": package, "version": version, "runs": str(count)}
        for (package, version), count in sorted(seen.items())
    ]
    without = sum(not run.versions for run in runs)
    if rows:
        page.text(markdown(rows))
        page.csv("versions", rows)
    if without:
        page.text(f"{without} of {len(runs)} runs have no versions.json.")
