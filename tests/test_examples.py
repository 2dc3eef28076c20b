"""The examples of own policies and the tutorial: they run, and are as short as the page says."""

from __future__ import annotations

import ast
import importlib.util
import runpy
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import pytest

import torchrl_l1
from torchrl_l1.deployment import RobustController, robustify
from torchrl_l1.dynamics import FitConfig

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "docs" / "examples"
SCRIPTS = ("sb3_ppo", "torchrl_sac", "dm_control_lqr", "minari_clone")


def load(file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """A folder with the scripts in which all is small; what they evaluated."""
    tables = []

    def quickly(*arguments: Any, **settings: Any) -> RobustController:
        settings |= {"steps": 300, "environments": 2, "model": {"hidden": [8]}, "progress": False}
        fit = FitConfig(max_epochs=5, batch_size=50)
        return robustify(*arguments, **settings, fit=fit)

    evaluate = RobustController.evaluate

    def briefly(self: RobustController, disturbances: Any, **settings: Any) -> Any:
        settings |= {"episodes": 2, "most_steps": 10}
        tables.append(evaluate(self, disturbances, **settings))
        return tables[-1]

    monkeypatch.setattr(torchrl_l1, "robustify", quickly)
    monkeypatch.setattr(RobustController, "evaluate", briefly)
    for file in EXAMPLES.glob("*.py"):
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    for name in [file.stem for file in EXAMPLES.glob("*.py")]:
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tables


def run(name: str, printed: pytest.CaptureFixture[str]) -> str:
    runpy.run_path(f"{name}.py")
    return printed.readouterr().out


@pytest.mark.parametrize("name", SCRIPTS)
def test_at_most_eight_lines(name: str) -> None:
    text = (EXAMPLES / f"{name}.py").read_text()
    docstring, *statements = ast.parse(text).body
    assert isinstance(docstring, ast.Expr)
    lines = text.splitlines()[statements[0].lineno - 1 :]
    assert len([line for line in lines if line.strip()]) <= 8


@pytest.mark.filterwarnings("ignore:the model is too poor")
def test_sac_of_torchrl(small: list[Any], tmp_path: Path, capsys) -> None:
    load(tmp_path / "torchrl_sac_training.py").train("sac.pt", 300, random_steps=200)
    printed = run("torchrl_sac", capsys)
    assert str(small[0]) in printed
    assert {row["bias"] for row in small[0]} == {0.0, 0.25, 0.5, 1.0}


def record_without_jax(name: str, episodes: int, steps: int) -> None:
    """What `record` of the script does with Minari's DataCollector, which needs jax."""
    import minari
    from minari.data_collector.episode_buffer import EpisodeBuffer

    env, buffers = gymnasium.make("InvertedPendulum-v5", max_episode_steps=steps), []
    env.action_space.seed(0)
    for episode in range(episodes):
        seen, rows, done = [env.reset(seed=episode)[0]], [], False
        while not done:
            action = env.action_space.sample()
            following, reward, terminated, truncated, _ = env.step(action)
            seen.append(following)
            rows.append((action, reward, terminated, truncated))
            done = terminated or truncated
        columns = [list(column) for column in zip(*rows, strict=True)]
        buffers.append(EpisodeBuffer(episode, None, None, seen, *columns, {}))
    minari.create_dataset_from_buffers(name, buffers, env=env, algorithm_name="random")


@pytest.mark.filterwarnings("ignore")  # Minari's, of metadata and folders, and a poor model's
@pytest.mark.parametrize("recorded", [True, False], ids=["by its collector", "without jax"])
def test_a_clone_of_a_minari_dataset(
    recorded: bool, small: list[Any], tmp_path: Path, capsys
) -> None:
    pytest.importorskip("minari")
    making = load(tmp_path / "minari_clone_data.py")
    if recorded:
        pytest.importorskip("jax")
        making.record(episodes=4, steps=60)
    else:
        record_without_jax(making.DATASET, 30, 60)
    making.clone(epochs=2)
    assert "| bias 1 |" in run("minari_clone", capsys)


@pytest.mark.filterwarnings("ignore")
def test_ppo_of_stable_baselines(small: list[Any], capsys) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    sb3.PPO("MlpPolicy", "InvertedPendulum-v5", seed=0, device="cpu").save("ppo.zip")
    assert "| bias 1.5 |" in run("sb3_ppo", capsys)


@pytest.mark.filterwarnings("ignore:the model is too poor")
def test_a_regulator_on_dm_control(small: list[Any], capsys) -> None:
    pytest.importorskip("dm_control")
    assert "| bias 0.4 |" in run("dm_control_lqr", capsys)


def test_cells_of_a_script_become_a_page(tmp_path: Path) -> None:
    tutorial = load(ROOT / "docs" / "_tutorial.py")
    script = tmp_path / "lesson.py"
    script.write_text(
        '"""Not shown."""\n\n# %% [markdown]\n# # A sum\n#\n# of two.\n\n'
        "# %%\nx = 1 + 1\nprint(x)\n\n"
        '# %%\nprint("| a |")\nprint("|---|")\n\n# %%\nopen("plot.png", "w").close()\n'
    )
    tutorial.write(script, tmp_path / "pages")
    page = tmp_path / "pages" / "lesson.md"
    assert page.read_text().partition("\n")[2] == (
        "# A sum\n\nof two.\n\n```python\nx = 1 + 1\nprint(x)\n```\n\n```text\n2\n```\n\n"
        '```python\nprint("| a |")\nprint("|---|")\n```\n\n| a |\n|---|\n\n'
        '```python\nopen("plot.png", "w").close()\n```\n\n![plot](pages/plot.png)\n'
    )
    # What is up to date is not run again; what has changed is.
    page.write_text(page.read_text().replace("of two", "of three"))
    tutorial.write(script, tmp_path / "pages")
    assert "of three" in page.read_text()
    script.write_text(script.read_text().replace("1 + 1", "1 + 2"))
    tutorial.write(script, tmp_path / "pages")
    assert "```text\n3\n```" in page.read_text()


def test_the_tutorial_is_made_of_such_cells() -> None:
    tutorial = load(ROOT / "docs" / "_tutorial.py")
    cells = tutorial.cells((ROOT / "docs" / "tutorial.py").read_text())
    for is_code, body in cells:
        if is_code:
            compile(body, "tutorial.py", "exec")
    assert sum(is_code for is_code, _ in cells) > 4
