"""Where rewards and ends of imagined trajectories come from."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.algorithms import (
    METRPO,
    METRPOConfig,
    ModelConfig,
    OutcomeConfig,
    Outcomes,
    PolicyConfig,
)
from torchrl_l1.algorithms import policy_improvement as improvement
from torchrl_l1.algorithms.algorithm import Diverged
from torchrl_l1.algorithms.outcomes import OUTCOME_METRICS
from torchrl_l1.dynamics import FitConfig, imagine
from torchrl_l1.envs import get_task
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.run import run
from torchrl_l1.objectives import TRPOConfig
from torchrl_l1.planning import evaluate

SMALL = OutcomeConfig(members=2, hidden=[8])
LEARNED: dict[str, Any] = {"reward": "learned", "termination": "learned", "outcome_model": SMALL}


def make(task: str = "walker", seed: int = 0, horizon: int = 60, **surroundings: Any) -> METRPO:
    """Random actions make a walker fall after some twenty steps."""
    config = METRPOConfig(
        outer_iterations=3,
        episodes_per_iteration=3,
        evaluation_episodes=1,
        trpo_iterations=2,
        imagined_steps=200,
        imagined_horizon=20,
        imagined_from_data=0.5,
        model=ModelConfig(members=2, hidden=[16]),
        policy=PolicyConfig(hidden=[8]),
        fit=FitConfig(batch_size=32, max_epochs=3),
        trpo=TRPOConfig(fisher_fraction=1.0),
    )
    return METRPO(task, config, seed=seed, horizon=horizon, **surroundings)


def test_what_is_learned_is_logged_and_finds_the_ends_in_the_data() -> None:
    algorithm = make(**LEARNED)
    results = [result.metrics for result in algorithm.iterate()]
    assert OUTCOME_METRICS.keys() <= results[0].keys() <= METRPO.facts.metrics.keys()
    data = algorithm.learning.buffer[:]
    ended = data["next", "terminated"][:, 0]
    assert torch.equal(ended, get_task("walker").terminated(data["next", "observation"]))
    # After an early end the next row starts another episode; it is none of this end's.
    (rows,) = ended.nonzero(as_tuple=True)
    assert 0 < len(rows) < 60
    start = data["observation"][rows[rows < len(data) - 1] + 1]
    assert not get_task("walker").terminated(start).any()
    # The last fit came before the last collection.
    seen = data[: 3 * 3 * 60]
    share = seen["next", "terminated"][~seen["validation"]].float().mean().item()
    assert results[-1]["termination_model/terminal"] == pytest.approx(share)


def test_a_reward_of_another_shape_is_no_divergence() -> None:
    algorithm = make()
    algorithm.stops_on_divergence = False
    algorithm.outcomes.reward = lambda observation, action, following: following
    with pytest.raises(ValueError, match=r"^the reward function must return shape"):
        next(algorithm.iterate())


def test_one_may_be_learned_without_the_other() -> None:
    rewards = next(make(reward="learned", outcome_model=SMALL).iterate()).metrics
    ends = make(termination="learned", outcome_model=SMALL)
    names = set(next(ends.iterate()).metrics)
    assert {n for n in rewards if n in OUTCOME_METRICS} == {
        "reward_model/validation_loss",
        "reward_model/explained_variance",
    }
    assert {n.split("/")[0] for n in names if n in OUTCOME_METRICS} == {"termination_model"}
    assert ends.outcomes.reward is ends.task.imagined_reward


def test_the_rest_of_a_run_draws_what_it_drew(monkeypatch: pytest.MonkeyPatch) -> None:
    """With learned models that are not asked, every number is as without."""
    plain = [result.metrics for result in make().iterate()]
    learned = make(**LEARNED)
    monkeypatch.setattr(learned.outcomes, "reward", learned.task.imagined_reward)
    own = learned.task.terminated
    monkeypatch.setattr(learned.outcomes, "termination", lambda as_task: own if as_task else None)
    for before, result in zip(plain, learned.iterate(), strict=True):
        assert {n: v for n, v in result.metrics.items() if n not in OUTCOME_METRICS} == before


def test_resumed_run_repeats_the_unbroken_one() -> None:
    unbroken = [result.metrics for result in make(**LEARNED).iterate()]
    first = make(**LEARNED)
    before = [next(first.iterate()).metrics]
    second = make(**LEARNED)
    second.load_state_dict(first.state_dict())
    after = [result.metrics for result in second.iterate()]
    assert before + after == unbroken


def test_nothing_learned_leaves_no_trace_in_checkpoints() -> None:
    algorithm = make()
    next(algorithm.iterate())
    assert "outcomes" not in algorithm.state_dict()
    assert set(algorithm.weights()) == {"model", "policy"}
    assert "terminated" not in algorithm.learning.buffer[:]["next"]
    with pytest.raises(KeyError, match="reward_model"):
        make(**LEARNED).load_state_dict(algorithm.state_dict())


def test_imagination_is_that_of_the_models(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = make(**LEARNED)
    imagined = []

    def recorded(*arguments: Any, **more: Any) -> Any:
        imagined.append(imagine(*arguments, **more))
        return imagined[-1]

    monkeypatch.setattr(improvement, "imagine", recorded)
    next(algorithm.iterate())
    data = imagined[-1]
    valid = data["valid"][..., 0]
    models = algorithm.outcomes.models
    x, following = data["observation"][valid], data["next"][valid]
    with torch.no_grad():
        reward = models["reward_model"](
            x, data["action"][valid].clamp(-1, 1), following["observation"]
        )
        ended = models["termination_model"](following["observation"])
    inside = ~following["left_box"][:, 0]
    torch.testing.assert_close(following["reward"][:, 0], reward)
    assert torch.equal(following["terminated"][:, 0], ended & inside)
    assert following["terminated"].any()


def test_plans_are_valued_by_the_models() -> None:
    recipe: Any = OmegaConf.to_object(planning_recipe("pets/inverted_pendulum"))
    algorithm = recipe.build()
    list(algorithm.iterate())
    sampler = algorithm.policy.sampler
    observation, actions = 0.1 * torch.randn(2, 4), torch.rand(2, 3, 5, 1) * 2 - 1
    reward, ends = (algorithm.outcomes.models[n] for n in ("reward_model", "termination_model"))
    torch.manual_seed(0)
    found = sampler.evaluator(observation)(actions)
    torch.manual_seed(0)
    wanted = evaluate(
        algorithm.dynamics,
        observation,
        actions,
        reward,
        particles=sampler.particles,
        terminated=ends,
        common_noise=True,
        precision=sampler.precision,
    )
    assert torch.equal(found, wanted)
    assert not torch.equal(found, replace_reward(sampler, algorithm.task)(observation)(actions))


def replace_reward(sampler: Any, task: Any) -> Any:
    return replace(sampler, reward=task.imagined_reward).evaluator


def planning_recipe(name: str, *more: str) -> DictConfig:
    small = ["outer_iterations=2", "horizon=10", "model.members=2", "model.hidden=[8]"]
    small += ["fit.max_epochs=2", "fit.batch_size=16", "fit.validation_fraction=0.3"]
    small += ["outcome_model.members=1", "outcome_model.hidden=[8]", "wandb.mode=disabled"]
    if name.startswith("pets"):
        small += ["cem.candidates=10", "cem.elites=3", "cem.iterations=2", "cem.horizon=5"]
        small += ["particles=4"]
    else:
        small += ["shooting.candidates=10", "shooting.horizon=5", "shooting_iterations=1"]
        small += ["evaluation_episodes=1", "cloning.iterations=1", "cloning.max_epochs=2"]
    learned = ["reward=learned", "termination=learned", "run_dir=unused"]
    return compose(name, [*small, *learned, *more])


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", ["pets/inverted_pendulum", "mbmf/walker"])
def test_planners_run_from_end_to_end(name: str, tmp_path: Path) -> None:
    folder = run(planning_recipe(name, f"run_dir={tmp_path / 'run'}"))
    assert OUTCOME_METRICS.keys() <= rows(folder)[-1].keys()
    assert load_run(folder).algorithm.outcomes.models.keys() == {
        "reward_model",
        "termination_model",
    }


def test_a_run_from_end_to_end(tiny_recipe: Callable[..., DictConfig], tmp_path: Path) -> None:
    settings = ["reward=learned", "termination=learned", "outcome_model.hidden=[8]", "horizon=50"]
    recipe = lambda *more: tiny_recipe(*settings, *more, recipe="metrpo/walker")  # noqa: E731
    folder = run(recipe())
    assert len(rows(folder)) == 2
    assert float(rows(folder)[-1]["termination_model/terminal"]) > 0
    weights = torch.load(folder / "reward_model.pt", weights_only=True)
    loaded = load_run(folder).algorithm.outcomes.models["reward_model"].state_dict()
    assert all(torch.equal(weights[key], value) for key, value in loaded.items())
    assert (folder / "termination_model.pt").exists()
    shorter = tmp_path / "shorter"
    run(recipe("outer_iterations=1", f"run_dir={shorter}"))
    assert rows(shorter)[0] == rows(folder)[0]


def test_a_function_of_ones_own(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "def reward(x, u, y):\n    return y[..., 8] - 0.1 * (u ** 2).sum(-1)\n"
        "def fallen(y):\n    return y[..., 0] < 0.8\n"
    )
    algorithm = make(reward=f"{file}:reward", termination=f"{file}:fallen")
    next(algorithm.iterate())
    outcomes, x = algorithm.outcomes, torch.randn(5, 17)
    torch.testing.assert_close(outcomes.reward(x, torch.ones(5, 6), x), x[:, 8] - 0.6)
    assert torch.equal(outcomes.termination()(x), x[:, 0] < 0.8)
    assert not outcomes.models and not outcomes.state_dict()


def test_who_ends_what_is_imagined() -> None:
    task = get_task("walker")
    assert Outcomes(task).termination() is task.terminated
    assert Outcomes(task).termination(as_task=False) is None
    assert Outcomes(get_task("hopper")).termination() is None
    assert Outcomes(task, termination="none").termination() is None
    learned = Outcomes(task, termination="learned")
    assert learned.termination() is learned.models["termination_model"]
    assert learned.termination(as_task=False) is learned.models["termination_model"]


BAD = {
    "lacking": ("", "has no 'f'"),
    "broken": ("import nowhere_at_all", "No module named 'nowhere_at_all'"),
    "number": ("f = 3", "names a int, not a function"),
    "raises": ("def f(*a):\n    raise KeyError('speed')", "failed on tensors of shape .* KeyError"),
    "arguments": ("def f():\n    return 1", "failed on tensors of shape"),
    "shape": ("def f(*a):\n    return a[-1]", r"must return shape \(\.\.\.\).*x\[\.\.\., 0\]"),
    "rows": ("def f(*a):\n    return a[-1][:, 0]", r"must return shape \(\.\.\.\)"),
    "array": ("def f(*a):\n    return a[-1][..., 0].numpy()", "must return a tensor, got ndarray"),
    "double": ("def f(*a):\n    return a[-1][..., 0].double()", "must return torch"),
    "nan": ("def f(*a):\n    return a[-1][..., 0] * float('nan')", "is not finite|torch.bool"),
}


@pytest.mark.parametrize("name", ["reward", "termination"])
@pytest.mark.parametrize("kind", BAD)
def test_a_function_that_will_not_do_is_refused_in_one_line(
    name: str, kind: str, tmp_path: Path
) -> None:
    text, words = BAD[kind]
    file = tmp_path / f"{kind}_{name}.py"
    file.write_text(text + "\n")
    with pytest.raises(ValueError, match=rf"^{name}=.*{words}") as error:
        Outcomes(get_task("walker"), **{name: f"{file}:f"})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "setting",
    ["reward=learnt", "reward=none", "termination=off", "reward=own.py", "termination=a:1"],
)
def test_other_words_are_refused(setting: str, tiny_recipe: Callable[..., DictConfig]) -> None:
    name = setting.partition("=")[0]
    with pytest.raises(ValueError, match=rf"{name} must be builtin, learned, .*MODULE:FUNCTION"):
        run(tiny_recipe(setting))
    with pytest.raises(ValueError, match="no module 'nowhere'"):
        run(tiny_recipe(f"{name}=nowhere:function"))


def test_a_model_of_no_numbers_stops_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm = make(**LEARNED)
    fit = Outcomes.fit

    def spoilt(self: Outcomes, *arguments: Any) -> Any:
        metrics = fit(self, *arguments)
        with torch.no_grad():
            next(self.models["reward_model"].parameters()).fill_(torch.nan)
        return metrics

    with monkeypatch.context() as patch:
        patch.setattr(Outcomes, "fit", spoilt)
        with pytest.raises(Diverged, match="fit: weights of the reward model are not finite"):
            next(algorithm.iterate())
    monkeypatch.setattr(
        Outcomes, "fit", lambda *_: {"termination_model/validation_loss": torch.inf}
    )
    with pytest.raises(Diverged, match="termination_model/validation_loss is inf"):
        next(make(**LEARNED).iterate())
