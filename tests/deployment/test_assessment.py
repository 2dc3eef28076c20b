from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from torchrl_l1.control import L1Config
from torchrl_l1.control.config import Filter
from torchrl_l1.deployment import Assessment, assessment
from torchrl_l1.deployment.assessment import Episodes, single_disturbances, summarize_episodes
from torchrl_l1.envs import suite
from torchrl_l1.experiment import l1_options
from torchrl_l1.experiment.settings import L1Settings


@pytest.fixture(scope="module")
def table(robust) -> Assessment:
    return robust.evaluate(
        {"bias": [0.0, 0.5, 1.0], "delay": 1}, episodes=3, most_steps=40, progress=False
    )


def test_cells():
    assert single_disturbances("quick") == suite("quick")
    assert single_disturbances({}) == [{}]
    for values in (np.linspace(0, 1, 3), torch.tensor([0.5, 1.0]), (0.5, 0.5, 1.0)):
        assert single_disturbances({"bias": values}) == [{}, {"bias": 0.5}, {"bias": 1.0}]
    with pytest.raises(ValueError, match="unknown disturbance 'wobble'"):
        single_disturbances({"wobble": [1.0]})
    with pytest.raises(ValueError, match="unknown suite"):
        single_disturbances("slow")
    with pytest.raises(ValueError, match=r"disturbances are values by name, .* got None"):
        single_disturbances(None)
    with pytest.raises(ValueError, match="finite"):
        single_disturbances({"bias": float("nan")})


def test_episodes_count_up_to_their_end():
    done = torch.zeros(2, 5, 1, dtype=torch.bool)
    done[0, 2:] = True  # ended after three steps, and repeated
    reward = torch.arange(10.0).reshape(2, 5, 1)
    switch = torch.tensor([[1, 0, 0, 1, 1], [0, 0, 0, 0, 1]], dtype=torch.bool)[..., None]
    after = TensorDict(
        {"done": done, "reward": reward, "l1": TensorDict({"switch": switch}, [2, 5])}, [2, 5]
    )
    found = summarize_episodes(TensorDict({"next": after}, [2, 5]))
    assert found.returns.tolist() == [0 + 1 + 2, 5 + 6 + 7 + 8 + 9]
    assert found.steps.tolist() == [3, 5]
    assert found.switches == pytest.approx(1000 * 2 / 8)


@pytest.mark.parametrize("law", [*get_args(Filter), "another"])
def test_switches_are_shown_of_the_laws_that_epsilon_tunes(law, monkeypatch):
    settings = L1Settings(enabled=True, filter=law)
    monkeypatch.setattr(l1_options, "l1_options", lambda: {"option": settings})
    config = L1Config(0.05)
    object.__setattr__(config, "filter", law)
    columns = assessment._columns(Episodes(np.ones(2), np.ones(2), 3.0), config)
    assert ("switches_per_1000_steps" in columns) == l1_options.is_tuned("option")


def test_columns_are_the_median_and_the_range():
    episodes = Episodes(np.array([1.0, 9.0, 2.0]), np.array([5, 3, 3]), switches=50.0)
    expected = {
        "episodes": 3, "return_mean": 4.0,
        "return_median": 2.0, "return_lowest": 1.0, "return_highest": 9.0,
        "steps_median": 3.0, "steps_lowest": 3.0, "steps_highest": 5.0,
    }  # fmt: skip
    assert (
        assessment._columns(episodes, L1Config.robust(0.04))
        == assessment._columns(episodes, None)
        == expected
    )
    paper = L1Config.paper(0.04, epsilon=0.3)
    assert assessment._columns(episodes, paper) == expected | {"switches_per_1000_steps": 50.0}


def test_rows_are_there_for_each_disturbance_and_controller(table):
    found = {(row["bias"], row["delay"], row["l1"]) for row in table}
    controllers = ("off", "paper", "robust", "oracle")
    expected = {(bias, 0.0, l1) for bias in (0.0, 0.5, 1.0) for l1 in controllers}
    # A delay is not matched: the oracle has nothing to say of it.
    expected |= {(0.0, 1.0, l1) for l1 in controllers[:-1]}
    assert found == expected and len(table) == len(expected)
    assert table.controllers[0] == "off" and table.controllers[-1] == "oracle"
    assert len(table.episodes) == 3 * len(table)


def test_the_oracle_undoes_a_bias_within_the_bounds(table):
    def returns(l1, bias):
        return [row["return"] for row in table.episodes if (row["l1"], row["bias"]) == (l1, bias)]

    plain = returns("off", 0.0)[:3]
    assert returns("oracle", 1.0) == pytest.approx(plain, abs=1e-4)
    assert np.mean(returns("off", 1.0)) < np.mean(plain) - 0.1


def test_recovered_is_the_share_of_the_means(table):
    rows = {(row["l1"], row["bias"]): row for row in table if not row["delay"]}
    row = rows["robust", 1.0]
    off, oracle = (rows[l1, 1.0]["return_mean"] for l1 in ("off", "oracle"))
    assert row["recovered"] == pytest.approx((row["return_mean"] - off) / (oracle - off))
    assert row["recovered"] > 0.3
    assert "recovered" not in rows["robust", 0.0]  # there is nothing to recover


def test_the_table_is_markdown(table):
    lines = str(table).splitlines()
    assert lines[0].startswith("| disturbance | L1 off |")
    assert lines[0].endswith("recovered |") and "oracle" in lines[0]
    assert [line.split("|")[1].strip() for line in lines[2:]] == [
        *("undisturbed", "bias 0.5", "bias 1", "delay 1"),
    ]
    assert len({line.count("|") for line in lines}) == 1
    assert "3 episodes" in table.words
    single = replace(table, rows=[{**row, "episodes": 1} for row in table.rows])
    assert "of 1 episode [lowest" in single.words


def test_suites_leave_out_what_cannot_act():
    from torchrl_l1.deployment import environment_source
    from torchrl_l1.envs import DISTURBANCES

    takes = {
        name: [entry.name for entry in DISTURBANCES.values() if source.takes(entry)]
        for name, source in (
            (name, environment_source(name)) for name in ("Pendulum-v1", "hopper", "Hopper-v5")
        )
    }
    assert len(takes["hopper"]) == len(DISTURBANCES)
    assert set(takes["hopper"]) - set(takes["Hopper-v5"]) == {"wind"}
    assert "mass" not in takes["Pendulum-v1"] and "bias" in takes["Pendulum-v1"]


def test_what_begins_after_the_last_step_gets_a_warning(robust):
    with pytest.warns(UserWarning, match=r"step does nothing here: .* an episode has 5 steps"):
        robust.evaluate({"step": 0.3}, episodes=1, most_steps=5, progress=False)


@pytest.mark.parametrize("kept", [("bias",), ("bias", "delay")], ids=["lines", "bars"])
def test_charts(table, tmp_path, kept):
    rows = [row for row in table if "delay" in kept or not row["delay"]]
    drawn = Assessment("A pendulum", rows, ()).plot(tmp_path / "new" / "chart.png")
    with Image.open(drawn) as image:
        assert image.width > 500 and len(image.convert("RGB").getcolors(10**6)) > 50
