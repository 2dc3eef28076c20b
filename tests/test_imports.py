"""What loading the package costs, and that nothing is missing for it."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_l1
from torchrl_l1.envs import TASKS
from torchrl_l1.registration import EPISODE_STEPS, register_tasks

HEAVY = ("torch", "tensordict", "torchrl", "wandb", "matplotlib", "mujoco")


def fresh(code: str) -> str:
    """What a new interpreter prints."""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return run.stdout.strip()


@pytest.mark.parametrize(
    "code",
    [
        "import torchrl_l1",
        "from torchrl_l1.experiment.recipes import available_recipes; available_recipes()",
        "from torchrl_l1.cli import main\ntry: main(['run', '--help'])\nexcept SystemExit: pass",
        "from torchrl_l1.cli import main; main(['recipes'])",
    ],
)
def test_short_commands_load_nothing_heavy(code: str) -> None:
    heavy = f"*[name for name in {HEAVY} if name in sys.modules]"
    loaded = fresh(f"{code}\nimport sys; print('loaded', {heavy})")
    assert loaded.splitlines()[-1] == "loaded"


def test_files_are_locked_and_replaced_where_there_is_no_fcntl(tmp_path: Path) -> None:
    """As on Windows: what needs it is not loaded when a run directory is."""
    code = (
        "import sys; sys.modules['fcntl'] = None\n"
        "from pathlib import Path\n"
        "import torchrl_l1.cli, torchrl_l1.experiment.run_directory\n"
        "from torchrl_l1.experiment.files import write_atomically\n"
        f"write_atomically(Path({str(tmp_path / 'file')!r}), 'text')\n"
        f"print(Path({str(tmp_path / 'file')!r}).read_text())"
    )
    assert fresh(code).splitlines()[-1] == "text"


def test_public_names_are_what_their_packages_export() -> None:
    tree = ast.parse(Path(torchrl_l1.__file__).read_text(encoding="utf-8"))
    blocks = (node for node in tree.body if isinstance(node, ast.If))
    (block,) = (node for node in blocks if ast.unparse(node.test) == "TYPE_CHECKING")
    homes = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert sorted({*homes, "__version__"}) == sorted(torchrl_l1.__all__)
    for name, home in homes.items():
        assert getattr(torchrl_l1, name) is getattr(sys.modules[str(home)], name)
    assert set(torchrl_l1.__all__) <= set(dir(torchrl_l1))
    with pytest.raises(AttributeError, match="no attribute 'L2Transform'"):
        _ = torchrl_l1.L2Transform


def test_sub_packages_are_there_without_an_import_of_their_own() -> None:
    assert fresh("import torchrl_l1; print(torchrl_l1.planning.cem.plan.__name__)") == "plan"


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium; import torchrl_l1",
        "import torchrl_l1.envs; import gymnasium",
        "import torchrl_l1; import gymnasium; torchrl_l1.METRPO",
    ],
)
def test_gymnasium_knows_the_tasks(imports: str) -> None:
    make = "print(gymnasium.make('torchrl_l1/Cartpole-v0').spec.max_episode_steps)"
    assert fresh(f"{imports}; {make}") == "200"


def test_gymnasium_loads_the_package_that_a_name_begins_with() -> None:
    make = "gymnasium.make('torchrl_l1:torchrl_l1/Cartpole-v0').spec.max_episode_steps"
    assert fresh(f"import gymnasium; print({make})") == "200"


def test_registered_episodes_are_those_of_the_tasks() -> None:
    assert {name: task.horizon for name, task in TASKS.items()} == EPISODE_STEPS
    register_tasks()  # a second time changes nothing
