"""Numbers that are none, in settings, controllers and trainings: refused, flagged or stopped at."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torch import Tensor

from tests.attack.kills import RUNS, results
from tests.attack.outcome import Attack, Row, command
from torchrl_l1.algorithms.model_learning import ModelLearning
from torchrl_l1.control import ActionJacobian, L1Config, augment, init
from torchrl_l1.dynamics import FitConfig, fit_dynamics
from torchrl_l1.envs import simulation
from torchrl_l1.experiment.errors import USER_ERRORS, message
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.settings import RunSettings, flatten
from torchrl_l1.objectives.gaussian_trpo import _GaussianProblem

LAWS: Mapping[str, Callable[..., L1Config]] = {"low_pass": L1Config, "kalman": L1Config.robust}
STRANGE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf, "1e30": 1e30, "-1e30": -1e30}


def rows(attack: Attack) -> list[Row]:
    """Settings, the controller, models, data and whole trainings."""
    warnings.filterwarnings("ignore")
    first = [] if attack.match else [settings(attack), controllers(attack), models(), data()]
    return [*first, *trainings(attack)]


# Settings.


def settings(attack: Attack) -> Row:
    """Every number of every recipe in turn: what is no number at all is refused, in a line."""
    row = Row("numbers: settings")
    for recipe, overrides in RUNS.values():
        whole = compose(recipe, [*overrides, "l1=robust", "run_dir=x"])
        flat = flatten(OmegaConf.to_container(whole))
        names = [key for key, value in flat.items() if isinstance(value, float)]
        counts = [key for key, value in flat.items() if type(value) is int]
        strange = ["nan", "inf", "-inf", "-1.0", "1e400"]
        for name, value in product(names[:: attack.some(1, 4)], strange):
            row.add(f"{recipe}, {name}={value}", _setting(whole, name, float(value)))
        for name, count in product(counts[:: attack.some(1, 4)], (-1, 1.5, math.nan)):
            if name != "seed":
                row.add(f"{recipe}, {name}={count}", _setting(whole, name, count, count))
    return row


def _setting(whole: DictConfig, name: str, value: float, count: Any = None) -> str | None:
    changed = whole.copy()
    try:
        OmegaConf.update(changed, name, value)
        recipe = OmegaConf.to_object(changed)
        assert isinstance(recipe, RunSettings)
        recipe.build()
    except USER_ERRORS as error:
        return "several lines" if "\n" in message(error) else None
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "accepted" if math.isnan(value) or count is not None else None


# The controller.


def controllers(attack: Attack) -> Row:
    """One strange number on one step: the action stays bounded, and it is forgotten."""
    row = Row("numbers: L1 with strange observations, actions and models")
    dtypes = (torch.float32, torch.float64) if not attack.quick else (torch.float32,)
    places = ("observation", "action", "output", "gain")
    for law, dtype, place, size in product(LAWS, dtypes, places, STRANGE):
        what = f"{law}, {dtype}, {place} {size}"
        try:
            row.add(what, _controller(LAWS[law], dtype, place, STRANGE[size]))
        except Exception as error:
            row.add(what, f"{type(error).__name__}: {error}")
    return row


def _controller(
    law: Callable[..., L1Config], dtype: torch.dtype, place: str, size: float
) -> str | None:
    config = law(0.05, action_low=-1.0, action_high=1.0)
    gain = torch.tensor([[0.1, 0.2]], dtype=dtype)
    spoilt, at, after = False, 5, math.ceil(3 / 0.35)

    def model(x: Tensor, u: Tensor) -> Tensor:
        wrong = torch.zeros_like(x)
        if spoilt and place in ("output", "gain") and x.shape[0] == 2:
            wrong[1] = 1.0
        factor = torch.where(wrong.bool(), size, 1.0) if place == "gain" else 1.0
        offset = torch.where(wrong.bool(), size, 0.0) if place == "output" else 0.0
        return (u @ gain) * factor + offset

    found = []
    for spoil in (False, True):
        jacobian = ActionJacobian(model)
        state = init([2], 2, 1, config, dtype=dtype)
        x = torch.zeros(2, 2, dtype=dtype)
        actions = []
        for t in range(at + 2 * after):
            spoilt = spoil and t == at
            wanted = torch.full((2, 1), 0.3, dtype=dtype)
            seen = x.clone()
            if spoilt and place == "observation":
                seen[1, 0] = size
            asked = wanted.clone()
            if spoilt and place == "action":
                asked[1] = size
            u, state, signals = augment(config, jacobian, state, seen, asked)
            for name, value in (*state.entries().items(), *signals._asdict().items()):
                if not value.isfinite().all():
                    return f"{name} is not finite"
            bounded = (u.abs() <= 1).all()
            if (not bounded and place != "action") or not u[0].isfinite().all():
                return f"the action is {u.flatten().tolist()}"
            if t > at + after and not torch.allclose(u, wanted, atol=1e-3):
                return f"not forgotten: {u.flatten().tolist()}"
            x = x + u.nan_to_num() @ gain
            actions.append(u[0].clone())
        found.append(torch.stack(actions))
    return None if torch.equal(*found) else "the other environment saw it"


def models() -> Row:
    """Models that return what is none, or that do not look at the action."""
    row = Row("numbers: models that return something else")
    x, u = torch.zeros(2, 3), torch.zeros(2, 2)
    config = L1Config(0.05, action_low=-1.0, action_high=1.0)
    wrong: dict[str, Callable[..., Any]] = {
        "None": lambda x, u: None,
        "an int": lambda x, u: 3,
        "a list": lambda x, u: [x],
        "a string": lambda x, u: "x",
        "integers": lambda x, u: x.long(),
        "booleans": lambda x, u: x > 0,
        "complex": lambda x, u: x.to(torch.complex64),
        "too narrow": lambda x, u: x[..., :1],
        "no batch": lambda x, u: x[0],
        "an array": lambda x, u: x.numpy(),
    }
    for name, model in wrong.items():
        try:
            augment(config, ActionJacobian(model), init([2], 3, 2, config), x, u)
        except (TypeError, ValueError) as error:
            row.add(name, None if "\n" not in str(error) else f"several lines: {error}")
        except Exception as error:
            row.add(name, f"{type(error).__name__}: {error}")
        else:
            row.add(name, "accepted")
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        for effect in (0.0, 1e-12):
            seen = _without_effect(config, dtype, effect)
            row.add(f"an action without effect ({effect}), {dtype}", seen)
    return row


def _without_effect(config: L1Config, dtype: torch.dtype, effect: float) -> str | None:
    jacobian = ActionJacobian(lambda x, u: 0.1 * x + effect * u.sum(-1, keepdim=True))
    state = init([2], 3, 2, config, dtype=dtype)
    wanted = torch.full((2, 2), 0.25, dtype=dtype)
    for t in range(8):
        x = torch.full((2, 3), 0.1 * t, dtype=dtype)
        u, state, signals = augment(config, jacobian, state, x, wanted)
        if not torch.equal(u, wanted):
            return f"it acts: {u.flatten().tolist()}"
        if not bool(signals.ill_conditioned.all()):
            return "not flagged"
    return None


def data() -> Row:
    """Transitions with entries that are not finite."""
    row = Row("numbers: data for fits")
    config = FitConfig(max_epochs=2, batch_size=16)
    for place, size, share in product(
        ("observation", "action", ("next", "observation")), (math.nan, math.inf), (0.1, 1.0)
    ):
        torch.manual_seed(0)
        x, u = torch.randn(80, 3), torch.randn(80, 1)
        found = TensorDict(
            {"observation": x, "action": u, "next": {"observation": x + u}}, batch_size=[80]
        )
        found.get(place)[: round(80 * share), 0] = size
        what = f"{place}, {size}, {share:.0%}"
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    model = fit_dynamics(found, config=config, hidden=(4,))
            except ValueError as error:
                row.add(what, None if share == 1 else f"refused: {error}")
                continue
        finite = all(bool(part.isfinite().all()) for part in model.state_dict().values())
        counted = any("not finite" in str(one.message) for one in told)
        row.add(what, None if finite and counted else f"finite {finite}, told {counted}")
    return row


# Trainings. Each is spoilt in the process that trains, from some moment on.


def spoil_weights(value: float, at: int) -> None:
    """From its n-th fit on the model's first weights are this, or so many times themselves."""
    fit, count = ModelLearning.fit, iter(range(1000))

    def spoilt(self: ModelLearning, *arguments: Any) -> Any:
        found = fit(self, *arguments)
        if next(count) >= at:
            with torch.no_grad():
                for part in self.dynamics.parameters():
                    part.mul_(value)
        return found

    ModelLearning.fit = spoilt  # type: ignore[method-assign]


def spoil_loss(value: float, at: int) -> None:
    """From its n-th fit on the validation loss is this."""
    fit, count = ModelLearning.fit, iter(range(1000))

    def spoilt(self: ModelLearning, *arguments: Any) -> Any:
        found = fit(self, *arguments)
        if next(count) >= at:
            found.validation_loss = value
        return found

    ModelLearning.fit = spoilt  # type: ignore[method-assign]


def spoil_curvature(value: float) -> None:
    """The Fisher matrix of TRPO has this everywhere."""

    def spoilt(self: Any, vector: Tensor) -> Tensor:
        return torch.full_like(vector, value)

    _GaussianProblem.fisher_product = spoilt


def spoil_simulation(what: str, value: float, at: int) -> None:
    """On its n-th step the simulation gives this as a reward, or is in this state."""
    count = iter(range(10**9))
    if what == "state":
        batch = simulation.Batch

        class Spoilt(batch):  # type: ignore[misc, valid-type]
            def step(self, *arguments: Any, **options: Any) -> Any:
                found = super().step(*arguments, **options)
                if next(count) % 50 == at:
                    self.bind("qpos")[0] = value
                return found

        simulation.Batch = Spoilt  # type: ignore[misc]
        return
    step = simulation.TaskSimulation.step

    def spoilt(self: simulation.TaskSimulation, *arguments: Any) -> Any:
        reward, terminated, bad = step(self, *arguments)
        if next(count) % 50 == at:
            reward = reward.clone()
            reward[0] = value
        return simulation.TaskStep(reward, terminated, bad)

    simulation.TaskSimulation.step = spoilt  # type: ignore[method-assign]


@dataclass
class Spoilt:
    """A way in which a training goes wrong.

    Attributes:
        name: for the table.
        prepare: done in its process.
        overrides: settings.
        surely: whether it has to stop; else it may count what went wrong and go on.
        algorithms: those it can happen to.
        policy: whether it is the policy that may give no numbers, which no setting lets go on.
    """

    name: str
    prepare: Callable[[], object] | None
    overrides: tuple[str, ...] = ()
    surely: bool = True
    algorithms: tuple[str, ...] = ("METRPO", "PETS", "MBMF")
    policy: bool = False


def ways() -> list[Spoilt]:
    """All of them; the quick attack tries the first two."""
    nan, inf = math.nan, math.inf
    return [
        Spoilt("weights of nan", partial(spoil_weights, nan, 1)),
        Spoilt("reward of nan", partial(spoil_simulation, "reward", nan, 3)),
        Spoilt("weights of inf", partial(spoil_weights, inf, 1)),
        Spoilt("weights of 1e30", partial(spoil_weights, 1e30, 1)),
        Spoilt("loss of inf", partial(spoil_loss, inf, 1)),
        Spoilt("loss of nan", partial(spoil_loss, nan, 0)),
        Spoilt("learning rate of 1e30", None, ("fit.learning_rate=1e30",), surely=False),
        Spoilt("reward of inf", partial(spoil_simulation, "reward", inf, 3)),
        Spoilt("state of nan", partial(spoil_simulation, "state", nan, 3), surely=False),
        Spoilt("state of 1e30", partial(spoil_simulation, "state", 1e30, 3), surely=False),
        Spoilt("curvature of nan", partial(spoil_curvature, nan), algorithms=("METRPO",)),
        Spoilt("curvature of inf", partial(spoil_curvature, inf), algorithms=("METRPO",)),
        Spoilt("temperature of the cloning", None, ("cloning.learning_rate=1e30",), surely=False,
               algorithms=("MBMF",), policy=True),
        Spoilt("fine-tuning with a rate of 1e30", None,
               ("fine_tuning.learning_rate=1e30", "fine_tuning.value_learning_rate=1e30"),
               surely=False, algorithms=("MBMF",), policy=True),
    ]  # fmt: skip


def trainings(attack: Attack) -> list[Row]:
    """Each way in which each algorithm goes wrong, with ``on_divergence`` stop and warn."""
    found = []
    for name in ("METRPO",) if attack.quick else RUNS:
        if attack.match not in name:
            continue
        recipe, overrides = RUNS[name]
        healthy = attack.folder / f"{name}_healthy"
        arguments = ["run", recipe, *overrides, "--resume"]
        said = command([*arguments, f"run_dir={healthy}"], healthy.with_suffix(".log"))
        row = Row(f"divergence: {name}")
        found.append(row)
        if problem := said.problem():
            row.add("healthy", problem)
            continue
        chosen = [way for way in ways() if name in way.algorithms]
        for way in chosen[: attack.some(len(chosen), 2)]:
            for mode in ("stop", "warn"):
                folder = attack.folder / f"{name}_{way.name}_{mode}".replace(" ", "_")
                this = [*arguments, f"on_divergence={mode}", *way.overrides, f"run_dir={folder}"]
                _train(row, way, mode, this, folder, healthy)
    return found


def _train(
    row: Row, way: Spoilt, mode: str, arguments: list[str], folder: Path, healthy: Path
) -> None:
    what = f"{way.name}, {mode}"
    log = folder.with_suffix(".log")
    said = command(arguments, log, way.prepare)
    problem: str | None = None
    stopped = said.status != 0
    if (mode == "stop" and (way.surely or stopped)) or (way.policy and stopped):
        problem = said.refusal(r"training diverged in iteration \d+, [^:]+: .*; look at ")
    else:
        problem = said.problem()
    table, good = metrics(folder), metrics(healthy)
    marked = [row for row in table if float(row.get("diverged") or 0) > 0]
    if not problem and mode == "warn" and way.surely and not marked:
        problem = "not marked"
    if not problem and not marked and (silent := _silent(table, good)):
        problem = f"no numbers in {silent}, and nobody says so"
    if not problem and said.status == 1 and table and not marked:
        problem = "stopped, but not marked in metrics.csv"
    if not problem and (marked or said.status == 1):
        page = command(["report", str(folder), "--output", f"{folder}_report"], log)
        text = Path(f"{folder}_report", "report.md")
        told = page.text + (text.read_text() if text.exists() else "")
        # Returns of no number enter no report; then the reason is told.
        if table and (page.problem((0, 1)) or "training diverged in" not in told):
            problem = page.problem((0, 1)) or "not in the report"
    lost = None
    if not problem and said.status == 1 and not way.overrides:
        again = command(arguments, log)
        problem = again.problem()
        if not problem and results(folder) != results(healthy):
            lost = "the run that went on from the last good checkpoint differs"
    row.add(what, problem, lost)


def metrics(folder: Path) -> list[dict[str, str]]:
    file = folder / "metrics.csv"
    return list(csv.DictReader(file.open())) if file.exists() else []


def _silent(table: list[dict[str, str]], good: list[dict[str, str]]) -> str:
    """Columns that are no numbers and are so in no healthy run."""
    wrong = {
        name
        for row, other in zip(table, good, strict=False)
        for name, value in row.items()
        if value and not math.isfinite(float(value)) and math.isfinite(float(other.get(name) or 0))
    }
    return ", ".join(sorted(wrong))
