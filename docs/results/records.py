"""Records of campaigns: their runs without the weights, which is all that reports are made of.

    python docs/results/records.py pack NAME FOLDER ...
    python docs/results/records.py [NAME ...]

The first puts the finished runs of the campaign NAME that lie below the folders into
`NAME/records.tar.xz` beside this file, with those that are there already; of two in one place that
of the folders counts. So a campaign may be trained piece by piece, on one machine after the other.
The description of the campaign is that of the first folder that has one.
The second writes the reports anew, of all records or of those that are named.

A record is a run's `config.yaml`, `versions.json`, `metrics.csv`, `timing.csv` and evaluations. The
authors' curves are those of the logs that the authors of arXiv 2403.14860 have released.
"""

from __future__ import annotations

import io
import lzma
import shutil
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import chdir
from pathlib import Path

from torchrl_l1.atomic import write_atomically
from torchrl_l1.campaign.description import dump_yaml, load_yaml
from torchrl_l1.cli import main as command
from torchrl_l1.experiment.evaluate import table_checksums
from torchrl_l1.experiment.run_directory import run_directories
from torchrl_l1.report.runs import Run, find_readable_runs

HERE = Path(__file__).parent
RECORDS = "records.tar.xz"
DESCRIPTION = "campaign.yaml"
CAMPAIGNS = Path("runs/campaigns")
CURVES = Path("docs/results/l1_metrpo_curves.csv.xz")
TEXTS = ("config.yaml", "versions.json", "metrics.csv", "timing.csv", "diverged.txt")
USAGE = "usage: records.py [NAME ...] | records.py pack NAME FOLDER ..."


def names() -> list[str]:
    """The campaigns of which there are records."""
    return sorted(file.parent.name for file in HERE.glob(f"*/{RECORDS}"))


def unpack(name: str, folder: Path) -> None:
    """Lay the records of a campaign out as its folder."""
    with tarfile.open(HERE / name / RECORDS) as archive:
        archive.extractall(folder, filter="data")


def texts(run: Run) -> Iterator[Path]:
    """The files of a run that its record holds: no evaluations that cannot be read."""
    yield from (run.path / name for name in TEXTS if (run.path / name).exists())
    for file in (run.path / "evaluations").rglob("*"):
        if file.is_file() and file.stem in run.evaluations:
            yield file


def pack(name: str, folders: Sequence[Path]) -> int:
    """Add finished runs to the records of a campaign.

    Args:
        name: the campaign.
        folders: where the runs are; a run's place in the campaign is its path behind the
            folder with the description of the campaign, or with its name. What cannot be read
            there is told, and the rest is packed.

    Returns:
        how many runs there are records of.
    """
    with tempfile.TemporaryDirectory() as place:
        campaign = Path(place) / name
        campaign.mkdir()
        if (HERE / name / RECORDS).exists():
            unpack(name, campaign)
        described = [folder for folder in folders if (folder / DESCRIPTION).exists()]
        for folder in described[:1]:
            shutil.copyfile(folder / DESCRIPTION, campaign / DESCRIPTION)
        for folder in folders:
            found = find_readable_runs([folder])
            for error in found.errors:
                print(f"records.py: left out: {error}", file=sys.stderr)
            for run in found.runs:
                if not run.finished:
                    continue
                place = behind(name, run.path, run.identity.shared["recipe"])
                target = campaign / place
                shutil.rmtree(target, ignore_errors=True)
                here, there = run.path.resolve(), CAMPAIGNS / name / place
                for file in texts(run):
                    copy = target / file.relative_to(run.path)
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    # Where it lay on the machine that trained it is nothing to others.
                    content = file.read_bytes().replace(bytes(here), bytes(there))
                    copy.write_bytes(content)
                seal(target)
        (HERE / name).mkdir(exist_ok=True)
        write_atomically(HERE / name / RECORDS, packed(campaign))
        return len(list(run_directories(campaign)))


def seal(record: Path) -> None:
    """Let evaluations that know the checksums of their tables know those of a record's."""
    for file in (record / "evaluations").glob("*.yaml"):
        settings = load_yaml(file)
        if "checksums" in settings:
            settings["checksums"] = table_checksums(file.with_suffix(".csv"))
            file.write_text(dump_yaml(settings), encoding="utf-8")


def behind(name: str, path: Path, recipe: str) -> Path:
    """The place of a run in its campaign, which begins with the name of its recipe.

    Examples:
        >>> behind("mbmf", Path("/home/mbmf/runs/mbmf/mbmf/swimmer/seed_0"), "mbmf/swimmer")
        PosixPath('mbmf/swimmer/seed_0')
    """
    path = path.resolve()
    for folder in path.parents:
        description = folder / DESCRIPTION
        if description.is_file() and load_yaml(description).get("name") == name:
            return path.relative_to(folder)
    begin = (name, *Path(recipe).parts)
    for at in reversed(range(len(path.parts))):
        if path.parts[at : at + len(begin)] == begin:
            return Path(*path.parts[at + 1 :])
    sys.exit(
        f"records.py: {path} lies in no folder {Path(*begin)}, as the runs of that campaign do, "
        f"nor below its {DESCRIPTION}"
    )


def packed(folder: Path) -> bytes:
    """All files of a folder as an archive that is the same for the same files."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        for file in sorted(file for file in folder.rglob("*") if file.is_file()):
            entry = tarfile.TarInfo(str(file.relative_to(folder)))
            entry.size = file.stat().st_size
            with file.open("rb") as opened:
                archive.addfile(entry, opened)
    return lzma.compress(content.getvalue(), preset=9 | lzma.PRESET_EXTREME)


def report(name: str) -> None:
    """Write the report of a campaign's records in place of the one that is there."""
    with tempfile.TemporaryDirectory() as place, chdir(place):
        campaign = CAMPAIGNS / name
        unpack(name, campaign)
        CURVES.parent.mkdir(parents=True)
        shutil.copy(HERE / CURVES.name, CURVES)
        command(["report", str(campaign), "--reference-curves", str(CURVES)])
        for file in HERE.joinpath(name).iterdir():
            if file.name != RECORDS:
                file.unlink()
        shutil.copytree(campaign / "report", HERE / name, dirs_exist_ok=True)


def main() -> None:
    """Pack, or write reports."""
    match sys.argv[1:]:
        case ["pack", name, *folders] if folders:
            print(f"{HERE / name / RECORDS}: {pack(name, list(map(Path, folders)))} runs")
        case ["pack", *_]:
            sys.exit(USAGE)
        case chosen:
            if unknown := set(chosen) - set(names()):
                sys.exit(f"records.py: no records of {', '.join(sorted(unknown))}; {USAGE}")
            for name in chosen or names():
                report(name)


if __name__ == "__main__":
    main()
