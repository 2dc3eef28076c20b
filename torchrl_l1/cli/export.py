"""``torchrl-l1 export``: policy and L1 as one function in a file."""

from __future__ import annotations

import argparse

from torchrl_l1.deployment import export, load_target
from torchrl_l1.deployment.export import FORMATS
from torchrl_l1.deployment.robust_controller import PRESETS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``torchrl-l1 export``."""
    add = parser.add_argument
    add("target", help="a controller's folder or a run directory")
    add("file", help=f"file to write; the suffix sets the format: {', '.join(FORMATS)}")
    add("--format", choices=sorted(set(FORMATS.values())), help="if the suffix does not tell")
    add("--l1", choices=PRESETS, help="L1 preset; the target's own by default, else robust")
    add("--without-policy", action="store_true", help="L1 alone: the action is a second input")
    add("--steps", type=int, default=100, help="number of steps compared with the original")
    add("--seed", type=int, default=0, help="seed of those steps")
    add("--trust", action="store_true", help="run the functions and pickles that a folder names")


def export_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 export``: write the file; print its inputs, outputs and accuracy."""
    found = export(
        load_target(options.target, trusted=options.trust),
        options.file,
        format=options.format,
        preset=options.l1,
        with_policy=not options.without_policy,
        steps=options.steps,
        seed=options.seed,
    )
    print(f"Inputs:  {', '.join(found.inputs)}")
    print(f"Outputs: {', '.join(found.outputs)}")
    print(f"Step:    {found.dt:.6g} s, preset {found.preset}")
    if found.transforms:
        print(f"Outside: {', '.join(found.transforms)}")
    print(f"Largest difference in {found.steps} steps: {found.error:.3g} action units")
    print(f"File: {found.file}")
