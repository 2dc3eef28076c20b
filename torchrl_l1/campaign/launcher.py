"""Handing a campaign's runs to Hydra's launchers: a sweep for each matrix."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from torchrl_l1.campaign.runs import quoted, recipe_name
from torchrl_l1.campaign.settings import CampaignError, RunMatrix, value_text

# Launcher: the module of the plug-in, and the extra that installs it. Hydra brings ``basic``.
_PLUGINS = {
    "joblib": ("hydra_joblib_launcher", "joblib"),
    "submitit_slurm": ("hydra_submitit_launcher", "submitit"),
    "submitit_local": ("hydra_submitit_launcher", "submitit"),
    "ray": ("hydra_ray_launcher", "ray"),
}
LAUNCHERS = (*_PLUGINS, "basic")

# How many runs at a time, where the launcher has a setting for that.
_WORKERS = {"joblib": "n_jobs", "submitit_slurm": "array_parallelism"}


def check_launcher(launcher: str) -> None:
    """Make sure that a launcher exists and is installed.

    Raises:
        CampaignError: if it is not, with the launchers that there are or the command that
            installs it.
    """
    if launcher not in LAUNCHERS:
        raise CampaignError(f"unknown launcher {launcher!r}; there are {', '.join(LAUNCHERS)}")
    if launcher not in _PLUGINS:
        return
    module, extra = _PLUGINS[launcher]
    try:
        found = find_spec(f"hydra_plugins.{module}")
    except ModuleNotFoundError:
        found = None
    if found is None:
        raise CampaignError(
            f"the launcher {launcher} is not installed; pip install 'torchrl-l1[{extra}]'"
        )


def sweep(
    matrix: RunMatrix,
    output: Path,
    launcher: str,
    workers: int | None = None,
    settings: Sequence[str] = (),
    logs: str = "0",
) -> list[str]:
    """The arguments of ``torchrl-l1`` that run a matrix as one Hydra sweep.

    The run directories are those of the campaign's own workers: Hydra lists the overrides of each
    job in the order of the command line, which is that of the matrix.

    Args:
        matrix: the runs.
        output: folder of the campaign.
        launcher: its name, as in ``hydra/launcher=NAME``.
        workers: runs at a time; the launcher's own default if ``None``.
        settings: further overrides of Hydra's settings, such as a Slurm partition.
        logs: folder of Hydra's own files below ``output / "launcher"``.

    Examples:
        >>> matrix = RunMatrix("metrpo/half_cheetah", [], {"l1": ["off", "paper"], "seed": [0, 1]})
        >>> for argument in sweep(matrix, Path("/out"), "joblib", workers=4):
        ...     print(argument)
        run
        metrpo/half_cheetah
        -m
        l1=off,paper
        seed=0,1
        run_dir='/out/metrpo/half_cheetah/${hydra:overrides.task.0}/seed_${seed}'
        resume=true
        hydra/launcher=joblib
        hydra.sweep.dir='/out/launcher/0'
        hydra.launcher.n_jobs=4
    """
    keys = [key for key in matrix.matrix if key != "seed"]
    parts = [f"${{hydra:overrides.task.{position}}}" for position in range(len(keys))]
    run_dir = output.joinpath(recipe_name(matrix.recipe), *parts, "seed_${seed}")
    texts = {key: ",".join(map(value_text, values)) for key, values in matrix.matrix.items()}
    parallel = []
    if workers is not None and launcher in _WORKERS:
        parallel = [f"hydra.launcher.{_WORKERS[launcher]}={workers}"]
    return [
        *("run", matrix.recipe, "-m"),
        *(f"{key}={text}" for key, text in texts.items()),
        *matrix.overrides,
        *(f"run_dir={quoted(run_dir)}", "resume=true"),
        *(f"hydra/launcher={launcher}", f"hydra.sweep.dir={quoted(output / 'launcher' / logs)}"),
        *parallel,
        *settings,
    ]


def elsewhere(launcher: str) -> bool:
    """Whether runs may go to other machines."""
    return launcher in ("submitit_slurm", "ray")


def side_by_side(launcher: str) -> bool:
    """Whether sweeps may run at the same time: if a scheduler shares out the machines."""
    return launcher not in ("joblib", "basic")
