"""What a campaign file says about the runs below it."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torchrl_l1.campaign.description import load_yaml, read_campaign
from torchrl_l1.experiment.recipes import available_campaigns
from torchrl_l1.report.runs import Run


@dataclass(frozen=True)
class CampaignState:
    """A campaign and how far it is.

    Attributes:
        name: its name.
        description: one line.
        command: what makes it, or makes it complete.
        expected: number of runs that it asks for.
        finished: number of finished ones.
        begun: number of those that are not finished.
    """

    name: str
    description: str
    command: str
    expected: int
    finished: int
    begun: int


def find_campaigns(folders: Sequence[Path], runs: Sequence[Run]) -> list[CampaignState]:
    """Every ``campaign.yaml`` in or below some folders.

    Raises:
        ValueError: if one of them is no campaign file.
    """
    found: dict[Path, CampaignState] = {}
    for folder in folders:
        for path, below, files in os.walk(folder):
            inside_a_run = "config.yaml" in files
            below[:] = sorted(n for n in below if not (n.startswith(".") or inside_a_run))
            if "campaign.yaml" in files and Path(path).resolve() not in found:
                found[Path(path).resolve()] = _read(Path(path), runs)
    return list(found.values())


def _read(folder: Path, runs: Sequence[Run]) -> CampaignState:
    file = folder / "campaign.yaml"
    content = load_yaml(file)
    try:
        name = str(content.get("name", folder.name))
        matrices = [entry["matrix"] for entry in content["runs"]]
        expected = sum(math.prod(map(len, matrix.values())) for matrix in matrices)
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"{file} is no campaign file: {error!r}") from error
    given: str | Path = file
    if name in available_campaigns():
        # The file in the folder has the overrides of its command; the shipped one has none.
        same = read_campaign(name).to_dict()["runs"] == content["runs"]
        given = name if same else file
    mine = [run for run in runs if run.path.resolve().is_relative_to(folder.resolve())]
    return CampaignState(
        name,
        str(content.get("description", "")),
        f"torchrl-l1 campaign {given} --output {folder}",
        expected,
        sum(run.finished for run in mine),
        sum(not run.finished for run in mine),
    )
