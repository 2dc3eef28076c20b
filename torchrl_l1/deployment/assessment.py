"""What L1 does for a policy under disturbances: episodes, a table and a chart."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_l1.algorithms.collection import ORACLE, seed_streams, stream_seed
from torchrl_l1.control import L1Config, L1Transform, OracleTransform
from torchrl_l1.deployment.learning import Acting, policy_transforms
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import DISTURBANCES, SUITES, EnvironmentSource, suite
from torchrl_l1.envs.factory import acting_on, episode_steps
from torchrl_l1.envs.perturbations import active_disturbances, warn_of_late
from torchrl_l1.experiment.l1_options import OFF, UNTUNED
from torchrl_l1.experiment.matrix import disturbance_words, disturbed
from torchrl_l1.report.page import markdown
from torchrl_l1.report.recovery import controllers, recovered_text, recovery_columns
from torchrl_l1.report.style import arm_label, fit_scale, grid, legend_below, looks, save

Disturbances: TypeAlias = str | Mapping[str, float | Sequence[float]]
"""Name of a suite, or disturbance values by name."""

Row = dict[str, Any]

_ONLY = "the episodes of one policy"


def single_disturbances(disturbances: Disturbances) -> list[dict[str, float]]:
    """What is tested: undisturbed first, then each value of each disturbance by itself, once.

    Args:
        disturbances: a suite of :func:`~torchrl_l1.envs.suite`, or values by name.

    Raises:
        ValueError: for an unknown disturbance or suite, or a value out of a disturbance's range.

    Examples:
        >>> single_disturbances({"bias": [0.0, 0.5], "gain": 0.6})
        [{}, {'bias': 0.5}, {'gain': 0.6}]
    """
    if isinstance(disturbances, str):
        return suite(disturbances)
    if not isinstance(disturbances, Mapping):
        raise ValueError(
            "disturbances are values by name, such as {'bias': [0.5, 1.0]}, or a suite, 'quick', "
            f"got {disturbances!r}"
        )
    cells: list[dict[str, float]] = [{}]
    for name, values in disturbances.items():
        if name not in DISTURBANCES:
            known = ", ".join([*DISTURBANCES, *(f"the suite {one}" for one in SUITES)])
            raise ValueError(f"unknown disturbance {name!r}; there are {known}")
        entry = DISTURBANCES[name]
        for value in np.ravel(np.asarray(values, dtype=float)).tolist():
            entry.check(value)
            # A repeated cell would count its episodes twice.
            if value != entry.neutral and {name: value} not in cells:
                cells.append({name: value})
    return cells


@dataclass(frozen=True)
class Episodes:
    """The first episode of each environment.

    Attributes:
        returns: undiscounted ``(N,)``.
        steps: lengths ``(N,)``.
        switches: of the operating point, per 1000 steps; ``None`` where nothing switches.
    """

    returns: np.ndarray
    steps: np.ndarray
    switches: float | None = None


def run_episodes(
    source: EnvironmentSource,
    policy: TensorDictModuleBase,
    disturbances: Mapping[str, float],
    control: Sequence[Transform],
    episodes: int,
    most_steps: int,
    seed: int,
) -> TensorDictBase:
    """Deterministic episodes ``[N, T]``; rows that end early repeat their last step.

    With the same seed, episodes of the same number start from the same reset whatever the
    disturbance and the control. Without either, a warning reports actions beyond the bounds.
    """
    extra = [*policy_transforms(policy, source.one), *control]
    env = source.several(episodes, disturbances, extra)
    env.set_seed(stream_seed(seed, "evaluate") % 2**31)
    seed_streams(seed, "evaluate")
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        acting = Acting(policy, env.full_action_spec["action"])
        data = env.rollout(most_steps, acting, break_when_any_done=False, break_when_all_done=True)
    if not disturbances and not control:
        acting.warn_of_bounds()
    rows = env.batch_size.numel()
    env.close()
    return data if data.ndim == 2 else data.reshape(rows, -1)


def summarize_episodes(data: TensorDictBase) -> Episodes:
    """Returns, lengths and switches of what :func:`run_episodes` returned."""
    done = data["next", "done"].squeeze(-1)
    running = done.cumsum(1) - done.long() == 0
    rewards = data["next", "reward"].squeeze(-1).double()
    switch = data.get(("next", "l1", "switch"), None)
    return Episodes(
        (rewards * running).sum(1).numpy(),
        running.sum(1).numpy(),
        None if switch is None else 1000 * float(switch.squeeze(-1)[running].double().mean()),
    )


@dataclass(frozen=True)
class Assessment(Sequence[Row]):
    """Rows of a test, one for each disturbance and controller; ``str`` gives a table of them.

    Attributes:
        heading: what was tested.
        rows: with a column for each tested disturbance, ``l1``, ``episodes``, ``return_median``,
            ``_lowest``, ``_highest`` and ``_mean``, ``steps_median``,
            ``switches_per_1000_steps`` and, with an oracle, those of
            :func:`~torchrl_l1.report.recovery.recovery_columns`.
        episodes: rows of single episodes.
    """

    heading: str
    rows: Sequence[Row]
    episodes: Sequence[Row]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    @property
    def controllers(self) -> list[str]:
        """The controllers in column order, the oracle last."""
        return controllers(self.rows)

    def __str__(self) -> str:
        lines = []
        lengths = {row["steps_median"] for row in self.rows}
        shown = [l1 for l1 in self.controllers if l1 not in UNTUNED]
        oracle = ORACLE in self.controllers
        for words, found in self._lines().items():
            line = {"disturbance": words}
            for l1 in self.controllers:
                line[arm_label(l1)] = _cell(found.get(l1), len(lengths) > 1)
            for l1 in shown if oracle else ():
                line[f"{arm_label(l1)} recovered"] = recovered_text(found.get(l1, {}))
            lines.append(line)
        return markdown(lines)

    def _lines(self) -> dict[str, dict[str, Row]]:
        lines: dict[str, dict[str, Row]] = {}
        for row in self.rows:
            lines.setdefault(disturbance_words(row), {})[row["l1"]] = row
        return lines

    @property
    def words(self) -> str:
        """What the cells of the table show."""
        count = self.rows[0]["episodes"]
        text = (
            f"Median return of {count} episode{'s' * (count != 1)} [lowest, highest]"
            + ", median number of steps" * (len({row["steps_median"] for row in self.rows}) > 1)
            + "."
        )
        if ORACLE in self.controllers:
            text += (
                " The oracle is told the disturbance. Recovered is (L1 − off) / (oracle − off) of "
                f"mean returns with its 95 % interval over {_ONLY}; it is empty where oracle and "
                "L1 off do not differ significantly."
            )
        return text

    def plot(self, file: str | Path) -> Path:
        """Draw returns, and lengths where they differ, against each disturbance.

        If every disturbance is tested at several magnitudes, each has its own panels, with medians
        as lines and ranges as bands; otherwise there is one bar chart of all.

        Returns:
            the file.
        """
        values = {"return": "return (sum of rewards)"}
        if len({row["steps_median"] for row in self.rows}) > 1:
            values["steps"] = "steps of an episode"
        varied = self._varied()
        lines = {name: rows for name, rows in varied.items() if len({r[name] for r in rows}) > 2}
        if lines and len(lines) == len(varied):
            panels = [(name, value) for value in values for name in lines]
            figure, axes = grid(len(panels), columns=len(lines), width=5.4, height=3.3)
            for axis, (name, value) in zip(axes, panels, strict=True):
                self._draw_line(axis, name, lines[name], value, values[value])
            if "return" in values:
                drawn = [a for a, (_, value) in zip(axes, panels, strict=True) if value == "return"]
                fit_scale(drawn, [[row["return_lowest"] for row in self.rows]])
        else:
            count = len(self._lines())
            figure, axes = grid(
                len(values), columns=len(values), width=5.6, height=1.4 + 0.5 * count
            )
            for axis, value in zip(axes, values, strict=True):
                self._draw_bars(axis, value, values[value])
        figure.suptitle(self.heading, fontsize=11)
        legend_below(figure, axes)
        file = Path(file)
        file.parent.mkdir(parents=True, exist_ok=True)
        return save(figure, file)

    def _varied(self) -> dict[str, list[Row]]:
        """For each name, the rows in which no other disturbance acts, undisturbed ones included."""
        names = dict.fromkeys(name for row in self.rows for name in disturbed(row))
        return {
            name: [
                {**row, name: disturbed(row).get(name, DISTURBANCES[name].neutral)}
                for row in self.rows
                if disturbed(row).keys() <= {name}
            ]
            for name in names
        }

    def _draw_line(self, axis: Any, name: str, rows: Sequence[Row], what: str, words: str) -> None:
        for l1, look in looks(self.controllers).items():
            mine = sorted((row for row in rows if row["l1"] == l1), key=lambda row: row[name])
            x = [row[name] for row in mine]
            axis.plot(
                x, [row[f"{what}_median"] for row in mine], "--" if l1 == ORACLE else "-",
                color=look.color, marker=look.marker, markersize=4, label=arm_label(l1),
            )  # fmt: skip
            low, high = ([row[f"{what}_{side}"] for row in mine] for side in ("lowest", "highest"))
            axis.fill_between(x, low, high, color=look.color, alpha=0.15, linewidth=0)
        entry = DISTURBANCES[name]
        axis.set_xlabel(f"{entry.words} ({entry.units})")
        axis.set_ylabel(words)
        axis.grid(alpha=0.3)

    def _draw_bars(self, axis: Any, what: str, words: str) -> None:
        lines = self._lines()
        thick = 0.8 / len(self.controllers)
        drawn_as = looks(self.controllers)
        for index, l1 in enumerate(self.controllers):
            places = [place for place, found in enumerate(lines.values()) if l1 in found]
            mine = [found[l1] for found in lines.values() if l1 in found]
            middle = [row[f"{what}_median"] for row in mine]
            y = [place + (index - (len(self.controllers) - 1) / 2) * thick for place in places]
            shade = drawn_as[l1].color
            axis.barh(y, middle, thick, color=shade, alpha=0.8, label=arm_label(l1))
            ranges = [(row[f"{what}_lowest"], row[f"{what}_highest"]) for row in mine]
            axis.hlines(y, *zip(*ranges, strict=True), color="black", linewidth=0.8)
        axis.set_yticks(range(len(lines)), list(lines), fontsize=8)
        axis.invert_yaxis()
        axis.set_xlabel(words)
        axis.grid(axis="x", alpha=0.3)


def _cell(row: Row | None, with_steps: bool) -> str:
    if row is None:
        return "–"
    low, middle, high = (f"{row[f'return_{w}']:.4g}" for w in ("lowest", "median", "highest"))
    text = middle if low == high else f"{middle} [{low}, {high}]"
    return f"{text}, {row['steps_median']:.0f} steps" if with_steps else text


def assess(
    source: EnvironmentSource,
    policy: TensorDictModuleBase,
    model: EnsembleDynamics,
    configs: Mapping[str, L1Config],
    disturbances: Disturbances,
    episodes: int,
    most_steps: int,
    seed: int,
    on_cell: Callable[[int], object] | None = None,
    heading: str = "",
) -> Assessment:
    """Test a policy under disturbances without L1, with each setting of L1 and with the oracle.

    Args:
        source: makes the environments.
        policy: the policy.
        model: the learned dynamics.
        configs: settings of L1 by the name of their column.
        disturbances: what to test. Disturbances of a suite that cannot act on the environment are
            left out.
        episodes: number of episodes per cell.
        most_steps: number of steps after which an episode is cut off.
        seed: seed of resets and random disturbances.
        on_cell: called with the total number of cells after each cell, for progress bars.
        heading: heading of the chart.
    """
    cells = single_disturbances(disturbances)
    longest = min(most_steps, episode_steps(source))
    if isinstance(disturbances, str):
        cells = list(filter(acting_on(source, longest), cells))
    for cell in cells:
        warn_of_late(active_disturbances(cell), longest)
    names = list(dict.fromkeys(name for cell in cells for name in cell))
    todo = [
        (cell, l1)
        for cell in cells
        for l1 in (OFF, *configs, ORACLE)
        if l1 != ORACLE or all(DISTURBANCES[name].matched for name in cell)
    ]
    if not any(cell and l1 == ORACLE for cell, l1 in todo):
        todo = [one for one in todo if one[1] != ORACLE]  # there is no disturbance to tell it
    rows, single = [], []
    for cell, l1 in todo:
        control: list[Transform] = []
        if l1 == ORACLE:
            control = [OracleTransform()]
        elif l1 != OFF:
            control = [L1Transform(model, configs[l1])]
        data = run_episodes(source, policy, cell, control, episodes, most_steps, seed)
        found = summarize_episodes(data)
        place = {name: cell.get(name, DISTURBANCES[name].neutral) for name in names} | {"l1": l1}
        rows.append(place | _columns(found, configs.get(l1)))
        pairs = zip(found.returns.tolist(), found.steps.tolist(), strict=True)
        single += [
            {**place, "episode": number, "return": value, "steps": steps}
            for number, (value, steps) in enumerate(pairs)
        ]
        if on_cell is not None:
            on_cell(len(todo))
    _add_recovered(rows, single, names)
    return Assessment(heading, rows, single)


def _columns(found: Episodes, config: L1Config | None) -> Row:
    row: Row = {"episodes": len(found.returns), "return_mean": float(found.returns.mean())}
    for what, values in (("return", found.returns), ("steps", found.steps)):
        row[f"{what}_median"] = float(median(values.tolist()))
        row[f"{what}_lowest"], row[f"{what}_highest"] = float(values.min()), float(values.max())
    if config is not None and not config.follows_input and found.switches is not None:
        row["switches_per_1000_steps"] = found.switches
    return row


def _add_recovered(rows: Sequence[Row], episodes: Sequence[Row], names: Sequence[str]) -> None:
    def cell(row: Row) -> tuple[Any, ...]:
        return tuple(row[name] for name in names)

    returns: dict[tuple[Any, ...], dict[str, list[float]]] = {}
    for row in episodes:
        returns.setdefault(cell(row), {}).setdefault(row["l1"], []).append(row["return"])
    for row in rows:
        found = returns[cell(row)]
        if row["l1"] not in UNTUNED and ORACLE in found:
            compared: list[dict[Hashable, list[float]]] = [
                {_ONLY: found[l1]} for l1 in (OFF, row["l1"], ORACLE)
            ]
            row |= recovery_columns(*compared)
