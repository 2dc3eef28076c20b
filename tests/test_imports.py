"""What loading the package costs, and that nothing is missing for it."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Callable, Iterator
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


# Forks itself for each line of code that it reads.
LOADED = """
import os, sys
import tensordict, torch, torchrl
assert not {"gymnasium", "torchrl_l1"} & sys.modules.keys()
print("loaded", flush=True)
for line in sys.stdin:
    if (child := os.fork()) == 0:
        exec(eval(line), {"__name__": "__main__"})
        sys.stdout.flush()
        os._exit(0)
    print("\\nended", os.waitpid(child, 0)[1], flush=True)
"""


@pytest.fixture(scope="module")
def interpreter() -> Iterator[Callable[[str], str]]:
    """What interpreters print in which TorchRL is loaded already, but no part of this package.

    Loading TorchRL takes seconds.
    """
    command = [sys.executable, "-c", LOADED]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True, bufsize=1) as process:
        assert process.stdout.readline() == "loaded\n"

        def run(code: str) -> str:
            process.stdin.write(repr(code) + "\n")
            lines = []
            while not (line := process.stdout.readline()).startswith("ended "):
                assert line, "it has ended"
                lines.append(line)
            assert line == "ended 0\n"
            return "".join(lines).strip()

        yield run
        process.stdin.close()


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


def test_files_are_locked_and_replaced_where_there_is_no_fcntl(
    tmp_path: Path, interpreter: Callable[[str], str]
) -> None:
    """As on Windows: what needs it is not loaded when a run directory is."""
    code = (
        "import sys; sys.modules['fcntl'] = None\n"
        "from pathlib import Path\n"
        "import torchrl_l1.cli, torchrl_l1.experiment.run_directory\n"
        "from torchrl_l1.experiment.files import write_atomically\n"
        f"write_atomically(Path({str(tmp_path / 'file')!r}), 'text')\n"
        f"print(Path({str(tmp_path / 'file')!r}).read_text())"
    )
    assert interpreter(code).splitlines()[-1] == "text"


def test_the_modules_of_campaigns_load_without_what_windows_lacks(
    interpreter: Callable[[str], str],
) -> None:
    code = """
import os, signal, sys
import torchrl_l1
for module in ("fcntl", "pwd", "grp", "resource", "termios"):
    sys.modules[module] = None
for name in ("killpg", "EX_TEMPFAIL", "sched_getaffinity", "setsid"):
    delattr(os, name)
del signal.SIGKILL
import torchrl_l1.campaign.child, torchrl_l1.campaign.command, torchrl_l1.campaign.workers
assert torchrl_l1.campaign.workers.available_cores() >= 1
print("done")
"""
    assert interpreter(code) == "done"


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


def test_sub_packages_are_there_without_an_import_of_their_own(
    interpreter: Callable[[str], str],
) -> None:
    code = "import torchrl_l1; print(torchrl_l1.planning.cem.plan.__name__)"
    assert interpreter(code) == "plan"


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium; import torchrl_l1",
        "import torchrl_l1.envs; import gymnasium",
        "import torchrl_l1; import gymnasium; torchrl_l1.METRPO",
    ],
)
def test_gymnasium_knows_the_tasks(imports: str, interpreter: Callable[[str], str]) -> None:
    make = "print(gymnasium.make('torchrl_l1/Cartpole-v0').spec.max_episode_steps)"
    assert interpreter(f"{imports}; {make}") == "200"


def test_gymnasium_loads_the_package_that_a_name_begins_with() -> None:
    make = "gymnasium.make('torchrl_l1:torchrl_l1/Cartpole-v0').spec.max_episode_steps"
    assert fresh(f"import gymnasium; print({make})") == "200"


def test_registered_episodes_are_those_of_the_tasks() -> None:
    assert {name: task.horizon for name, task in TASKS.items()} == EPISODE_STEPS
    register_tasks()  # a second time changes nothing
