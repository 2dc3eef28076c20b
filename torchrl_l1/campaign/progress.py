"""The progress of a campaign: a table of its runs, a bar, and a line per finished run."""

from __future__ import annotations

import csv
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from torchrl_l1.campaign.evaluation import is_evaluated
from torchrl_l1.campaign.plan import PlannedRun

REFRESH_SECONDS = 2.0


def state(run: PlannedRun) -> str:
    """``waiting``, ``K of N iterations``, ``damaged`` or ``finished``, with evaluations if any."""
    done = run.iterations_done()
    if done < run.iterations:
        started = run.directory.config_file.exists()
        return f"{done} of {run.iterations} iterations" if started else "waiting"
    if not run.finished():
        return "damaged"
    if not run.evaluations:
        return "finished"
    evaluated = sum(is_evaluated(run.directory, settings) for settings in run.evaluations)
    return f"finished, {evaluated} of {len(run.evaluations)} evaluations"


def overview(runs: Sequence[PlannedRun], reused: Mapping[Path, Path] | None = None) -> str:
    """All runs with their states, a line for each, and a summary.

    Args:
        runs: the campaign's runs.
        reused: the finished run that would be copied, by run directory.
    """
    sources = [(reused or {}).get(run.directory.path) for run in runs]
    states = ["reused" if source else state(run) for run, source in zip(runs, sources, strict=True)]
    width = max(map(len, states))
    lines = [
        f"{text:<{width}}  {run}" + (f" from {source}" if source else "")
        for text, run, source in zip(states, runs, sources, strict=True)
    ]
    kinds = Counter(
        text.split(",")[0] if "finished" in text or text in ("waiting", "reused") else "begun"
        for text in states
    )
    done = sum(
        run.iterations if source else run.iterations_done()
        for run, source in zip(runs, sources, strict=True)
    )
    total = sum(run.iterations for run in runs)
    lines.append(
        f"{len(runs)} runs: {kinds['finished']} finished, "
        + (f"{kinds['reused']} reused, " if reused else "")
        + f"{kinds['begun']} begun, "
        f"{kinds['waiting']} waiting; {done} of {total} iterations"
    )
    return "\n".join(lines)


def result(run: PlannedRun) -> str:
    """The result of a finished run, from the last line of its metrics."""
    with run.directory.metrics_file.open(encoding="utf-8", newline="") as file:
        last = list(csv.DictReader(file))[-1]
    return (
        f"return {float(last['return_mean']):.5g} "
        f"(deterministic {float(last['return_deterministic']):.5g}) "
        f"after {last['real_steps']} real steps"
    )


class Progress:
    """A progress bar over the real steps of all runs, read from the runs' own tables.

    Iterations of different tasks take different times; time is closer to proportional to real
    steps.

    Args:
        runs: all runs of the campaign.
    """

    def __init__(self, runs: Sequence[PlannedRun]) -> None:
        self._runs = runs
        self._done = {id(run): run.iterations_done() for run in runs}
        self._ended = {id(run) for run in runs if run.finished()}
        self._to_evaluate = sum(not _is_evaluated(run) for run in runs)
        self._start = time.monotonic()
        self._first = self._steps_done()
        self._total = sum(run.collected_steps(run.iterations) for run in runs)
        self._next = 0.0
        # No smoothing: steps of different tasks take different times, and the mean is steadier.
        self._bar = tqdm(
            total=self._total,
            initial=self._first,
            unit="step",
            unit_scale=True,
            smoothing=0,
            disable=None,
        )

    def tick(self, running: int) -> None:
        """Read the runs' tables again, if it is time to."""
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + REFRESH_SECONDS
        for run in self._runs:
            if self._done[id(run)] < run.iterations:
                self._done[id(run)] = run.iterations_done()
        self._bar.set_postfix_str(f"{running} running, {self._to_evaluate} to evaluate")
        self._bar.update(self._steps_done() - self._bar.n)

    def write(self, line: str) -> None:
        """Print a line above the bar."""
        self._bar.write(line)

    def finished(self, run: PlannedRun) -> None:
        """Report a successful run: print its result and an estimate of the time left."""
        self._done[id(run)] = run.iterations
        self._ended.add(id(run))
        count = f"{len(self._ended)} of {len(self._runs)} runs"
        self.write(f"finished {run}: {result(run)}; {count}{self._time_left()}")

    def evaluated(self, run: PlannedRun) -> None:
        """Report that the evaluations of a run have succeeded."""
        self._to_evaluate -= 1
        self.write(f"evaluated {run}")

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()

    def _steps_done(self) -> int:
        return sum(run.collected_steps(self._done[id(run)]) for run in self._runs)

    def _time_left(self) -> str:
        done = self._steps_done()
        left = self._total - done
        if left == 0 or done == self._first:
            return ""
        seconds = (time.monotonic() - self._start) * left / (done - self._first)
        return f", about {tqdm.format_interval(seconds)} of training left"


def _is_evaluated(run: PlannedRun) -> bool:
    return all(is_evaluated(run.directory, settings) for settings in run.evaluations)
