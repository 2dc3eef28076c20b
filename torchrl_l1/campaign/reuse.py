"""Reusing runs that another campaign has trained with the same settings, by copying them."""

from __future__ import annotations

import filecmp
import shutil
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from torchrl_l1.campaign.description import CampaignError
from torchrl_l1.campaign.plan import PlannedRun
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.evaluate import episodes_file
from torchrl_l1.experiment.files import write_atomically
from torchrl_l1.experiment.provenance import differences
from torchrl_l1.experiment.run_directory import RunDirectory, read_config, run_directories
from torchrl_l1.experiment.wandb_files import ID_FILE, draw_id, known_id


def find_reusable(
    runs: Sequence[PlannedRun], output: Path, folders: Sequence[Path]
) -> dict[Path, Path]:
    """Finished runs with the settings of runs that have not begun; the first one found is used.

    Args:
        runs: the campaign's runs.
        output: the campaign's folder; runs in it are the campaign's own.
        folders: folders to search, with their subfolders.

    Returns:
        the finished run by the run directory of its copy.

    Raises:
        CampaignError: if a folder does not exist.
    """
    for folder in folders:
        if not folder.is_dir():
            hint = "; overrides go before --reuse" if "=" in folder.name else ""
            raise CampaignError(f"--reuse: there is no folder {folder}{hint}")
    finished: dict[Any, list[tuple[Path, dict[str, Any]]]] = {}
    for folder in folders:
        for path, config in run_directories(folder):
            place, directory = path.resolve(), RunDirectory(path)
            if place.is_relative_to(output) or output.is_relative_to(place):
                continue
            if isinstance(config, dict) and _finished(directory, config) and not directory.held():
                finished.setdefault(_key(config), []).append((path, config))
    reused = {}
    for run in runs if finished else ():
        if run.directory.free() and not run.directory.held():
            now = run.settings()
            same = [
                path
                for path, was in finished.get(_key(now), [])
                if not differences(was, now)
                and not RunDirectory(path).changed_files(now, data=True)
            ]
            if same:
                reused[run.directory.path] = same[0]
    return reused


def copy_run(source: Path, run: PlannedRun) -> None:
    """Copy a finished run to where it would have been trained; a kill leaves all or nothing.

    Raises:
        CampaignError: if that fails, or if the run changes meanwhile.
    """
    target = run.directory.path
    # Reports skip hidden folders, so that remains of a kill do not count as a run.
    temporary = target.with_name(f".{target.name}.copy")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        # Targets of links are copied, so that nothing is ever changed through them.
        shutil.copytree(source, temporary, ignore=_left, ignore_dangling_symlinks=True)
        copy = RunDirectory(temporary)
        config = read_config(copy.config_file)
        if not _finished(copy, config) or differences(config, run.settings()):
            raise OSError("it has changed meanwhile")
        _keep_evaluations(source, temporary, {settings.name for settings in run.evaluations})
        if known_id(source):
            draw_id(temporary)
        config["run_dir"] = str(target)
        write_atomically(copy.config_file, OmegaConf.to_yaml(OmegaConf.create(config)))
        if target.exists() and run.directory.free():
            shutil.rmtree(target)
        temporary.rename(target)
    except (OSError, RunDirectoryError) as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise CampaignError(f"cannot copy {source} to {target}: {error}") from error


def _left(folder: str, names: list[str]) -> set[str]:
    """Locks, unfinished files, W&B's files, links to folders, and anything but regular files."""
    # W&B knows the source by its id; the copy is another run.
    found = set(shutil.ignore_patterns(".lock", "*.tmp", ID_FILE, "wandb")(folder, names))
    for name in names:
        path = Path(folder, name)
        if path.is_dir() if path.is_symlink() else not (path.is_file() or path.is_dir()):
            found.add(name)
    return found


def _key(config: Mapping[str, Any]) -> tuple[Any, ...]:
    """A key to group runs by: with different keys, runs differ in settings or code."""
    # Files and modules with the same name in different folders are not the same.
    folders = tuple(map(str, config.get("search_path") or ()))
    return *(str(config.get(key)) for key in ("task", "seed", "outer_iterations")), folders


def _finished(directory: RunDirectory, config: Mapping[str, Any]) -> bool:
    return directory.iterations_done() == config.get("outer_iterations") and directory.intact()


def _keep_evaluations(source: Path, copy: Path, wanted: Set[str]) -> None:
    """Remove tables that were not requested here, and settings of one remade meanwhile.

    A table without its settings is made again.
    """
    tables = copy / "evaluations"
    for file in (*tables.glob("*.*"), *tables.glob("episodes/*.*")):
        if file.stem not in wanted:
            file.unlink()
    for settings in tables.glob("*.yaml"):
        table = settings.with_suffix(".csv")
        names = [table.name, settings.name]
        episodes = episodes_file(table)
        if episodes.exists():  # older tables have none
            names.append(str(episodes.relative_to(tables)))
        if filecmp.cmpfiles(source / "evaluations", settings.parent, names, False)[0] != names:
            settings.unlink()
