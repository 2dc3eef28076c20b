"""The lists and commands of README and guide are those of the code."""

from __future__ import annotations

import contextlib
import csv
import importlib.util
import io
import math
import re
import shlex
import tomllib
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import get_args

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from torchrl_l1 import planning
from torchrl_l1.algorithms import MBMF
from torchrl_l1.campaign import EvaluationSettings, read_campaign
from torchrl_l1.campaign.jobs import LAUNCHERS
from torchrl_l1.campaign.plan import plan
from torchrl_l1.cli import main
from torchrl_l1.control import L1Config
from torchrl_l1.deployment import load_policy
from torchrl_l1.deployment.policy_files import FILE_KINDS
from torchrl_l1.envs import DISTURBANCES, TASKS, gymnasium_id
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.recipes import available_campaigns, available_recipes, recipes_dir
from torchrl_l1.experiment.settings import SCHEMAS, L1Settings, flatten
from torchrl_l1.experiment.tracking import MODES

ROOT = Path(__file__).parents[1]


@pytest.fixture
def study(tmp_path: Path) -> ModuleType:
    file = ROOT / "docs/results/robustness.py"
    spec = importlib.util.spec_from_file_location("docs_robustness", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.HERE = tmp_path / "results"
    module.HERE.mkdir()
    return module


def write_rows(file: Path, rows: list[dict[str, object]]) -> None:
    with file.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_robustness_page_shows_the_filmstrip(study: ModuleType, tmp_path: Path) -> None:
    cell = {"policy": "stochastic", "training_seeds": 1, "episodes_per_seed": 2}
    cell |= dict.fromkeys(("return_median", "return_lowest", "return_highest"), -1.0)
    rows = [cell | {"l1": on, "bias": bias} for bias in (0.0, -1.5) for on in ("off", "paper")]
    write_rows(tmp_path / "summary.csv", rows)
    write_rows(tmp_path / "evaluation.csv", rows)
    study.robustness(tmp_path)
    assert "filmstrip" not in (study.HERE / "robustness.md").read_text()
    (tmp_path / "filmstrip.png").write_bytes(b"")
    study.robustness(tmp_path)
    page = (study.HERE / "robustness.md").read_text()
    assert "(results/filmstrip.png)" in page and "bias of -1.5" in page


def test_relative_links_lead_somewhere() -> None:
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/studies/*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_files_that_contributing_names_are_there() -> None:
    named = re.findall(r"`([\w/]+(?:\.py|/))`", (ROOT / "CONTRIBUTING.md").read_text())
    assert len(named) > 20
    for name in named:
        assert (ROOT / name).exists() or (ROOT / "torchrl_l1" / name).exists(), name


def words(text: str) -> set[str]:
    """What stands in backticks and is a plain name."""
    return set(re.findall(r"`\"?([A-Za-z_0-9]+)\"?`", text))


def table(page: str, *header: str) -> dict[str, list[str]]:
    """Rows of the table with this header, by the name in their first cell."""
    text = (ROOT / page).read_text()
    start = text.index("|" + "|".join(f" {name} ".replace("  ", " ") for name in header) + "|\n")
    lines = text[start:].partition("\n\n")[0].splitlines()[2:]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    return {row[0].strip("`").partition("`")[0]: row[1:] for row in rows}


def block(page: str, language: str, beginning: str) -> str:
    """A fenced block, by how it begins."""
    blocks = re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    (found,) = [text for text in blocks if text.startswith(beginning)]
    return found


def options(group: str) -> set[str]:
    return {file.stem for file in recipes_dir().glob(f"*/{group}/*.yaml")}


def test_recipes_page_has_every_group_and_option() -> None:
    groups = table("docs/recipes.md", "Group", "Choices")
    folders = {file.parent.name for file in recipes_dir().glob("*/*/*.yaml")} - {"base"}
    assert set(groups) == folders
    for group, (choices,) in groups.items():
        listed = re.sub(r"\(.*?\)", "", choices.partition("; single fields")[0])
        assert words(listed) == options(group), group
    page = (ROOT / "docs/recipes.md").read_text()
    assert {f"{name}_recipe" for name in SCHEMAS} <= words(page)
    assert set(MODES) - {"auto"} <= words(page) and "`wandb.mode=auto`" in page


def test_recipes_page_has_every_key_of_the_controller() -> None:
    page = (ROOT / "docs/recipes.md").read_text()
    named = {word.partition(".")[2] for word in re.findall(r"`(l1\.\w+)`", page)}
    assert named == set(L1Settings.__dataclass_fields__)


def test_a_recipe_of_the_page_composes(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(block("docs/recipes.md", "yaml", "defaults: [pets/"))
    mine = compose(str(file), ["preset=paper", "run_dir=unused"])
    assert (mine.recipe, mine.task, mine.cem.candidates) == ("mine", "half_cheetah", 300)
    assert mine.cem.horizon == 30 and mine.model.head == "gaussian"


def test_a_recipe_from_the_schema_on_has_the_defaults_of_the_shipped_ones(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    text = block("docs/recipes.md", "yaml", "defaults:\n  - /metrpo_recipe")
    file.write_text(text)
    name = "metrpo/half_cheetah"
    own = flatten(yaml.safe_load((recipes_dir() / f"{name}.yaml").read_text()))
    for overrides in ([], ["preset=paper"], ["l1=reference", "noise=both", "model=affine"]):
        mine, shipped = (
            flatten(OmegaConf.to_container(compose(recipe, [*overrides, "run_dir=unused"])))
            for recipe in (str(file), name)
        )
        differ = {key for key in shipped if mine[key] != shipped[key]}
        assert differ <= set(own) - {"defaults", "task"}
        assert mine["l1.enabled"] and mine["label"] == "executed"
    # What the page says of a recipe that names nothing but the schema.
    file.write_text(re.sub(r"  - /(?!metrpo_recipe).*\n", "", text))
    bare = compose(str(file), ["run_dir=unused"])
    assert not bare.l1.enabled and bare.label == "nominal"


@pytest.fixture(scope="module")
def help_texts() -> dict[str, str]:
    """What each command says of itself."""

    def text(*arguments: str) -> str:
        with contextlib.redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit):
            main([*arguments, "--help"])
        return out.getvalue()

    commands = re.findall(r"^    ([\w-]+)(?:  .*)?$", text(), re.MULTILINE)
    return {command: text(command) for command in commands}


PAGES = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("docs/studies/*.md")]
COMMANDS = [
    shlex.split(line, comments=True)
    for page in PAGES
    for block_ in re.findall(r"```console\n(.*?)```", page.read_text(), re.DOTALL)
    for line in re.findall(r"^\$ torchrl-l1 (.*)", block_.replace("\\\n", " "), re.MULTILINE)
]


def test_the_table_of_commands_is_complete(help_texts: dict[str, str]) -> None:
    rows = table("docs/recipes.md", "Command", "What it does")
    assert {name.split()[1] for name in rows} == set(help_texts)


def test_commands_of_the_pages_exist_with_their_options(help_texts: dict[str, str]) -> None:
    assert len(COMMANDS) > 40
    for command, *arguments in COMMANDS:
        for option in (text for text in arguments if text.startswith("--")):
            of_hydra = command == "run" and option in ("--cfg", "--info")
            assert of_hydra or option in help_texts[command], f"{command} {option}"


def test_policies_that_are_files_are_told_by_the_kinds_that_there_are(
    help_texts: dict[str, str],
) -> None:
    page = (ROOT / "docs/robustify.md").read_text()
    kinds = {f"{name}:{kind.form}" for name, kind in FILE_KINDS.items()}
    for text in (page, load_policy.__doc__, help_texts["robustify"]):
        assert set(re.findall(r"\w+:FILE(?:\.\w+)?", text)) == kinds


@pytest.mark.parametrize("arguments", [text for text in COMMANDS if text[0] == "run"], ids=" ".join)
def test_recipes_and_overrides_of_the_pages_compose(arguments: list[str]) -> None:
    recipe, *rest = arguments[1:]
    overrides = [text for text in rest if "=" in text]
    if "-m" not in rest:
        compose(recipe, [*overrides, "run_dir=unused"])
    else:
        assert recipe in available_recipes()


def test_campaigns_of_the_pages_exist() -> None:
    named = {arguments[1] for arguments in COMMANDS if arguments[0] == "campaign"}
    assert len(named) > 8 and named <= set(available_campaigns())


def test_campaigns_page_has_every_campaign_and_counts_its_runs() -> None:
    rows = table("docs/campaigns.md", "Campaign", "Runs", "What for")
    counts = {
        name: sum(math.prod(map(len, part.matrix.values())) for part in read_campaign(name).runs)
        for name in available_campaigns()
    }
    assert {name: int(runs) for name, (runs, _) in rows.items()} == counts


def test_the_file_of_the_campaigns_page_is_one(tmp_path: Path) -> None:
    text = block("docs/campaigns.md", "yaml", "name: bandwidth")
    file = tmp_path / "own.yaml"
    file.write_text(text)
    campaign = read_campaign(str(file))
    assert len(plan(campaign, tmp_path / "out")) == 12
    (shown,) = campaign.evaluations
    # Of the disturbances two will do.
    keys = set(EvaluationSettings.keys()) - set(DISTURBANCES) | {"bias", "gain"}
    assert set(yaml.load(text, yaml.BaseLoader)["evaluations"][0]) == keys
    # The page says so of all but these.
    bias = {"bias": shown.matrix["bias"]}
    assert shown == EvaluationSettings("offset", where=shown.where, matrix=bias)
    stages = re.search(r"stage: \[\] +# .*\[(.*)\]", text)
    assert stages is not None and tuple(stages[1].split(", ")) == MBMF.facts.stage_names


def test_campaigns_page_names_every_launcher() -> None:
    page = (ROOT / "docs/campaigns.md").read_text()
    for launcher in LAUNCHERS:
        assert re.search(rf"`{launcher}`|--launcher {launcher}\b", page), launcher


def test_mbmf_page_names_every_recipe_and_stage() -> None:
    page = (ROOT / "docs/mbmf.md").read_text()
    (stages,) = re.findall(r"--stage ([a-z_ ]+) --l1", page)
    assert tuple(stages.split()) == MBMF.facts.stage_names
    (listed,) = re.findall(r"one for each of the five tasks: (.*?)\.", page)
    assert {f"mbmf/{name}" for name in words(listed)} == {
        name for name in available_recipes() if name.startswith("mbmf/") and name != "mbmf/any"
    }


def test_facts_of_the_tasks_are_those_of_the_table() -> None:
    columns = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
    facts = table("docs/tasks.md", "", *(f"`{name}`" for name in columns))
    alone = table("docs/tasks.md", "", "`cartpole`")
    for index, name in enumerate((*columns, "cartpole")):
        task = TASKS[name]
        rows = (
            {key: row[index] for key, row in facts.items()}
            if name in columns
            else {key: row[0] for key, row in alone.items()}
        )
        assert int(rows["entries $n$"]) == task.observation_dim
        actions, bound = re.findall(r"(\d+), ±(\d+)", rows["actions $m$, bound"])[0]
        assert int(actions) == task.action_dim
        assert (task.action_low, task.action_high) == (-float(bound), float(bound))
        assert int(rows["horizon (steps)"]) == task.horizon
        time = rows.get("$dt$ (s)") or rows["integration step × steps, $dt$"].split(", ")[1]
        assert float(time.removesuffix(" s")) == task.dt
        assert (rows["ends early"].startswith("no")) == (not task.terminates)


def test_tasks_page_names_every_task_and_its_gymnasium_name() -> None:
    page = (ROOT / "docs/tasks.md").read_text()
    assert set(TASKS) <= words(page)
    (listed,) = re.findall(r"The names are (.*?) under `torchrl_l1/`", page, re.DOTALL)
    names = {f"torchrl_l1/{name}" for name in re.findall(r"`([\w-]+)`", listed)}
    assert names == {gymnasium_id(name) for name in TASKS}


def test_planning_page_has_every_option_and_public_name() -> None:
    page = "docs/planning.md"
    shows = "What the spread of the particles shows"
    rows = table(page, "`propagation`", "Member that predicts", shows)
    assert {name.strip('"') for name in rows} == set(get_args(planning.Propagation))
    rows = table(page, "`precision`", "")
    assert {name.strip('"') for name in rows} == set(get_args(planning.Precision))
    text = (ROOT / page).read_text()
    names = text[text.index("\n## Public names") :]
    assert set(planning.__all__) <= words(names)


def test_the_two_controllers_differ_where_the_page_says() -> None:
    presets = ("`L1Config.paper(dt)` (default)", "`L1Config.reference(dt)`")
    rows = table("docs/l1.md", "", *presets)
    paper, reference = L1Config.paper(0.05), L1Config.reference(0.05)
    differ = {f.name for f in fields(paper) if getattr(paper, f.name) != getattr(reference, f.name)}
    page = (ROOT / "docs/l1.md").read_text()
    assert len(rows) == len(differ)
    assert {name for name in differ if f"(`{name}`" in page} == differ


def test_launchers_of_the_recipes_page_are_the_extras() -> None:
    rows = table("docs/recipes.md", "Extra", "Where the runs go", "Override")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for name, (_, override) in rows.items():
        (extra,) = re.findall(r"torchrl-l1\[(\w+)\]", name)
        assert f"hydra-{extra}-launcher" in project["optional-dependencies"][extra][0]
        assert override.strip("`").removeprefix("hydra/launcher=") in LAUNCHERS


def test_metrics_that_pages_name_are_logged() -> None:
    spec = importlib.util.spec_from_file_location("docs_pages", ROOT / "docs/_pages.py")
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    tables = "".join(map(pages.metrics_table, pages.METRICS.values()))
    known = set(re.findall(r"^\| `(.*?)` \|", tables, re.MULTILINE))
    groups = "|".join({name.partition("/")[0] for name in known if "/" in name})
    named = {
        name
        for page in PAGES
        for name in re.findall(rf"`((?:{groups})/[a-z_0-9]+)`", page.read_text())
    }
    assert len(named) > 3 and named <= known


def test_readme_counts_tasks_and_algorithms() -> None:
    numbers = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
    folders = {name.partition("/")[0] for name in available_recipes()}
    tasks, algorithms = numbers[len(TASKS)].capitalize(), numbers[len(folders)]
    assert (
        f"{tasks} tasks ([which](docs/tasks.md)), {algorithms} algorithms"
        in (ROOT / "README.md").read_text()
    )


PAGE = (Path(__file__).parents[1] / "docs/planning.md").read_text()


@pytest.fixture(scope="module")
def names() -> dict[str, object]:
    source = "\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))
    source, changed = re.subn(
        r"frames_per_batch=200,(\s+)total_frames=600",
        r"frames_per_batch=4,\1total_frames=8",
        source,
    )
    source = source.replace("rollout(1000,", "rollout(100,").replace(
        "max_epochs=40", "max_epochs=2"
    )
    assert changed == 1
    found: dict[str, object] = {}
    exec(compile(source, "docs/planning.md", "exec"), found)
    return found


def test_the_model_learns_from_what_was_collected(names):
    assert len(names["buffer"]) == 100 + 8


def test_a_task_of_ours(names):
    first, second = names["steps"]
    assert first.shape == (4, 5)
    # Batches continue each other's episodes, and their plans.
    assert torch.equal(torch.cat([first, second], 1), torch.arange(1, 11).expand(4, 10))


def test_any_function_of_sequences(names):
    plan, evaluate = names["plan"], names["evaluate"]
    assert plan.actions.shape == (2, 25, 1)
    achieved = evaluate(plan.actions[:, None])[:, 0]
    assert (achieved > evaluate(torch.zeros(2, 1, 25, 1))[:, 0]).all()
    # Far off, full force towards the origin comes first.
    torch.testing.assert_close(plan.actions[:, 0, 0].sign(), torch.tensor([-1.0, 1.0]))


def test_all_public_names_are_on_the_page():
    table = PAGE[PAGE.index("## Public names") :]
    assert [name for name in planning.__all__ if f"`{name}`" not in table] == []
