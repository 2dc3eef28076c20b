"""``torchrl-l1 dataset``: record data with a run's policy for offline learning."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from torchrl_l1.experiment.datasets import is_minari_name
from torchrl_l1.experiment.episodes import check_output, write_dataset
from torchrl_l1.experiment.errors import typed_override
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.files import make_place
from torchrl_l1.experiment.recording import QUALITIES, record


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``torchrl-l1 dataset``."""
    add = parser.add_argument
    add("run_dir", help="the run directory whose policy is used")
    add(
        "output",
        help="a .npz file, a folder, or a name such as hopper/medium-v0 for a Minari dataset",
    )
    add(
        "--quality",
        choices=QUALITIES,
        default="expert",
        help="random actions; the policy with enough noise for a return a third to a half of the "
        "way from random to expert; or the policy",
    )
    add("--steps", type=int, default=20_000, help="minimum number of steps, in whole episodes")
    add("--seed", type=int, default=0, help="seed of resets, actions and noise")


def dataset_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 dataset``: write the dataset and a line on its quality."""
    check_output(options.output)
    trained = load_run(options.run_dir)
    if not is_minari_name(options.output):
        make_place(Path(options.output))
    found = record(trained, options.quality, options.steps, options.seed, print)
    task = trained.algorithm.task
    algorithm = f"{trained.recipe.algorithm} {options.quality}"
    name = write_dataset(options.output, found.episodes, task, algorithm)
    print(
        f"{task.name}, {options.quality}: {found.transitions} transitions in "
        f"{len(found.episodes)} episodes, mean return {found.returns[1]:.4g}"
        + (f", {found.share:.2f} of the way from random to expert" * (found.share == found.share))
    )
    # Hydra accepts such names as they are; others need quotes.
    plain = re.fullmatch(r"[\w./+-]+", name)
    override = f"dataset={name}" if plain else typed_override("dataset", name)
    print(f"Dataset: {name}\nTo learn from it: torchrl-l1 run offline/... {override}")
