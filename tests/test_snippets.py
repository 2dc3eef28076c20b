"""Every piece of Python in README and guide runs; what is replaced or given is named here."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch

ROOT = Path(__file__).parents[1]


def snippets(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Page:
    """How the snippets of a page are run, one after the other with the same names.

    Attributes:
        given: statements before them: what the page calls the reader's own.
        smaller: what is replaced, so that it takes no minutes; all of it must be there.
        ignored: beginnings of warnings that come of that.
        check: what the names must be afterwards.
    """

    given: str = ""
    smaller: Mapping[str, str] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()
    check: Callable[[dict[str, Any]], bool] = bool


def augmented(name: str) -> Callable[[dict[str, Any]], bool]:
    def check(names: dict[str, Any]) -> bool:
        return names[name].rollout(3)["next", "l1", "u_exec"].shape[-1] == 1

    return check


L1_GIVEN = """
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs import *
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl_l1.control import *
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import ActuatorBias, ObservationNoise

torch.manual_seed(0)
n, m = 3, 1
model = EnsembleDynamics(n, m, members=2, hidden=(8,))
jacobian, policy = ActionJacobian(model), nn.Linear(n, m)
config = L1Config(0.05, epsilon=1.0, action_low=-2.0, action_high=2.0)
controller = L1Controller(model, config)
network = nn.Sequential(nn.Linear(n, 2 * m), NormalParamExtractor())
actor = ProbabilisticActor(
    TensorDictModule(network, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)
loss = ClipPPOLoss(actor, ValueOperator(nn.Linear(n, 1), in_keys=["observation"]))
loc, scale = 0.0, 1.0
observation, state = torch.zeros(1, n), init([1], n, m)
data = GymEnv("Pendulum-v1").rollout(100)
"""


def check_l1(names: dict[str, Any]) -> bool:
    env = names["TransformedEnv"](names["GymEnv"]("Pendulum-v1"), names["chain"])
    data = env.rollout(4, break_when_any_done=False)
    exported = names["program"].module()(names["observation"], *names["state"].entries().values())
    executed = names["Robust"]()(names["observation"], *names["state"].entries().values())[0]
    torch.testing.assert_close(exported[0], executed)
    assert names["loss"].tensor_keys.action == ("l1", "u_rl")
    # Frames of 0.05 s are skipped four at a time, and the policy sees what it was given.
    assert names["chain"][4].config.dt == pytest.approx(0.2)
    return data["next", "normalised"].shape == (4, 3)


PAGES = {
    "README.md": Page(
        smaller={"break_when_any_done=False)": "break_when_any_done=False), max_epochs=2"},
        ignored=("the model is too poor for L1",),
        check=augmented("env"),
    ),
    "docs/quickstart.md": Page(check=augmented("augmented")),
    "docs/tasks.md": Page(),
    "docs/disturbances.md": Page(),
    "docs/environments.md": Page(),
    "docs/learned_rewards.md": Page(),
    "docs/offline.md": Page(
        smaller={
            '"inverted_pendulum", 20).rollout(100)': '"inverted_pendulum", 4).rollout(50)',
            "evaluation_episodes=2": "evaluation_episodes=2, imagined_steps=500",
        },
    ),
    "docs/l1.md": Page(
        given=L1_GIVEN,
        check=check_l1,
    ),
    "docs/planning.md": Page(
        smaller={
            "horizon=20, candidates=100, elites=10, iterations=3": "horizon=4, candidates=10, "
            "elites=3, iterations=2",
            "max_epochs=40": "max_epochs=1",
            "rollout(1000": "rollout(120",
            "frames_per_batch=200": "frames_per_batch=20",
            "total_frames=600": "total_frames=40",
        },
        check=lambda names: names["plan"].actions.shape == (2, 25, 1),
    ),
    "docs/robustify.md": Page(
        smaller={
            "steps=2000": "steps=200, fit=QUICK, model=SMALL, progress=False",
            "episodes=2": "episodes=2, most_steps=10",
        },
        given="from torchrl_l1.dynamics import FitConfig\n"
        "QUICK, SMALL = FitConfig(max_epochs=5, batch_size=50), {'hidden': [8], 'members': 2}",
        ignored=("the model is too poor",),
        check=lambda names: names["data"]["next", "l1", "u_exec"].shape == (1, 100, 1),
    ),
}

ELSEWHERE = {"docs/data.md"}
"""Pages with a test of their own, since they read files of the user's."""


def run(page: str, folder: Path) -> dict[str, Any]:
    settings, texts = PAGES[page], snippets(page)
    for old in settings.smaller:
        assert any(old in text for text in texts), f"{page} has no {old!r}"
    names: dict[str, Any] = {"__name__": "page"}
    exec(settings.given, names)
    for text in texts:
        for old, new in settings.smaller.items():
            text = text.replace(old, new)
        exec(compile(text, page, "exec"), names)
    return names


def test_every_page_with_python_is_run() -> None:
    pages = ["README.md", *(f"docs/{file.name}" for file in ROOT.glob("docs/*.md"))]
    pages += [f"docs/studies/{file.name}" for file in ROOT.glob("docs/studies/*.md")]
    assert {page for page in pages if snippets(page)} == set(PAGES) | ELSEWHERE


@pytest.mark.parametrize("page", PAGES)
def test_snippets(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        for beginning in PAGES[page].ignored:
            warnings.filterwarnings("ignore", beginning)
        names = run(page, tmp_path)
        assert PAGES[page].check(names)
