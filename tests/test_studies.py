"""The numbers of the studies' pages are those of the files that their commands write."""

from __future__ import annotations

import ast
import csv
import importlib
import importlib.util
import re
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs/results"
TABLES = (".md", ".csv")
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")


def script(name: str, monkeypatch: pytest.MonkeyPatch, folder: Path = RESULTS) -> ModuleType:
    """A script of the results' folder, as it is when it is run from there."""
    monkeypatch.syspath_prepend(str(folder))
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


def rows(text: str) -> list[dict[str, str]]:
    """Rows of the first Markdown table in a text."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [dict(zip(cells[0], line, strict=True)) for line in cells[2:]]


def overall() -> dict[str, dict[str, str]]:
    """What is recovered, by task, as the script wrote it."""
    return {row["task"]: row for row in rows((RESULTS / "robust/overall.md").read_text())}


def imported(file: Path) -> Iterator[tuple[str, str]]:
    """Modules of the package that a script imports, and what it takes from them."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchrl_l1"):
            yield from ((node.module, alias.name) for alias in node.names)


def test_scripts_of_the_documentation_find_what_they_import() -> None:
    missing = []
    for file in sorted((ROOT / "docs").rglob("*.py")):
        for module, name in imported(file):
            if not hasattr(importlib.import_module(module), name):
                try:  # a module of the package
                    importlib.import_module(f"{module}.{name}")
                except ModuleNotFoundError:
                    missing.append(f"{file.name}: {module}.{name}")
    assert not missing


def regenerated() -> list[str]:
    """Scripts that `make studies` runs."""
    found = re.search(r"^STUDIES := ((?:.*\\\n)*.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert found is not None
    return found[1].replace("\\\n", " ").split()


@pytest.mark.parametrize("name", regenerated())
def test_tables_are_what_the_scripts_write_from_the_committed_data(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "results"
    shutil.copytree(RESULTS, copy, ignore=shutil.ignore_patterns("*.png", "__pycache__"))
    shutil.copytree(ROOT / "docs/studies", tmp_path / "studies")
    started = time.time_ns()
    before = {file: file.read_text() for file in copy.rglob("*.*") if file.suffix in TABLES}
    # Else that of another test would be taken for the copy's.
    for other in copy.glob("*.py"):
        monkeypatch.delitem(sys.modules, other.stem, raising=False)
    with monkeypatch.context() as alone:
        alone.setattr(sys, "argv", [f"{name}.py"])
        # Figures are not compared, and to draw them takes longer than all else.
        alone.setattr(Figure, "savefig", lambda *_, **__: None)
        script(name, alone, copy).main()
    written = [file for file in copy.rglob("*.md") if file.stat().st_mtime_ns > started]
    assert written, "it has written nothing, or elsewhere"
    after = {file: file.read_text() for file in copy.rglob("*.*") if file.suffix in TABLES}
    assert [file.name for file in after if before.get(file) != after[file]] == []


def section(page: str, heading: str) -> str:
    text = (ROOT / page).read_text().partition(heading)[2]
    assert text, f"{page} has no {heading!r}"
    return text


def test_readme_shows_what_is_recovered() -> None:
    text = (ROOT / "README.md").read_text()
    shown = rows(text[text.index("| share of the oracle's gain |") :].partition("\n\n")[0])
    assert shown == rows((RESULTS / "questions/recovered.md").read_text())
    for line, l1 in zip(shown, ("paper", "robust"), strict=True):
        assert list(line.values())[1:] == [overall()[task][f"{l1} recovers"] for task in TASKS]


@pytest.mark.parametrize("algorithm", ["METRPO", "MBMF"])
def test_table_of_the_paper_is_that_of_the_runs(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    questions = script("questions", monkeypatch)
    monkeypatch.setattr(questions, "HERE", tmp_path)
    table = getattr(questions, algorithm)
    questions.cells_of(table)
    name = f"table{table.number}.md"
    written = (tmp_path / name).read_text()
    assert written == (RESULTS / "questions" / name).read_text()
    cells = rows(written)
    assert len(cells) == len(table.arms) * 15
    checked = 0
    for row in cells:
        for pair in pairs(row["runs of"]):
            if all(pair[name] == row[shown] for name, shown in KEYS.items()) and row["difference"]:
                given = float(pair["difference_mean"])
                assert float(row["difference"]) == pytest.approx(given, rel=6e-3)
                assert row["pairs"] == pair["pairs"]
                checked += 1
    again = [row for row in cells if row["runs of"].endswith(", first training")]
    assert checked == sum(bool(row["difference"]) for row in cells) - len(again) >= 5


KEYS = {"task": "task", "noise": "noise", "l1": "L1"}


def pairs(edition: str) -> list[dict[str, str]]:
    """Paired differences of a report's sampled actions; none of one that has none."""
    file = RESULTS / edition / "pairs.csv"
    if not edition or not file.exists():
        return []
    with file.open(newline="") as handle:
        return [row for row in csv.DictReader(handle) if row["policy"] == "stochastic"]


@pytest.mark.parametrize(
    ("many", "expected"),
    [((0, 2, 1), "table1_first"), ((0, 2, 2), "table1"), ((0, 0, 0), "table1")],
)
def test_cells_are_of_the_edition_with_most_pairs(
    many: tuple[int, int, int], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    questions = script("questions", monkeypatch)
    pairs_of = dict(zip(questions.METRPO.editions, many, strict=True))

    def rows_of(edition: str, name: str) -> list[dict[str, str]]:
        key = {"task": "swimmer", "noise": "none", "variant": ""}
        other = {"variant": "l1.epsilon=1"}
        if name == "training.csv":
            off = key | {"l1": "off", "return_mean": "7"}
            return [off, off | other | {"return_mean": "8"}]
        seeds = list(map(str, range(pairs_of[edition])))
        if name == "runs.csv":
            # One more without L1 than there are pairs.
            runs = [("off", seed) for seed in [*seeds, "9"]] + [("paper", seed) for seed in seeds]
            returns = {"off": 1.0, "paper": 2.0}
            return [
                key | {"l1": l1, "seed": seed, "return": str(returns[l1] + int(seed))}
                for l1, seed in runs
            ]
        counted = {"pairs": str(len(seeds)), "seeds": " ".join(seeds)}
        pair = key | {"l1": "paper", "policy": "stochastic"} | counted
        return [pair | other | {"seeds": "8"}, pair]

    monkeypatch.setattr(questions, "rows", rows_of)
    found = questions.ours(questions.METRPO, "swimmer", "none", "paper")
    assert (found.edition, found.pairs) == (expected, max(many))
    assert (float(found.off), found.on) == ((1.5, "2.5") if max(many) else (7.0, ""))
    assert questions.ours(questions.METRPO, "swimmer", "none", "robust").pair is None
    assert questions.ours(questions.METRPO, "swimmer", "action", "paper") is None


def test_index_quotes_the_tables() -> None:
    table = rows((RESULTS / "questions/table1.md").read_text())
    text = " ".join(section("docs/studies/index.md", "## Does the paper's table hold?").split())
    for row in table:
        if row["L1"] == "paper" and int(row["pairs"]) > 1:
            for name in ("off", "on"):
                value = float(row[name])
                quoted = f"{value:.3f}" if abs(value) < 1 else row[name]
                assert quoted in text, (row, quoted)


def test_page_on_environments_quotes_its_runs() -> None:
    text = " ".join(section("docs/environments.md", "## What to expect").split())
    with (RESULTS / "any_task/reacher.csv").open(newline="") as handle:
        returns = [f"{float(row['return_mean']):.1f}" for row in csv.DictReader(handle)]
    assert f"Reacher returns {returns[0]}, {returns[1]} and {returns[2]}" in text
    learned: dict[str, list[float]] = {}
    with (RESULTS / "any_task/runs.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["name"] == "half_cheetah":
                learned.setdefault(row["seed"], []).append(float(row["return_mean"]))
    last = [f"{sum(found[-5:]) / 5:.0f}" for found in learned.values()]
    assert f"at {last[0]}, {last[1]} and {last[2]}. A learned reward" in text
    precision = rows((RESULTS / "precision/table.md").read_text())
    ours = [row["float32"] for row in precision if row["recipe"] == "metrpo half_cheetah"]
    assert f"[at {ours[0]}, {ours[1]} and {ours[2]}]" in text


def test_page_on_offline_learning_quotes_what_is_recovered() -> None:
    text = " ".join(section("docs/studies/offline.md", "**In short.**").split()).partition("## ")[0]
    found = {
        (row["task"], row["data"]): row
        for row in rows((RESULTS / "offline/recovered.md").read_text())
        if row["bias"] == "all others"
    }
    assert len(found) == 9
    for cell in (("half_cheetah", "medium"), ("half_cheetah", "expert"), ("hopper", "expert")):
        for l1 in ("paper", "robust", "oracle"):
            assert found[cell][l1].replace(", ", " and ") in text, (cell, l1)
    for l1 in ("paper", "robust"):
        assert found["hopper", "medium"][l1].replace(", ", " and ") in text, l1


def second_edition(task: str, noise: str) -> dict[str, dict[str, str]]:
    """What became of a cell of Table 1, by L1: off, the paper's, robust."""
    with (RESULTS / "table1/training.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["task"] == task]
    return {row["l1"]: row for row in rows if row["noise"] == noise}


def test_what_chance_makes_of_a_single_seed_is_quoted() -> None:
    cell = second_edition("swimmer", "observation")
    returns = [f"{float(row['return_mean']):.3g}" for row in cell.values()]
    added = f"{float(cell['robust']['u_a']):.6f}"
    for page in ("index", "table1"):
        text = (ROOT / f"docs/studies/{page}.md").read_text()
        assert all(value in text for value in (*returns, added)), page


def test_what_observation_noise_costs_the_pendulum_is_quoted() -> None:
    cell = second_edition("inverted_pendulum", "observation")
    with (RESULTS / "table1/pairs.csv").open(newline="") as handle:
        pairs = {
            row["l1"]: [float(one) for one in row["differences"].split()]
            for row in csv.DictReader(handle)
            if (row["task"], row["noise"]) == ("inverted_pendulum", "observation")
            and row["policy"] == "stochastic"
        }
    text = " ".join((ROOT / "docs/studies/table1.md").read_text().split())
    off, on = (float(cell[arm]["return_mean"]) for arm in ("off", "paper"))
    assert f"in both pairs of the second edition, {off:.1f} against {on:.1f}" in text
    curves: dict[tuple[str, str], list[float]] = {}
    with (RESULTS / "table1/learning_curves.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if (row["task"], row["noise"]) == ("inverted_pendulum", "observation"):
                curves.setdefault((row["l1"], row["seed"]), []).append(float(row["return"]))
    late = {run: f"{sum(found[-10:]) / 10:.1f}" for run, found in curves.items()}
    one, other = ((late["off", seed], late["paper", seed]) for seed in ("0", "1"))
    words = f"one pair is even, {one[0]} and {one[1]}, the other {other[0]} against {other[1]}"
    assert words in text
    assert len(pairs["paper"]) == 2 and max(pairs["paper"]) < 0
    gain, loss = pairs["robust"]
    assert f"one gains {gain:.1f} and the other loses {-loss:.1f} with it" in text


def test_in_how_many_pairs_of_mbmf_l1_is_ahead_is_quoted() -> None:
    text = " ".join(section("docs/studies/mbmf.md", "**The other ten cells**").split())
    found: dict[str, list[float]] = {}
    with (RESULTS / "mbmf_rest/pairs.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            differences = list(map(float, row["differences"].split()))
            found.setdefault(row["policy"], []).extend(differences)
            if (row["task"], row["noise"], row["policy"]) == ("hopper", "none", "stochastic"):
                one, other = differences
                words = f"one pair differs by {one:.0f} and the other by {round(other, -1):.0f}"
                assert words in text
    with (RESULTS / "mbmf_rest/stages.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            found.setdefault(row["stage"], []).extend(map(float, row["differences"].split()))
    counts = {kind: f"{sum(one > 0 for one in of)} of {len(of)}" for kind, of in found.items()}
    assert f"By sampled actions L1 is ahead in {counts['stochastic']} pairs" in text
    assert f"By mean actions it is ahead in {counts['deterministic']}" in text
    assert f"(ahead in {counts['shooting']})" in text
    assert f"clones perhaps ({counts['cloning']})" in text


def test_what_a_controller_that_hardly_acts_changes_is_quoted() -> None:
    tasks = ("hopper", "walker", "half_cheetah")
    cells = [
        second_edition(task, noise) for task in tasks for noise in ("none", "action", "observation")
    ]
    added = max(float(cell["robust"]["u_a"]) for cell in cells)
    differences = [
        float(row["difference"])
        for row in rows((RESULTS / "questions/table1.md").read_text())
        if row["L1"] == "robust" and row["task"] in tasks
    ]
    text = " ".join((ROOT / "docs/studies/table1.md").read_text().split())
    assert f"from {min(differences):.0f} to {max(differences):.0f}" in text
    assert f"is at most {added:.3f} in the mean" in text


DISTURBANCES = {
    **dict.fromkeys(("actuator delay", "sensor delay"), "delays"),
    "sensor bias": "offset of the sensors",
    "body mass": "heavier bodies",
    "wind force": "in wind",
    "dead zone": "dead zone",
    "joint damping": "changed damping",
    "step bias": "begins in mid-episode",
    "actuator gain": "lower gain",
    "motor gain": "weak motor",
    "stiction": "stiction",
    "payload": "payloads",
    "joint armature": "other armatures",
}


def test_suite_page_names_whatever_the_robust_controller_makes_worse() -> None:
    text = " ".join(section("docs/studies/suite.md", "**In short.**").split())
    first = text.partition("## ")[0].partition("The paper's")[0].replace("late sensor", "delays")
    worse = set()
    for row in rows((RESULTS / "suite/verdicts.md").read_text()):
        for column, verdicts in row.items():
            if verdicts.endswith("/ worse"):
                task = column.partition(" (")[0].title().replace(" ", "")
                of_task = first.partition(task)[2]
                assert DISTURBANCES[row["disturbance"]] in of_task, (task, row["disturbance"])
                worse.add(DISTURBANCES[row["disturbance"]])
    advice = section("docs/studies/index.md", "it is seen to cost return").partition(
        "Other policies"
    )[0]
    for words in DISTURBANCES.values():
        assert words in worse or words not in first + " ".join(advice.split()), words


def test_suite_page_quotes_its_tables() -> None:
    text = section("docs/studies/suite.md", "## Disturbance by disturbance")
    quoted = re.findall(r"(-?\d[\d.]*) to (-?\d[\d.]*)\b", text.partition("## What telling")[0])
    assert len(set(quoted)) > 10
    tables = [row for task in TASKS for row in rows((RESULTS / f"suite/{task}.md").read_text())]

    def in_a_table(off: str, on: str) -> bool:
        half = 0.5001 if "." not in off else 0.05001  # of the last digit
        return any(
            abs(float(row["off"]) - float(off)) <= half
            and min(abs(float(row[l1]) - float(on)) for l1 in ("paper", "robust")) <= half
            for row in tables
        )

    assert [pair for pair in quoted if not in_a_table(*pair)] == []


def test_suite_page_counts_verdicts() -> None:
    text = " ".join(section("docs/studies/suite.md", "**In short.**").split())
    count = {
        row["disturbance"].split("*")[1].rstrip("\\"): [
            sum(int(cell.split(" / ")[arm]) for cell in list(row.values())[2:]) for arm in (0, 1)
        ]
        for row in rows((RESULTS / "suite/verdicts.md").read_text())
        if row["disturbance"].startswith("number")
    }
    assert count["worse"][1] == 3 and "in three of 99 cells" in text
    assert f"In {count['not touched'][1]} cells a change of more than a tenth is excluded" in text
    assert f"in {count['cannot tell'][1]} eight episodes cannot tell" in text
    assert f"costs return in {count['worse'][0]} cells" in text
    assert sum(of[1] for of in count.values()) == 99


def test_suite_page_quotes_what_telling_changes_from_noise_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    suite = script("suite", monkeypatch)
    told = " ".join(section("docs/studies/suite.md", "Ten cells were worse before").split())

    def mean(task: str, l1: str, disturbance: str) -> str:
        of = suite.read(task)
        return f"{suite.sample(of, l1, suite.groups_of(of)[disturbance]).mean():.0f}"

    for task, disturbance, last in (
        ("swimmer", "delay", "off"), ("hopper", "delay", "off"), ("half_cheetah", "step", "oracle"),
    ):  # fmt: skip
        name = task.title().replace("_", "")
        found = re.search(
            rf"{name} (?:returned )?(\S+) and (?:returns )?(\S+) \([^-\d]*(-?\d+)", told
        )
        assert found is not None, task
        assert found.groups() == tuple(
            mean(task, l1, disturbance) for l1 in ("earlier", "robust", last)
        )
    worse = rows((RESULTS / "suite/changed.md").read_text())[-2]
    assert sum(int(cell.split(" / ")[0]) for cell in list(worse.values())[1:]) == 10


def test_theorem_page_quotes_the_residuals_of_the_tasks() -> None:
    with (RESULTS / "theorem1/tasks.csv").open(newline="") as handle:
        tasks = {row["task"]: row for row in csv.DictReader(handle)}
    ratios = [float(row["residual_largest"]) / float(row["residual_0.5"]) for row in tasks.values()]
    text = " ".join(section("docs/studies/theorem.md", "# Theorem 1, measured").split())
    assert f"is {min(ratios):.0f} to {round(max(ratios), -1):.0f} times the median one" in text
    shares = {task: float(row["below_epsilon_a"]) for task, row in tasks.items()}
    walker = shares.pop("walker")
    quoted = f"({walker:.0%} of the residuals on Walker, {min(shares.values()):.0%} and more"
    assert quoted.replace("%", " %") in text


def test_robustness_page_quotes_the_rules_by_which_it_acts() -> None:
    with (RESULTS / "acting.csv").open(newline="") as handle:
        gains = {
            (row["task"], row["condition"], row["seed"], row["rule"]): float(row["difference"])
            for row in csv.DictReader(handle)
        }
    cells = [key[1:3] for key in gains if key[0] == "walker" and key[1] in ("bias 0.2", "bias 0.4")]
    total = {
        rule: sum(gains["walker", *cell, rule] for cell in dict.fromkeys(cells))
        for rule in ("oracle", "dead zone, z = 1", "dead zone, z = 2")
    }
    one, two = (total[f"dead zone, z = {z}"] / total["oracle"] for z in (1, 2))
    text = " ".join((ROOT / "docs/studies/robustness.md").read_text().split())
    assert f"gets back {one:.2f} of the oracle's gain under these two biases" in text
    assert f"where two get back {two:.2f}" in text
    rules = {row["rule"]: row for row in rows((RESULTS / "acting.md").read_text())}
    every, less = (
        re.findall(r"-(\d+)\.\d", rules[rule]["observation noise"])
        for rule in ("everything (z = 0)", "expected estimate subtracted")
    )
    words = "costs {0} and {2} % of the return with noisy observations, {1} and {3} % on the worst"
    assert words.format(*every, *less) in text


def test_the_pendulum_over_the_papers_length_is_quoted() -> None:
    runs: dict[str, dict[tuple[str, str], list[tuple[float, float]]]] = {}
    with (RESULTS / "pendulum_long/learning_curves.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if int(row["real_steps"]) > 30_000:
                curves = runs.setdefault(row["task"], {})
                point = float(row["return"]), float(row["return_deterministic"])
                curves.setdefault((row["l1"], row["seed"]), []).append(point)
    text = " ".join((ROOT / "docs/studies/table1.md").read_text().split())
    clipped, unclipped = runs["inverted_pendulum"], runs["inverted_pendulum_unclamped"]
    assert (len(clipped), len(unclipped)) == (6, 4)
    lowest = min(sampled for curve in clipped.values() for sampled, _ in curve)
    assert f"any iteration is {lowest:.2f} in the six runs" in text
    points = [point for curve in unclipped.values() for point in curve]
    fallen = [point for point in points if point[0] < -10]
    words = f"it is {min(points)[0]:.0f} in four runs, and {len(fallen)} of their {len(points)}"
    assert f"{words} iterations are below -10" in text
    standing = sum(mean > -1 for _, mean in fallen)
    assert f"Of the {len(fallen)}, the mean action still balances (above -1) in {standing}:" in text
    worst = min(unclipped.values(), key=min)
    down = sum(sampled < -10 for sampled, _ in worst)
    assert f"in {down} of its {len(worst)} iterations and ends at {worst[-1][0]:.1f}" in text
    assert sum(min(curve)[0] < -100 for curve in unclipped.values()) == 2


def test_the_authors_returns_after_as_many_steps_are_quoted() -> None:
    none, action = (second_edition("inverted_pendulum", noise) for noise in ("none", "action"))
    cells = (none["off"], none["paper"], action["off"])
    off, on, noisy = (float(row["authors_then_mean"]) for row in cells)
    index, table1 = ((ROOT / f"docs/studies/{page}.md").read_text() for page in ("index", "table1"))
    assert f"the authors' logs say {off:.1f} and {noisy:.0f}" in index
    assert f"the authors' logs are at {off:.1f} without L1 and {on:.1f} with it" in table1
