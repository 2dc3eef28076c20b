"""The Python of the page on planning runs from top to bottom, with fewer frames."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from torchrl_l1 import planning

PAGE = (Path(__file__).parents[2] / "docs/planning.md").read_text()


@pytest.fixture(scope="module")
def names() -> dict[str, object]:
    source = "\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))
    source, changed = re.subn(
        r"frames_per_batch=200,(\s+)total_frames=600",
        r"frames_per_batch=4,\1total_frames=8",
        source,
    )
    source = source.replace("rollout(1000,", "rollout(100,").replace(
        "max_epochs=40", "max_epochs=2"
    )
    assert changed == 1
    found: dict[str, object] = {}
    exec(compile(source, "docs/planning.md", "exec"), found)
    return found


def test_the_model_learns_from_what_was_collected(names):
    assert len(names["buffer"]) == 100 + 8


def test_a_task_of_ours(names):
    first, second = names["steps"]
    assert first.shape == (4, 5)
    # Batches continue each other's episodes, and their plans.
    assert torch.equal(torch.cat([first, second], 1), torch.arange(1, 11).expand(4, 10))


def test_any_function_of_sequences(names):
    plan, evaluate = names["plan"], names["evaluate"]
    assert plan.actions.shape == (2, 25, 1)
    achieved = evaluate(plan.actions[:, None])[:, 0]
    assert (achieved > evaluate(torch.zeros(2, 1, 25, 1))[:, 0]).all()
    # Far off, full force towards the origin comes first.
    torch.testing.assert_close(plan.actions[:, 0, 0].sign(), torch.tensor([-1.0, 1.0]))


def test_all_public_names_are_on_the_page():
    table = PAGE[PAGE.index("## Public names") :]
    assert [name for name in planning.__all__ if f"`{name}`" not in table] == []
