"""The work of a campaign: runs, evaluations of finished runs, or sweeps."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path

from torchrl_l1.campaign.description import Campaign, CampaignError, RunMatrix, value_text
from torchrl_l1.campaign.evaluation import is_evaluated
from torchrl_l1.campaign.plan import PlannedRun, quoted, recipe_name
from torchrl_l1.campaign.progress import Progress
from torchrl_l1.campaign.workers import Failure, Job, Unfinished, Workers
from torchrl_l1.experiment.files import path_text

# Launcher: the module of the plug-in, and the extra that installs it. Hydra brings ``basic``.
_PLUGINS = {
    "joblib": ("hydra_joblib_launcher", "joblib"),
    "submitit_slurm": ("hydra_submitit_launcher", "submitit"),
    "submitit_local": ("hydra_submitit_launcher", "submitit"),
    "ray": ("hydra_ray_launcher", "ray"),
}
LAUNCHERS = (*_PLUGINS, "basic")

# The setting for the number of parallel runs, if a launcher has one.
_WORKERS = {"joblib": "n_jobs", "submitit_slurm": "array_parallelism"}


def check_launcher(launcher: str) -> None:
    """Make sure that a launcher exists and is installed.

    Raises:
        CampaignError: if it is not, naming the known launchers or the command that installs it.
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

    The run directories are the same as those of the campaign's own workers: Hydra lists the
    overrides of each job in the order of the command line, which is that of the matrix.

    Args:
        matrix: the runs.
        output: folder of the campaign.
        launcher: its name, as in ``hydra/launcher=NAME``.
        workers: number of parallel runs; the launcher's own default if ``None``.
        settings: further overrides of Hydra's settings, such as a Slurm partition.
        logs: folder for Hydra's own files, below ``output / "launcher"``.

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
    for position, key in enumerate(keys):
        if any(path_text(value_text(value)) != value_text(value) for value in matrix.matrix[key]):
            parts[position] = f"${{path_text:{parts[position]}}}"
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
    """Whether sweeps may run at the same time: if a scheduler assigns the machines."""
    return launcher not in ("joblib", "basic")


def work_on_runs(runs: Sequence[PlannedRun], workers: int) -> list[Failure]:
    """Finish and evaluate each run, skipping what is already done.

    Returns:
        the processes that failed; the others continued.
    """
    progress = Progress(runs)

    def evaluations(run: PlannedRun) -> list[Job]:
        due = [e for e in run.evaluations if not is_evaluated(run.directory, e)]
        if not due:
            return []
        settings = json.dumps({e.name: e.of_a_run() for e in due})

        def done() -> Iterable[Job]:
            progress.evaluated(run)
            return []

        command = _child("evaluate", str(run.directory.path), settings)
        return [Job(f"evaluation of {run}", command, _log(run), _never, done)]

    def training(run: PlannedRun) -> Job:
        def done() -> Iterable[Job]:
            _check_finished([run])
            progress.finished(run)
            return evaluations(run)

        command = _child("train", json.dumps({**run.settings(), "resume": True}))
        return Job(str(run), command, _log(run), run.directory.held, done)

    finished = [run for run in runs if run.finished()]
    jobs = [job for run in finished for job in evaluations(run)]
    jobs += [training(run) for run in runs if not run.finished()]
    return _work(jobs, workers, progress)


def launch_runs(
    campaign: Campaign,
    output: Path,
    runs: Sequence[PlannedRun],
    launcher: str,
    workers: int | None,
    settings: Sequence[str],
) -> list[Failure]:
    """Hand each matrix that is not finished to a Hydra launcher, and wait for it.

    Args:
        campaign: the campaign.
        output: its folder.
        runs: its runs.
        launcher: its name, as in ``hydra/launcher=NAME``.
        workers: number of parallel runs; the launcher's own default if ``None``.
        settings: overrides of Hydra's own settings.

    Returns:
        the sweeps that failed, or that left runs unfinished.
    """
    progress = Progress(runs)
    unfinished = sorted({run.matrix for run in runs if not run.finished()})
    jobs = []
    for index in unfinished:
        matrix = campaign.runs[index]
        command = _child(*sweep(matrix, output, launcher, workers, settings, logs=str(index)))
        log = output / "launcher" / f"{index}.log"

        def done(index: int = index) -> Iterable[Job]:
            _check_finished([run for run in runs if run.matrix == index])
            progress.write(f"finished the sweep of {campaign.runs[index].recipe}")
            return []

        jobs.append(Job(f"sweep {index} ({matrix.recipe})", command, log, _never, done))
    return _work(jobs, len(jobs) if side_by_side(launcher) else 1, progress)


def _work(jobs: Sequence[Job], workers: int, progress: Progress) -> list[Failure]:
    pool = Workers(
        workers,
        lambda running: progress.tick(len(running)),
        lambda job: progress.write(f"{job.name} runs in another process: waiting for it"),
    )
    try:
        return pool.work(jobs)
    finally:
        progress.close()


def _check_finished(runs: Sequence[PlannedRun]) -> None:
    problems = [problem for problem in (run.problem() for run in runs) if problem]
    if problems:
        count = f"{len(problems)} of {len(runs)} runs are not as planned: " if len(runs) > 1 else ""
        raise Unfinished(count + problems[0])


def _child(*arguments: str) -> list[str]:
    module = "torchrl_l1.campaign.child"
    return [sys.executable, "-m", module, str(os.getpid()), *arguments]


def _log(run: PlannedRun) -> Path:
    # Beside the run directory, which must be empty before its run starts.
    return run.directory.path.with_name(run.directory.path.name + ".log")


def _never() -> bool:
    return False
