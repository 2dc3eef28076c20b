"""The results of each stage of an algorithm with several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l1.algorithms.facts import Stage
from torchrl_l1.report.curves import Panel, main_lines, plot_panels, stage_bands
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.page import (
    Page,
    Row,
    difference_text,
    grouped,
    markdown,
    number,
    return_text,
    values_text,
)
from torchrl_l1.report.runs import Run, l1_means
from torchrl_l1.report.statistics import difference_summary, mean_summary
from torchrl_l1.report.study import Study, place_columns, with_baselines
from torchrl_l1.report.style import arm_label, named, title

_SHOWN = ("switches_per_1000", "u_a")


def stage_sections(page: Page, study: Study) -> None:
    """The results of each stage with and without L1; nothing if no run is finished."""
    stages = study.facts.named_stages
    rows = stage_rows(study)
    if not rows:
        return
    windows = ", ".join(f"{stage.window} of {stage.words}" for stage in stages)
    page.heading(
        "Stages",
        "Return at the end of each stage: of what acts in it, the mean over its last outer "
        f"iterations ({windows}; fewer if it has fewer); mean ± standard deviation over "
        "seeds, 95 % interval of the mean. Differences are between runs of the same seed and "
        f"settings. L1 acts around the planner of {study.facts.l1_words} and nowhere else: the "
        "difference in that stage is its effect there, on the actions and through the data that "
        "the model is fitted to; the differences in later stages are its effect on what they "
        "learn.",
    )
    page.text(stage_table(rows))
    page.csv("stages", rows)
    for task in study.tasks():
        figure = plot_stages(study, task, page.file("stages", task), page.name)
        page.figure(figure, f"The stages, {title(task)}")


def stage_rows(study: Study) -> list[dict[str, Any]]:
    """The return at the end of each stage of each cell, and L1 less the baseline of the same seed.

    There is a row for each kind of policy whose returns are known in the stage; a planner has no
    ``policy``. ``std`` is the population standard deviation over seeds and ``real_steps`` counts
    from the start of the training. If L1 acts in the stage, there are columns on what it did, as in
    the table of the training. Only finished runs count.
    """
    rows = []
    for cell, runs in study.cells.items():
        for position, stage in enumerate(study.facts.named_stages):
            done = [run for run in runs if run.finished and run.during(position).any()]
            ends = [run.end_of(position, stage.window) for run in done]
            for policy in stage.kinds if done else ():
                returns = [stage_return(run, position, stage, policy) for run in done]
                rows.append(
                    {
                        **place_columns(cell),
                        "stage": stage.name,
                        "policy": "" if stage.is_planner else policy,
                        "seeds": len(done),
                        **mean_summary("return", returns),
                        "std": float(np.std(returns)),
                        "return_values": " ".join(f"{value:.6g}" for value in returns),
                        "real_steps": round(float(np.mean([_steps(r, position) for r in done]))),
                        **l1_means(done, ends, _SHOWN),
                        **_differences(study, runs, position, stage, policy),
                    }
                )
    return rows


def stage_return(run: Run, position: int, stage: Stage, policy: str) -> float:
    """Mean return over the last outer iterations of one of the run's stages."""
    returns = run.returns if policy == "stochastic" else run.deterministic
    return float(returns[run.end_of(position, stage.window)].mean())


def _differences(
    study: Study, runs: Sequence[Run], position: int, stage: Stage, policy: str
) -> dict[str, Any]:
    if runs[0].identity.arm == BASELINE:
        return {}
    pairs, single = with_baselines(study, runs)
    differences = [
        stage_return(run, position, stage, policy) - stage_return(base, position, stage, policy)
        for run, base in pairs
    ]
    return {
        "pairs": len(pairs),
        **difference_summary(differences),
        "without_pair": " ".join(single),
    }


def _steps(run: Run, position: int) -> float:
    return float(run.real_steps[run.end_of(position, 1)].item())


def stage_table(rows: Sequence[Row]) -> str:
    """The return at the end of each stage, a column per L1 setting."""
    arms = list(dict.fromkeys(row["l1"] for row in rows))
    lines = []
    keys = ("task", "noise", "variant", "stage", "policy")
    for cell, found in grouped(rows, keys, "l1"):
        on = [arm for arm in arms if arm != BASELINE]
        line = dict(zip(keys, cell, strict=True))
        line["real steps"] = _each(found, "real_steps")
        line |= {f"L1 {arm}": return_text(found.get(arm)) for arm in arms}
        line |= {f"L1 {arm} less off": difference_text(found.get(arm, {})) for arm in on}
        line["seeds"] = _each(found, "seeds")
        line["switches per 1000 steps"] = ", ".join(
            number(found[arm]["switches_per_1000"])
            for arm in on
            if "switches_per_1000" in found.get(arm, {})
        )
        lines.append(line)
    return markdown(lines)


def _each(found: Mapping[str, Row], column: str) -> str:
    return values_text({arm_label(arm): str(row[column]) for arm, row in found.items()})


def plot_stages(study: Study, task: str, file: Path, name: str = "") -> Path | None:
    """The same cells with a panel for each noise and stage, because the first stages are short.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    panels = []
    for noise, lines in main_lines(study, task):
        for position, band in enumerate(stage_bands(study, lines)):
            heading = f"{named(name, title(task, noise))}: {band.label}"
            panels.append(Panel(heading, lines, stage=position))
    return plot_panels(panels, file, same_scale=True)
