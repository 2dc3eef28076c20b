"""``torchrl-l1 play``: an episode in a window or a film, with L1 off or on."""

from __future__ import annotations

import argparse
from pathlib import Path

from torchrl_l1.deployment import load_target
from torchrl_l1.deployment.play import check_film, film, show_film, side_by_side, write_film
from torchrl_l1.deployment.robust_controller import PRESETS
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.envs.rendering import RenderingUnavailable
from torchrl_l1.experiment.files import make_place
from torchrl_l1.experiment.l1_options import OFF


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``torchrl-l1 play``."""
    add = parser.add_argument
    add("target", help="a controller's folder, a run directory, or an environment with --policy")
    add("--policy", help="policy for an environment, see robustify; it then has no L1")
    add("--normalization", metavar="FILE", help="statistics of VecNormalize, see robustify")
    add("--trust", action="store_true", help="run the functions and pickles that a folder names")
    add("--weights", metavar="FILE", help="a state dict to load into the policy's module")
    add(
        "--l1",
        choices=(OFF, *PRESETS),
        help="off or an L1 preset; the target's own by default, else robust",
    )
    add("--compare", action="store_true", help="show L1 off and on side by side")
    add("--steps", type=int, default=500, help="number of steps after which the episode is cut off")
    add("--seed", type=int, default=0, help="seed of reset and disturbances")
    add("--output", metavar="FILE", help="write a film, .mp4 or .gif, instead of opening a window")
    group = parser.add_argument_group("disturbances")
    for name, entry in DISTURBANCES.items():
        group.add_argument(f"--{name}", type=float, help=f"one of the {entry.help}")


def play_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 play``: open a window, or write a film and print its path."""
    output = Path(options.output) if options.output else None
    check_film(output)
    if options.steps < 1:
        raise ValueError(f"--steps must be positive, got {options.steps}")
    given = {name: getattr(options, name) for name in DISTURBANCES}
    disturbances = {name: value for name, value in given.items() if value is not None}
    robust = load_target(
        options.target,
        options.policy,
        options.normalization,
        options.weights,
        trusted=options.trust,
    )
    if output is not None:
        make_place(output)
    on = options.l1 or robust.preset
    if options.compare and options.l1 == OFF:
        raise ValueError("--compare shows L1 off beside L1 on: give --l1 robust, or leave it out")
    if options.compare or on != OFF:
        robust.settings(on)
    try:
        films = [
            film(robust, l1, disturbances, steps=options.steps, seed=options.seed)
            for l1 in ([OFF, on] if options.compare else [on])
        ]
    except RenderingUnavailable as error:
        raise ValueError(str(error)) from error
    for one in films:
        end = "ended" if one.ended else "cut off"
        print(f"{one.label}: return {one.total:.6g}, {end} after {len(one.frames)} steps")
    frames = side_by_side(films)
    dt = robust.source.time_step() or 0.04
    if output is None:
        show_film(frames, dt, robust.source.name)
    else:
        print(f"Film: {write_film(frames, output, dt)}")
