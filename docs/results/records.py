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
from torchrl_l1.cli import main as command
from torchrl_l1.experiment.run_directory import run_directories
from torchrl_l1.report.runs import find_runs

HERE = Path(__file__).parent
RECORDS = "records.tar.xz"
CURVES = "l1_metrpo_curves.csv"
TEXTS = ("config.yaml", "versions.json", "metrics.csv", "timing.csv", "diverged.txt")
USAGE = "usage: records.py [NAME ...] | records.py pack NAME FOLDER ..."


def names() -> list[str]:
    """The campaigns of which there are records."""
    return sorted(file.parent.name for file in HERE.glob(f"*/{RECORDS}"))


def unpack(name: str, folder: Path) -> None:
    """Lay the records of a campaign out as its folder."""
    with tarfile.open(HERE / name / RECORDS) as archive:
        archive.extractall(folder, filter="data")


def texts(run: Path) -> Iterator[Path]:
    """The files of a run that its record holds."""
    yield from (run / name for name in TEXTS if (run / name).exists())
    yield from (file for file in (run / "evaluations").rglob("*") if file.is_file())


def pack(name: str, folders: Sequence[Path]) -> int:
    """Add finished runs to the records of a campaign.

    Args:
        name: the campaign.
        folders: where the runs are; a run's place in the campaign is its path behind the
            folder that has the campaign's name.

    Returns:
        how many runs there are records of.
    """
    with tempfile.TemporaryDirectory() as place:
        campaign = Path(place) / name
        campaign.mkdir()
        if (HERE / name / RECORDS).exists():
            unpack(name, campaign)
        for folder in folders:
            description = folder / "campaign.yaml"
            if description.exists() and not (campaign / description.name).exists():
                shutil.copyfile(description, campaign / description.name)
            for run in find_runs([folder]):
                if not run.finished:
                    continue
                target = campaign / behind(name, run.path)
                shutil.rmtree(target, ignore_errors=True)
                for file in texts(run.path):
                    copy = target / file.relative_to(run.path)
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(file, copy)
        (HERE / name).mkdir(exist_ok=True)
        write_atomically(HERE / name / RECORDS, packed(campaign))
        return len(list(run_directories(campaign)))


def behind(name: str, path: Path) -> Path:
    """The place of a run in its campaign.

    Examples:
        >>> behind("mbmf", Path("runs/mbmf/mbmf/swimmer/l1=off/seed_0"))
        PosixPath('mbmf/swimmer/l1=off/seed_0')
    """
    parts = path.resolve().parts
    if name not in parts:
        sys.exit(f"records.py: {path} lies in no folder {name}, as the runs of that campaign do")
    return Path(*parts[parts.index(name) + 1 :])


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
        campaign = Path("runs/campaigns") / name
        unpack(name, campaign)
        Path(CURVES).write_bytes(lzma.decompress((HERE / f"{CURVES}.xz").read_bytes()))
        command(["report", str(campaign), "--reference-curves", CURVES])
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
