"""The section about the stages of an algorithm that has several."""

from __future__ import annotations

from torchrl_l1.report.learning_curves import plot_stages
from torchrl_l1.report.page import Page
from torchrl_l1.report.rendering import stage_table
from torchrl_l1.report.stage_tables import stage_rows
from torchrl_l1.report.study import Study
from torchrl_l1.report.style import title


def stage_sections(page: Page, study: Study) -> None:
    """What each stage has reached, with L1 and without; nothing where there is one stage only."""
    stages = study.facts.stages
    rows = stage_rows(study)
    if not rows:
        return
    windows = ", ".join(f"{stage.window} of {stage.words}" for stage in stages)
    page.heading(
        "Stages",
        "Return at the end of each stage: of what acts in it, the mean over its last outer "
        f"iterations ({windows}; fewer where there are fewer); mean ± standard deviation over "
        "seeds, 95 % interval of the mean. Differences are between runs of the same seed and "
        "settings. L1 acts around the planner of "
        f"{stages[0].words} and nowhere else: the difference in that stage is what it does there, "
        "to the actions and through the data that the model is fitted to; the differences in "
        "the stages after it are what it has done to what they learn.",
    )
    page.text(stage_table(rows))
    page.csv("stages", rows)
    for task in study.tasks():
        figure = plot_stages(study, task, page.file("stages", task), page.name)
        page.figure(figure, f"The stages, {title(task)}")
