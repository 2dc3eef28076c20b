from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from omegaconf import OmegaConf

from torchrl_l1.campaign import Campaign, RunMatrix, read_campaign
from torchrl_l1.campaign.description import dump_yaml
from torchrl_l1.campaign.plan import plan
from torchrl_l1.cli import main
from torchrl_l1.report import report
from torchrl_l1.report.build import find_campaigns
from torchrl_l1.report.runs import find_runs

WriteRun = Callable[..., Path]

CURVES = "arm,setting,seed,iteration,total_train_samples,average_return\n" + "".join(
    f"{arm},{setting},{seed},{i},{(i + 2) * 1666},{-60 + 10 * i + seed}\n"
    for arm, setting in (
        ("L1_OFF", "Inverted_Pendulum"),
        ("L1_ON", "Inverted_Pendulum"),
        ("nl_vs_ca", "Inverted_Pendulum_ca"),
    )
    for seed in (1, 2)
    for i in range(4)
)


def evaluations(seed: int) -> dict[str, list[dict[str, Any]]]:
    base = {"bias": 0.0, "gain": 1.0, "episodes": 25, "policy": "stochastic", "noise": "none"}
    rows = [
        base | {"l1": l1, "bias": bias, "return_mean": -seed - 30 * bias * (l1 == "off")}
        for l1 in ("off", "paper")
        for bias in (0.0, 1.0)
    ]
    return {
        "disturbances": rows,
        "ablation": [row for row in rows if row["bias"] == 0],
        "sim_to_real": [row | {"noise": "action"} for row in rows if row["bias"] == 0],
        "my_own": rows[:1],
    }


@pytest.fixture
def campaign(write_run: WriteRun, tmp_path: Path) -> Path:
    """A small campaign with every kind of result in it."""
    for seed in range(3):
        for arm in ("off", "paper"):
            returns = -np.geomspace(80, 0.01 * (1 + seed), 5)
            name = f"metrpo/inverted_pendulum/model=nonlinear/l1={arm}/seed_{seed}"
            write_run(returns, f"l1={arm}", seed=seed, name=name, evaluations=evaluations(seed))
        name = f"metrpo/inverted_pendulum/model=affine/l1=off/seed_{seed}"
        write_run([-70, -60, -50, -40, -30], "l1=off", "model=affine", seed=seed, name=name)
    write_run([-70, -60], "l1=paper", seed=3, iterations=5)
    folder = tmp_path / "runs"
    (folder / "campaign.yaml").write_text(dump_yaml(read_campaign("figure2").to_dict()))
    return folder


def test_no_file_of_a_report_takes_the_place_of_another(
    write_run: WriteRun, tmp_path: Path
) -> None:
    tests = {name: evaluations(0)["disturbances"] for name in ("training", "disturbances")}
    for bias in ("0.0", "0.5", "-0.5"):
        write_run([-3, -2, -1], "l1=off", f"perturbation.actuator_bias={bias}", evaluations=tests)
    page = report([tmp_path])
    files = re.findall(r"\]\((?:\./)?([^)]+)\)", page.read_text())
    assert len(set(files)) == len(files)
    assert all((page.parent / file).is_file() for file in files)
    assert sum("actuator_bias_0_5" in file for file in files) == 2
    tables = [(page.parent / f"training{number}.csv").read_text() for number in ("", "_2")]
    assert ["real_steps" in table for table in tables] == [True, False]
    assert ["return_values" in table for table in tables] == [False, True]


def test_report_joins_tables_and_figures(campaign: Path, tmp_path: Path) -> None:
    curves = tmp_path / "curves.csv"
    curves.write_text(CURVES)
    page = report([campaign], reference_curves=curves)
    assert page == campaign / "report" / "report.md"
    text = page.read_text()
    figures = re.findall(r"!\[[^]]+]\(([^)]+)\)", text)
    assert figures == [
        "learning_curves_inverted_pendulum.png",
        "by_model_form_inverted_pendulum.png",
        "ablation_paper.png",
        "disturbances_inverted_pendulum_none_off.png",
        "disturbances_inverted_pendulum_none_paper.png",
    ]
    for figure in figures:
        assert matplotlib.image.imread(page.parent / figure).std() > 0.05
    names = ("runs", "training", "pairs", "sim_to_real", "ablation", "disturbances", "my_own")
    for name in (*names, "versions"):
        assert f"(./{name}.csv)" in text
        with (page.parent / f"{name}.csv").open() as file:
            assert list(csv.DictReader(file)), name
    for heading in ("Training", "L1 less baseline", "By `model.form`", "Sim to real", "Versions"):
        assert f"\n## {heading}\n" in text
    assert "10 runs, of which 9 are finished" in text
    assert "seed 3: 2 of 5 iterations" in text
    assert "9 of 21 runs finished, 12 not begun, 1 others in its folder" in text
    assert f"$ torchrl-l1 campaign figure2 --output {campaign}\n" in text
    assert f"--reference-curves {curves}\n" in text
    assert "| torch | 2.13.0 | 10 |" in text
    # Of the two seeds' last three of four iterations: -50, -40 and -30, and the seed.
    assert "| -38.5 ± 0.5 |" in text


def test_no_table_of_differences_without_pairs(write_run: WriteRun, tmp_path: Path) -> None:
    for label in ("nominal", "executed"):
        write_run([1], "l1=paper", f"label={label}")
    page = report([tmp_path / "runs"])
    assert "less baseline" not in page.read_text()
    assert not (page.parent / "pairs.csv").exists()


def test_swept_controllers_have_a_line_each(write_run: WriteRun, tmp_path: Path) -> None:
    base = {"bias": 0.0, "gain": 1.0, "episodes": 5, "policy": "stochastic", "noise": "none"}
    for seed in range(2):
        swept = [
            base | {"l1": "paper", "epsilon": e, "alpha": a, "return_mean": e - seed}
            for e in (0.5, 2.0)
            for a in (0.1, 0.35)
        ]
        off = base | {"l1": "off", "epsilon": "", "alpha": "", "return_mean": -seed}
        write_run([1], "l1=off", seed=seed, evaluations={"sweep": [off, *swept]})
    text = report([tmp_path / "runs"]).read_text()
    section = text.split("\n## Evaluation `sweep`\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| inverted_pendulum")]
    assert lines == [
        "| inverted_pendulum | none | off | – | – | 2 | -0.5 ± 0.5 | – |",
        "| inverted_pendulum | none | paper | 0.5 | 0.1 | 2 | 0 ± 0.5 | 0.5, 0.5 |",
        "| inverted_pendulum | none | paper | 0.5 | 0.35 | 2 | 0 ± 0.5 | 0.5, 0.5 |",
        "| inverted_pendulum | none | paper | 2 | 0.1 | 2 | 1.5 ± 0.5 | 2, 2 |",
        "| inverted_pendulum | none | paper | 2 | 0.35 | 2 | 1.5 ± 0.5 | 2, 2 |",
    ]


def test_tables_have_as_many_cells_as_columns(campaign: Path) -> None:
    text = report([campaign]).read_text()
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert len(tables) > 5
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1, table


def test_runs_are_left_as_they_were_and_a_second_report_is_the_same(campaign: Path) -> None:
    def files() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in campaign.rglob("*.*") if path.is_file()}

    before = files()
    report([campaign])
    first = files()
    assert {path: content for path, content in first.items() if path in before} == before
    report([campaign])
    assert files() == first


def test_campaign_with_overrides_is_repeated_from_its_file(campaign: Path) -> None:
    own = read_campaign("figure2", ["outer_iterations=5"]).to_dict()
    (campaign / "campaign.yaml").write_text(dump_yaml(own))
    expected = f"$ torchrl-l1 campaign {campaign / 'campaign.yaml'} --output {campaign}\n"
    assert expected in report([campaign]).read_text()


def test_a_campaign_within_another_counts_its_own_runs(write_run: WriteRun, tmp_path: Path) -> None:
    """The outer one without a matrix, as a file by hand may be: one run."""
    for name, seed in (("", 0), ("inner/", 1), ("inner/", 2)):
        write_run([-9, -8, -7], seed=seed, name=f"{name}metrpo/hopper/seed_{seed}")
    inner = "name: inner\nruns: [{recipe: metrpo/hopper, matrix: {seed: [1, 2, 3]}}]\n"
    (tmp_path / "runs" / "inner" / "campaign.yaml").write_text(inner)
    outer = "name: outer\nruns: [{recipe: metrpo/hopper}]\n"
    (tmp_path / "runs" / "campaign.yaml").write_text(outer)
    text = report([tmp_path / "runs"]).read_text()
    assert "**outer** (1 of 1 runs finished)" in text
    assert "**inner** (2 of 3 runs finished, 1 not begun)" in text
    assert "cannot be read" not in text


def test_only_runs_that_a_campaign_asks_for_count_as_its_own(
    write_run: WriteRun, tmp_path: Path
) -> None:
    """A matrix may have other seeds and keys than when its first runs were made."""
    folder = tmp_path / "runs"
    matrix = RunMatrix("metrpo/hopper", matrix={"noise": ["none", "action"], "seed": [1, 2]})
    made = [run.directory.path for run in plan(Campaign("own", folder, "", [matrix], []), folder)]
    for path in (*made[:3], "metrpo/hopper/noise=none/seed_0", "metrpo/hopper/seed_1"):
        write_run([-9], name=str(path), iterations=2 if path == made[0] else 1)
    content = {"name": "own", "runs": [{"recipe": "metrpo/hopper", "matrix": matrix.matrix}]}
    (folder / "campaign.yaml").write_text(dump_yaml(content))
    (state,) = find_campaigns([folder], find_runs([folder]), [])
    assert (state.expected, state.finished, state.begun) == (4, 2, 1)
    assert state.others == 2


def test_comparisons_say_the_settings_of_each_cell(write_run: WriteRun, tmp_path: Path) -> None:
    # The two tasks have other main epsilons: the same departure is another variant in each.
    for recipe, usual in (("metrpo/inverted_pendulum", "1.0"), ("metrpo/swimmer", "2.0")):
        for noise in ("none", "action"):
            write_run([1], "l1=paper", f"noise={noise}", f"l1.epsilon={usual}", recipe=recipe)
        write_run([1], "l1=paper", f"l1.epsilon={usual}", "label=nominal", recipe=recipe)
        write_run([1], "l1=paper", "l1.epsilon=5", "label=nominal", recipe=recipe)
    text = report([tmp_path / "runs"]).read_text()
    section = text.split("\n## By `l1.epsilon` and `label`\n")[1].split("\n## ")[0]
    cells = re.findall(r"\| (\w+) \| none \| paper \| (l1.epsilon=\S+ label=\w+) ", section)
    expected = []
    for task, usual in (("inverted_pendulum", "1.0"), ("swimmer", "2.0")):
        expected += [
            (task, f"l1.epsilon={usual}, label=executed"),
            (task, f"l1.epsilon={usual}, label=nominal"),
            (task, "l1.epsilon=5.0, label=nominal"),
        ]
    assert cells == expected


def test_unusual_matrices_make_a_report(write_run: WriteRun, tmp_path: Path) -> None:
    for seed in range(3):
        write_run([1], "l1=paper", "label=executed", "l1.epsilon=5", seed=seed)
    for noise in ("none", "action", "observation"):
        write_run([1], "l1=paper", f"noise={noise}", "label=nominal", "l1.epsilon=1")
    text = report([tmp_path / "runs"]).read_text()
    assert "| inverted_pendulum | observation | paper |" in text


def test_unreadable_runs_are_listed_and_left_out(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([-2, -1], "l1=off", seed=0)
    lost = write_run([-2, -1], "l1=off", seed=1)
    file = lost / "metrics.csv"
    file.write_text(file.read_text().replace("-1.0", "nan"))
    text = report([tmp_path / "runs"]).read_text()
    assert "2 runs, of which 1 are finished" in text
    assert "Left out, since they cannot be read:" in text
    assert f"- {file}, line 3: return_mean is 'nan', not a finite number" in text


def test_controllers_that_are_not_as_shipped_are_told(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([-2, -1], "l1=slow")
    text = report([tmp_path / "runs"]).read_text()
    assert "- inverted_pendulum: `l1.alpha=0.1` (L1 paper)" in text


def test_only_begun_runs_make_a_report_without_figures(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([], "l1=off", iterations=3)
    page = report([tmp_path / "runs"], tmp_path / "out")
    assert "seed 0: 0 of 3 iterations" in page.read_text()
    assert not list(page.parent.glob("*.png"))


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as exit_info:
        main(arguments)
    assert exit_info.value.code not in (0, None)
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.err


def test_command_says_where_the_files_are(
    write_run: WriteRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run([-2, -1], "l1=off", name=os.fsdecode(b"caf\xe9"))
    output = tmp_path / "out of l1"
    main(["report", str(run), str(run.parent), "--output", str(output)])
    printed = capsys.readouterr().out
    assert f"Report: {output / 'report.md'}" in printed
    words = f"'{run.parent}/caf\\udce9' {run.parent} --output '{output}'"
    assert f"$ torchrl-l1 report {words}\n" in (output / "report.md").read_text()
    assert "caf\\udce9" in (output / "runs.csv").read_text()


def test_bad_requests_are_refused_before_anything_is_written(
    write_run: WriteRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, empty = tmp_path / "runs", tmp_path / "empty"
    empty.mkdir()
    assert "no run in" in refused(["report", str(empty)], capsys)
    assert "there is no folder" in refused(["report", str(tmp_path / "nowhere")], capsys)
    run = write_run([-2, -1], "l1=off")
    assert "is a run directory" in refused(["report", str(runs), "--output", str(run)], capsys)
    message = refused(["report", str(runs), "--output", str(run / "metrics.csv")], capsys)
    assert "is a file" in message
    nowhere = str(tmp_path / "nowhere.csv")
    message = refused(["report", str(runs), "--reference-curves", nowhere], capsys)
    assert "no reference curves at" in message
    (run / "metrics.csv").write_text("iteration,real_steps\n0,\n")
    assert str(run / "metrics.csv") in refused(["report", str(runs)], capsys)
    assert not (runs / "report").exists()
    assert not list(empty.iterdir())


def test_settings_that_differ_in_hundreds_of_keys_make_a_report(
    write_run: WriteRun, tmp_path: Path
) -> None:
    write_run([-2, -1], "l1=off")
    other = write_run([-3, -1], "l1=off", "preset=paper")
    config = other / "config.yaml"
    extra = "".join(f"a_setting_with_a_long_name_{i}: {i}\n" for i in range(300))
    config.write_text(config.read_text() + extra)
    page = report([tmp_path / "runs"])
    text = page.read_text()
    names = [file.name for file in page.parent.iterdir()]
    assert max(map(len, names)) <= 130
    assert re.search(r"## By \d+ settings\n", text)
    assert "`a_setting_with_a_long_name_299`" in text
    for figure in re.findall(r"!\[[^]]+]\(([^)]+)\)", text):
        assert figure in names


def test_every_file_that_cannot_be_read_is_listed(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([-2, -1], "l1=off", seed=0)
    runs = [write_run([-2, -1], "l1=off", seed=seed) for seed in (1, 2, 3, 4, 5)]
    (runs[0] / "versions.json").write_text("[1, 2]")
    (runs[1] / "config.yaml").write_bytes(b"\xff\x00task: {")
    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
    )
    (runs[2] / "config.yaml").write_text(bomb + "task: x\nseed: 0\n")
    (runs[3] / "config.yaml").write_text("task: " + "[" * 5000)
    (runs[4] / "checksums.json").write_text('{"metrics.csv": {"2": "0000"}}')
    (tmp_path / "runs" / "campaign.yaml").write_text("runs: 3\n")
    text = report([tmp_path / "runs"]).read_text()
    assert "3 runs, of which 2 are finished" in text
    for run, words in zip(
        runs,
        (
            "versions.json: it holds no names",
            "config.yaml: ",
            "config.yaml: ",
            "config.yaml: it is nested too deeply",
            "metrics.csv is not as it was written",
        ),
        strict=True,
    ):
        assert f"{run}/{words}" in text
    assert "aliases that expand it too far" in text
    assert "is not a campaign file" in text


def test_text_from_files_is_text(write_run: WriteRun, tmp_path: Path) -> None:
    evil = "<script>alert(1)</script> | `rm` ![x](http://y)\n\n# Head"
    write_run([-2, -1], "l1=off")
    run = write_run([-2, -1], "l1=off", "label=nominal")
    config = OmegaConf.load(run / "config.yaml")
    config.recipe = "=cmd()" + evil
    OmegaConf.save(config, run / "config.yaml")
    (run / "versions.json").write_text(json.dumps({evil: f"=1+1{evil}"}))
    content = {"name": evil, "description": evil, "runs": [{"recipe": evil}]}
    (tmp_path / "runs" / "campaign.yaml").write_text(dump_yaml(content))
    page = report([tmp_path / "runs"])
    outside = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for dangerous in ("<script", r"(?<!\\)\]\(http", "\n# Head", r"(?<!\\)`rm"):
        assert not re.search(dangerous, outside)
    for table in re.findall(r"(?:^\|.*\n)+", outside, re.MULTILINE):
        widths = {len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}
        assert len(widths) == 1, table
    for file in page.parent.glob("*.csv"):
        with file.open() as handle:
            for row in csv.reader(handle):
                assert not any(cell.startswith(("=", "@", "+")) for cell in row), file
