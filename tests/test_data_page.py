"""What the page on one's own data shows runs as it stands, with shorter fits."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from torchrl_l1.dynamics import fit

PAGE = (Path(__file__).parents[1] / "docs/data.md").read_text(encoding="utf-8")


def write_table(file: Path) -> None:
    """Two runs of a drive that a torque accelerates."""
    random, lines = np.random.default_rng(0), ["time,run,angle,rate,torque"]
    for run in range(2):
        angle = rate = 0.0
        for step in range(60):
            torque = random.uniform(-1, 1)
            lines.append(f"{0.02 * step},{run},{angle},{rate},{torque}")
            angle, rate = angle + 0.02 * rate, rate + 0.1 * torque
    file.write_text("\n".join(lines), encoding="utf-8")


def write_dataset() -> None:
    """Two episodes of a pendulum, as Minari keeps them."""
    import minari
    from minari.data_collector.episode_buffer import EpisodeBuffer

    env, buffers = gymnasium.make("Pendulum-v1", max_episode_steps=40), []
    env.action_space.seed(0)
    for episode in range(2):
        seen, steps = [env.reset(seed=episode)[0]], []
        for _ in range(40):
            action = env.action_space.sample()
            following, *rest, _ = env.step(action)
            seen.append(following)
            steps.append((action, *rest))
        columns = [list(column) for column in zip(*steps, strict=True)]
        buffers.append(EpisodeBuffer(episode, None, None, seen, *columns, {}))
    minari.create_dataset_from_buffers(
        "pendulum/random-v0", buffers, env=env, algorithm_name="none"
    )


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the page's names stand for after all of its snippets have run."""
    snippets = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        # A short fit is no good fit; Minari misses metadata.
        warnings.simplefilter("ignore")
        patch.chdir(tmp_path_factory.mktemp("page"))
        patch.setenv("MINARI_DATASETS_PATH", str(Path.cwd() / "datasets"))
        patch.setitem(fit.FROM_SCRATCH, "max_gradient_steps", 30)
        write_table(Path("drive.csv"))
        for snippet in snippets:
            if "read_minari" in snippet:
                try:
                    write_dataset()
                except ImportError:
                    continue
            exec(compile(snippet, "docs/data.md", "exec"), names)
        names["figure"] = Path("quality.png").stat().st_size
    return names


def test_the_model_serves_l1(names: dict[str, Any]) -> None:
    assert names["env"].rollout(3)["next", "l1", "u_exec"].shape == (3, 1)
    assert names["figure"] > 1000


def test_the_table_is_read_with_its_sampling_time(names: dict[str, Any]) -> None:
    assert names["dt"] == pytest.approx(0.02)
    assert names["drive"].quality.training + names["drive"].quality.validation == 118


def test_the_loaded_model_is_the_saved_one(names: dict[str, Any]) -> None:
    x, u = torch.randn(5, names["model"].observation_dim), torch.randn(5, 1)
    assert torch.equal(names["loaded"](x, u), names["model"](x, u))
