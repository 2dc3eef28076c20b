"""What is declared of each algorithm, against what it does."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest

from torchrl_l1.algorithms import MBMF, METRPO, PETS, Algorithm, METRPOConfig

DETS = PETS.facts.of_variant("dets")
ALGORITHMS: list[type[Algorithm]] = [METRPO, PETS, MBMF]


def test_stages_in_which_a_run_logs_either_way_to_act() -> None:
    assert [one.facts.mean_action_stages for one in (METRPO, MBMF, PETS)] == [(0,), (2,), ()]


def test_what_acts_in_words() -> None:
    assert MBMF.facts.acting("stochastic", "fine_tuning") == "fine-tuning, sampled actions"
    assert MBMF.facts.acting("deterministic", "cloning") == "cloning, mean action"
    assert MBMF.facts.acting("stochastic", "shooting") == "random shooting"
    assert METRPO.facts.acting("deterministic") == "mean action"
    assert PETS.facts.acting("stochastic") == DETS.acting("stochastic") == ""


def test_planners_act_in_one_way() -> None:
    assert not PETS.facts.samples
    assert not DETS.samples
    assert METRPO.facts.samples
    assert [MBMF.facts.acts_in_one_way(name) for name in MBMF.facts.stage_names] == [
        True, False, False,
    ]  # fmt: skip


def test_stages_are_named_only_where_there_are_several() -> None:
    assert [len(one.facts.named_stages) for one in ALGORITHMS] == [0, 0, 3]
    assert MBMF.facts.position("cloning") == 1
    assert MBMF.facts.position("dreaming") == -1


def test_a_variant_is_the_algorithm_under_another_name() -> None:
    assert (DETS.name, DETS.phases, DETS.metrics) == ("DETS", PETS.facts.phases, PETS.facts.metrics)
    assert DETS.color != PETS.facts.color and not DETS.variants


def test_stages_with_l1() -> None:
    assert [one.facts.l1_words for one in ALGORITHMS] == ["", "", "random shooting"]
    assert [stage.with_l1 for stage in MBMF.facts.stages] == [True, False, False]


def test_times_of_random_data_have_no_column() -> None:
    assert list(MBMF.facts.timed_phases.values()) == [
        "fit", "cloning", "PPO", "collection", "measuring returns",
    ]  # fmt: skip


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_metric_is_explained_and_every_phase_has_words(algorithm: type[Algorithm]) -> None:
    assert all(text.strip() for text in algorithm.facts.metrics.values())
    assert all(phase.words.strip() for phase in algorithm.facts.phases.values())
    names = {part.name for part in fields(algorithm.config_class)}
    assert {"outer_iterations", "episode_steps", "label", "model", "fit"} <= names


@pytest.mark.parametrize("slip", [{"seeds": 3}, {"horizons": 10}, {"compile": True}])
def test_a_misspelt_setting_is_refused(slip: dict[str, Any]) -> None:
    with pytest.raises(TypeError, match=next(iter(slip))):
        METRPO("inverted_pendulum", METRPOConfig(), **slip)
