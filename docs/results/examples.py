"""The examples of own policies, run as a user runs them: what their tables say.

    python docs/results/examples.py [NAME ...] [--folder runs/examples]

Names are those of the scripts in `docs/examples`, all by default; each needs the extra that it
names. What a script loads is made in the folder first, unless it is there. Writes the tables that
the scripts print to `examples/NAME.md`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

EXAMPLES = Path(__file__).parents[1] / "examples"
HERE = Path(__file__).with_suffix("")

PPO = """
from stable_baselines3 import PPO

PPO("MlpPolicy", "InvertedPendulum-v5", seed=2, device="cpu").learn(30_000).save("ppo.zip")
"""

# What each loads, what makes it, and the packages that matter beside torch.
PREPARED: Mapping[str, tuple[str, list[str], tuple[str, ...]]] = {
    "sb3_ppo": ("ppo.zip", ["-c", PPO], ("stable-baselines3", "gymnasium", "mujoco")),
    "torchrl_sac": ("sac.pt", [str(EXAMPLES / "torchrl_sac_training.py")], ("gymnasium",)),
    "dm_control_lqr": ("", [], ("dm_control", "mujoco")),
    "minari_clone": (
        "clone.pt",
        [str(EXAMPLES / "minari_clone_data.py")],
        ("minari", "gymnasium", "mujoco"),
    ),
}


def run(name: str, folder: Path) -> None:
    """Run an example, and keep its table."""
    folder.mkdir(parents=True, exist_ok=True)
    needs, making, packages = PREPARED[name]
    paths = os.pathsep.join([str(EXAMPLES), os.environ.get("PYTHONPATH", "")])
    given = os.environ | {
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": paths,
        "MINARI_DATASETS_PATH": str(folder.resolve() / "datasets"),
    }
    if needs and not (folder / needs).exists():
        subprocess.run([sys.executable, *making], cwd=folder, env=given, check=True)
    for file in EXAMPLES.glob("*.py"):  # as beside the user's own script
        (folder / file.name).write_text(file.read_text())
    wall, busy = time.perf_counter(), _busy()
    printed = subprocess.run(
        [sys.executable, f"{name}.py"],
        cwd=folder,
        env=given,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    ).stdout
    wall, busy = time.perf_counter() - wall, _busy() - busy
    print(printed, f"{wall:.0f} s, {busy:.0f} s of one core", sep="\n")
    table = [line for line in printed.splitlines() if line.startswith("|")]
    versions = ", ".join(f"{package} {version(package)}" for package in ("torchrl", *packages))
    HERE.mkdir(exist_ok=True)
    (HERE / f"{name}.md").write_text(
        "\n".join(table) + f"\n\n{busy:.0f} s of one core; {versions}.\n"
    )


def _busy() -> float:
    usage = getrusage(RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PREPARED))
    parser.add_argument("--folder", type=Path, default=Path("runs/examples"))
    arguments = parser.parse_args()
    for one in arguments.names or PREPARED:
        run(one, arguments.folder)
