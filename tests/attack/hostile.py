"""Files and names from somebody who means harm: refused or harmless, and nothing of theirs runs."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.attack.kills import METRPO_TINY
from tests.attack.outcome import Attack, Row, Said, changes, command, contents
from torchrl_l1.campaign.description import dump_yaml
from torchrl_l1.experiment.files import saved

RECIPE = "metrpo/inverted_pendulum"
OVERRIDES = [*METRPO_TINY, "outer_iterations=2", "fit.max_epochs=2"]


class Harm:
    """Makes a folder when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.target),)


@dataclass
class Place:
    """Where an attack of this kind takes place.

    Attributes:
        folder: to write files into; a copy of a finished run is in ``run``, of a controller in
            ``controller``.
        harm: the folder that code of the file's would make.
    """

    folder: Path
    harm: Path

    @property
    def run(self) -> Path:
        return self.folder / "run"

    @property
    def controller(self) -> Path:
        return self.folder / "controller"

    def write(self, name: str, content: str | bytes) -> str:
        file = self.folder / name
        file.write_bytes(content.encode() if isinstance(content, str) else content)
        return str(file)

    def recipe(
        self, text: str, defaults: str = "metrpo_recipe, _self_", tiny: bool = True
    ) -> list[str]:
        head = f"defaults: [{defaults}]\nrecipe: own\ntask: inverted_pendulum\n"
        overrides = OVERRIDES if tiny else ["wandb.mode=disabled", "outer_iterations=1"]
        return [
            "run",
            self.write("own.yaml", head + text),
            *overrides,
            f"run_dir={self.folder / 'out'}",
        ]

    def campaign(self, **changed: Any) -> list[str]:
        one = {"recipe": RECIPE, "overrides": OVERRIDES, "matrix": {"seed": [0]}}
        content: dict[str, Any] = {"runs": [one]}
        for key, value in changed.items():
            if key in ("name", "evaluations", "description"):
                content[key] = value
            else:
                one[key] = value
        file = self.write("own.yaml", dump_yaml(content))
        return ["campaign", file, "--list", "--output", str(self.folder / "out")]

    def evaluation(self, **changed: Any) -> list[str]:
        return self.campaign(evaluations=[{"name": "noisy", "l1": ["off"], **changed}])

    def stored(self, **changed: Any) -> list[str]:
        """A controller with other entries, and without digests of its files."""
        file = self.controller / "controller.json"
        content = json.loads(file.read_text())
        file.write_text(json.dumps({**content, "files": {}, **changed}))
        return ["export", str(self.controller), str(self.folder / "policy.pt"), "--steps", "2"]


def bomb(levels: int = 9) -> str:
    """A few lines that are a billion entries."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    for level in range(levels):
        lines.append(f"a{level + 1}: &a{level + 1} [{', '.join([f'*a{level}'] * 10)}]")
    return "\n".join(lines) + "\n"


def _code(place: Place) -> str:
    return f"import os; os.mkdir({str(place.harm)!r})\n"


def _target(place: Place) -> str:
    return f"{{_target_: os.mkdir, path: {place.harm}}}"


# What is tried, by kind. Each gives the arguments of a command.
Case = Callable[[Place], list[str]]

CODE: dict[str, Case] = {
    "callback in a recipe": lambda p: p.recipe(f"hydra: {{callbacks: {{x: {_target(p)}}}}}\n"),
    "launcher in a recipe": lambda p: p.recipe(f"hydra: {{launcher: {_target(p)}}}\n"),
    "quoted section": lambda p: p.recipe(f'"hydra": {{sweeper: {_target(p)}}}\n'),
    "dotted section": lambda p: p.recipe(f"hydra.callbacks.x: {_target(p)}\n"),
    "merge key": lambda p: p.recipe(f"<<: {{hydra: {{callbacks: {{x: {_target(p)}}}}}}}\n"),
    "package directive": lambda p: p.recipe(
        "", _beside(p, "callbacks: {x: " + _target(p) + "}") + "@hydra"
    ),
    "package header": lambda p: p.recipe(
        "", _beside(p, "# @package hydra\ncallbacks: {x: " + _target(p) + "}")
    ),
    "global package": lambda p: p.recipe(
        "", _beside(p, "# @package _global_\nhydra: {callbacks: {x: " + _target(p) + "}}")
    ),
    "override of a group": lambda p: p.recipe(
        "", "metrpo_recipe, {override hydra/launcher: joblib}, _self_"
    ),
    "search path": lambda p: p.recipe("hydra: {searchpath: [pkg://os]}\n"),
    "run dir of Hydra": lambda p: p.recipe(f"hydra: {{run: {{dir: {p.harm}}}}}\n"),
    "_target_ at the top": lambda p: p.recipe(f"_target_: os.mkdir\npath: {p.harm}\n"),
    "_target_ in the model": lambda p: p.recipe(f"model: {_target(p)}\n"),
    "_target_ in l1": lambda p: p.recipe(f"l1: {_target(p)}\n"),
    "YAML tag": lambda p: p.recipe(f"seed: !!python/object/apply:os.mkdir ['{p.harm}']\n"),
    "YAML name": lambda p: p.recipe("task: !!python/name:os.abort\n"),
    "resolver": lambda p: p.recipe(f"task: ${{eval:__import__('os').mkdir('{p.harm}')}}\n"),
    "campaign, override": lambda p: p.campaign(
        overrides=[*OVERRIDES, f"+hydra.callbacks.x={{_target_: os.mkdir, path: {p.harm}}}"]
    ),
    "campaign, ++override": lambda p: p.campaign(
        overrides=[*OVERRIDES, f"++hydra.callbacks.x={{_target_: os.mkdir, path: {p.harm}}}"]
    ),
    "campaign, group": lambda p: p.campaign(overrides=[*OVERRIDES, "hydra/launcher=joblib"]),
    "campaign, matrix": lambda p: p.campaign(matrix={"hydra/launcher": ["joblib"]}),
    "campaign, package": lambda p: p.campaign(overrides=[*OVERRIDES, "l1@hydra=off"]),
    "campaign, own recipe": lambda p: p.campaign(
        recipe=p.recipe(f"hydra: {{callbacks: {{x: {_target(p)}}}}}\n")[1]
    ),
    "campaign, YAML tag": lambda p: [
        "campaign", p.write("own.yaml", f"runs: !!python/object/apply:os.mkdir ['{p.harm}']\n"),
        "--list",
    ],
}  # fmt: skip


def _beside(place: Place, text: str) -> str:
    """Defaults of a recipe that include a file beside it."""
    place.write("other.yaml", text + "\n")
    return "metrpo_recipe, _self_, other"


def _pickled(name: str, arguments: Callable[[Place], list[str]]) -> Case:
    def make(place: Place) -> list[str]:
        (place.folder / name).write_bytes(pickle.dumps(Harm(place.harm)))
        return arguments(place)

    return make


def _zipped(name: str, arguments: Callable[[Place], list[str]]) -> Case:
    def make(place: Place) -> list[str]:
        (place.folder / name).write_bytes(saved({"algorithm": Harm(place.harm)}))
        return arguments(place)

    return make


def _resume(place: Place) -> list[str]:
    return ["run", RECIPE, *OVERRIDES, f"run_dir={place.run}", "--resume"]


def _evaluate(place: Place) -> list[str]:
    return ["evaluate", str(place.run), "--l1", "off", "--episodes", "1"]


def _play(place: Place) -> list[str]:
    return ["export", str(place.run), str(place.folder / "policy.pt"), "--steps", "2"]


def _traces(place: Place) -> list[str]:
    np.savez(place.folder / "t.npz", **{"a/b/obs": np.array([Harm(place.harm)], dtype=object)})
    return ["verify", str(place.folder / "t.npz")]


def _single(place: Place) -> list[str]:
    np.save(place.folder / "t.npy", np.array([Harm(place.harm)], dtype=object))
    os.rename(place.folder / "t.npy", place.folder / "t.npz")
    return ["verify", str(place.folder / "t.npz")]


def _weights(place: Place) -> list[str]:
    place.write("m.py", "import torch\npolicy = torch.nn.Linear(4, 1)\n")
    torch.save({"weight": Harm(place.harm)}, place.folder / "w.pt")
    file, film = place.folder / "w.pt", place.folder / "f.gif"
    policy = ["--policy", f"{place.folder / 'm.py'}:policy", "--weights", str(file)]
    return ["play", "inverted_pendulum", *policy, "--output", str(film)]


def _code_file(place: Place) -> str:
    return place.write("evil.py", _code(place) + "def make():\n    pass\n") + ":make"


def _zip_of_models(place: Place) -> str:
    with zipfile.ZipFile(place.controller / "policy.zip", "w") as archive:
        archive.writestr("data", pickle.dumps(Harm(place.harm)))
    return "sb3:policy.zip"


PICKLES: dict[str, Case] = {
    "checkpoint": _pickled("run/checkpoint.pt", _resume),
    "checkpoint of torch": _zipped("run/checkpoint.pt", _resume),
    "both checkpoints": lambda p: (
        _pickled("run/checkpoint.pt", _evaluate)(p)
        and _pickled("run/checkpoint_previous.pt", _evaluate)(p)
    ),
    "checkpoint, evaluate": _zipped("run/checkpoint.pt", _evaluate),
    "checkpoint, export": _zipped("run/checkpoint.pt", _play),
    "traces": _traces,
    "traces, one array": _single,
    "weights": _weights,
    "traces, no archive": _pickled("t.npz", lambda p: ["verify", str(p.folder / "t.npz")]),
    "controller, a file of Python": lambda p: p.stored(policy=_code_file(p)),
    "controller, an environment of Python": lambda p: p.stored(environment=_code_file(p)),
    "controller, a module": lambda p: p.stored(policy="os:abort"),
    "controller, a module as environment": lambda p: p.stored(environment="os:abort"),
    "controller, a package of Gymnasium's": lambda p: p.stored(environment="gymnasium/os:X-v0"),
    "controller, a kind as a module": lambda p: p.stored(environment="onnx:abort"),
    "controller, Stable-Baselines3": lambda p: p.stored(policy=_zip_of_models(p)),
    "controller, VecNormalize": lambda p: (
        _pickled("controller/n.pkl", lambda q: q.stored(normalization="n.pkl"))(p)
    ),
    "controller, weights": lambda p: (
        _pickled("controller/w.pkl", lambda q: q.stored(weights="w.pkl"))(p)
    ),
    "controller, model": _pickled("controller/model.safetensors", lambda p: p.stored()),
    "controller, TorchScript": _pickled(
        "controller/p.pt", lambda p: p.stored(policy="torchscript:p.pt")
    ),
}  # fmt: skip

NAMES: dict[str, Case] = {
    "campaign": lambda p: p.campaign(name="../../outside"),
    "campaign, absolute": lambda p: p.campaign(name=str(p.folder.parent / "outside")),
    "campaign, hidden": lambda p: p.campaign(name=".ssh"),
    "campaign, a list": lambda p: p.campaign(name=["x"]),
    "campaign, long": lambda p: p.campaign(name="x" * 5000),
    "campaign, line": lambda p: p.campaign(name="x\ny"),
    "evaluation": lambda p: p.evaluation(name="../../outside"),
    "evaluation, dots": lambda p: p.evaluation(name=".."),
    "evaluation, absolute": lambda p: p.evaluation(name="/tmp/outside"),
    "evaluation, l1": lambda p: p.evaluation(l1=["../../../paper"]),
    "evaluation, noise": lambda p: p.evaluation(noise=["../noise/action"]),
    "evaluation, suite": lambda p: p.evaluation(suite="../quick"),
    "evaluation, stage": lambda p: p.evaluation(stage=["../policy"]),
    "matrix value": lambda p: p.campaign(matrix={"label": ["../nominal"]}),
    "matrix value, dots": lambda p: p.campaign(matrix={"recipe": [".."]}),
    "matrix key": lambda p: p.campaign(matrix={"../l1": ["off"]}),
    "matrix seed": lambda p: p.campaign(matrix={"seed": ["../0"]}),
    "run_dir by the campaign": lambda p: p.campaign(overrides=[f"run_dir={p.folder.parent / 'x'}"]),
    "recipe of a campaign": lambda p: p.campaign(recipe="../../../etc/passwd"),
    "group": lambda p: ["run", RECIPE, "l1=../../../../etc/passwd", "run_dir=x", "--cfg", "job"],
    "include": lambda p: p.recipe("", "metrpo_recipe, {l1: ../../../../../etc/passwd}, _self_"),
    "evaluate --noise": lambda p: [*_evaluate(p), "--noise", "../noise/action"],
    "evaluate --l1": lambda p: ["evaluate", str(p.run), "--l1", "../../off"],
    "label": lambda p: p.recipe("label: ../../x\n"),
    "controller, weights": lambda p: p.stored(weights="../../../etc/passwd"),
    "controller, policy": lambda p: p.stored(policy="torchscript:../../../etc/passwd"),
    "controller, preset": lambda p: p.stored(preset="../paper"),
    "table of an evaluation": lambda p: (
        (p.run / "evaluations").mkdir()
        or ((p.run / "evaluations" / "$x$ `b` <b>.csv").write_text("x\n")
        and ["report", str(p.run)])
    ),
}  # fmt: skip


def _config(place: Place, text: str) -> list[str]:
    (place.run / "config.yaml").write_text(text)
    return ["report", str(place.run)]


def _in_place(name: str, arguments: Callable[[Place], list[str]]) -> Case:
    """A pipe in the place of a file: whoever opens it waits for ever."""

    def make(place: Place) -> list[str]:
        (place.folder / name).unlink(missing_ok=True)
        os.mkfifo(place.folder / name)
        return arguments(place)

    return make


def _report(place: Place) -> list[str]:
    return ["report", str(place.run), "--output", str(place.folder / "report")]


def _model(place: Place, **changed: Any) -> list[str]:
    """A model whose checksum fits and whose settings do not."""
    from safetensors import safe_open
    from safetensors.torch import save_file

    from torchrl_l1.dynamics.storage import _digest

    file = place.controller / "model.safetensors"
    with safe_open(file, "pt") as opened:
        metadata = dict(opened.metadata())
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    metadata["settings"] = json.dumps({**json.loads(metadata["settings"]), **changed})
    metadata["sha256"] = _digest(metadata["settings"], tensors.items())
    save_file(tensors, file, metadata)
    return place.stored()


SIZES: dict[str, Case] = {
    "YAML aliases, recipe": lambda p: p.recipe(bomb()),
    "YAML aliases, campaign": lambda p: [
        "campaign", p.write("own.yaml", bomb() + f"runs: *a{9}\n"), "--list"
    ],
    "YAML aliases, config.yaml": lambda p: _config(p, bomb() + "task: x\nseed: 0\n"),
    "YAML alias of itself": lambda p: _config(p, "task: &x [*x]\nseed: 0\n"),
    "YAML depth, recipe": lambda p: p.recipe("discount: " + "[" * 50_000 + "\n"),
    "YAML depth, config.yaml": lambda p: _config(p, "task: " + "{a: " * 20_000),
    "YAML length": lambda p: p.recipe("# " + "x" * 2_000_000 + "\n"),
    "interpolation": lambda p: p.recipe("discount: ${gae_lambda}\ngae_lambda: ${discount}\n"),
    "long number": lambda p: p.recipe(f"seed: {'9' * 10_000}\n"),
    "big network": lambda p: p.recipe(
        "model: {hidden: [100000000, 100000000]}\n", tiny=False
    ),
    "JSON depth": lambda p: (
        (p.controller / "controller.json").write_text("[" * 100_000)
        and ["export", str(p.controller), str(p.folder / "policy.pt")]
    ),
    "JSON depth, versions": lambda p: (
        (p.run / "versions.json").write_text("[" * 100_000) and _report(p)
    ),
    "model, layers": lambda p: _model(p, hidden=[10_000_000, 10_000_000]),
    "model, members": lambda p: _model(p, members=10**9),
    "model, head": lambda p: _model(p, head={"name": "gaussian", "dim": 10**12}),
    "model, kind": lambda p: _model(p, form="os.abort"),
    "pipe: config.yaml": _in_place("run/config.yaml", _report),
    "pipe: metrics.csv": _in_place("run/metrics.csv", _report),
    "pipe: versions.json": _in_place("run/versions.json", _report),
    "pipe: checkpoint.pt": _in_place("run/checkpoint.pt", _resume),
    "pipe: .lock": _in_place("run/.lock", _resume),
    "pipe: recipe": _in_place("own.yaml", lambda p: ["run", str(p.folder / "own.yaml")]),
    "pipe: campaign": _in_place("own.yaml", lambda p: ["campaign", str(p.folder / "own.yaml")]),
    "pipe: traces": _in_place("t.npz", lambda p: ["verify", str(p.folder / "t.npz")]),
    "pipe: controller.json": _in_place(
        "controller/controller.json",
        lambda p: ["export", str(p.controller), str(p.folder / "policy.pt")],
    ),
    "pipe: model.safetensors": _in_place("controller/model.safetensors", lambda p: p.stored()),
    "pipe: curves": _in_place(
        "c.csv", lambda p: [*_report(p), "--reference-curves", str(p.folder / "c.csv")]
    ),
}  # fmt: skip

KINDS: dict[str, dict[str, Case]] = {
    "hostile: code in recipes and campaigns": CODE,
    "hostile: pickles and named code": PICKLES,
    "hostile: names with ../ and the like": NAMES,
    "hostile: sizes, depths, pipes": SIZES,
}


def rows(attack: Attack) -> list[Row]:
    """Each case in a folder of its own, and nothing may happen outside it."""
    source = attack.folder / "source"
    said = command(["run", RECIPE, *OVERRIDES, f"run_dir={source / 'run'}"], attack.folder / "log")
    assert said.status == 0, said.text
    _controller(source)
    found = []
    for kind, cases in KINDS.items():
        if attack.match not in kind:
            continue
        row = Row(kind)
        chosen = list(cases.items())
        for name, case in chosen[:: max(1, len(chosen) // 3)] if attack.quick else chosen:
            _attempt(row, name, case, attack.folder / "cases" / f"{len(found)}_{row.tried}", source)
        found.append(row)
    return found


def _controller(folder: Path) -> None:
    arguments = ["robustify", "inverted_pendulum", "--policy", str(folder / "run"), "--steps", "60"]
    options = ["--episodes", "1", "--most-steps", "5", "--output", str(folder / "robust")]
    said = command([*arguments, *options], folder / "robustify.log")
    assert said.status == 0, said.text
    shutil.move(folder / "robust" / "controller", folder / "controller")
    shutil.rmtree(folder / "robust")


def _attempt(row: Row, name: str, case: Case, folder: Path, source: Path) -> None:
    inside = folder / "a" / "b"
    shutil.copytree(source, inside)
    place = Place(inside, folder / "harm")
    try:
        arguments = case(place)
    except Exception as error:
        row.add(name, f"the attack itself failed: {error!r}")
        return
    before = contents(source)
    said = command(arguments, folder / "log")
    allowed = {"a", "log", "report"}
    outside = {path.name for path in folder.iterdir()} - allowed
    outside |= {path.name for path in (folder / "a").iterdir()} - {"b"}
    problem = said.problem((0, 1, 2)) or _lines(said)
    if place.harm.exists():
        problem = "code of the file's was run"
    elif outside:
        problem = f"written outside: {', '.join(sorted(outside))}"
    row.add(name, problem, changes(before, contents(source)))


def _lines(said: Said) -> str | None:
    """A refusal is one line; usage errors of the command line have two."""
    lines = [line for line in said.text.splitlines() if line.startswith("torchrl-l1")]
    if said.status == 1 and len(lines) != 1:
        return f"{len(lines)} lines: {said.text[-300:]}"
    return None
