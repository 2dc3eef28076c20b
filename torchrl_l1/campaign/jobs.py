"""What a campaign's workers do: runs, the evaluations of those that are finished, or sweeps."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from torchrl_l1.campaign.evaluation import is_evaluated
from torchrl_l1.campaign.launcher import side_by_side, sweep
from torchrl_l1.campaign.progress import Progress
from torchrl_l1.campaign.runs import PlannedRun
from torchrl_l1.campaign.settings import Campaign
from torchrl_l1.campaign.workers import Failure, Job, Unfinished, Workers


def work_on_runs(runs: Sequence[PlannedRun], workers: int) -> list[Failure]:
    """Bring each run to its end and evaluate it; what is done already is skipped.

    Returns:
        the processes that failed; the others went on.
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
        workers: runs at a time; the launcher's own default if ``None``.
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
