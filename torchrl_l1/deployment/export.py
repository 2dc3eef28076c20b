"""Policy and L1 as one function with explicit state, for machines without TorchRL."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import tensordict
import torch
import torchrl
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.fx.experimental.symbolic_shapes import GuardOnDataDependentSymNode
from torchrl.envs import CatTensors, Compose, DTypeCastTransform, EnvBase, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.utils import get_primers_from_module

from torchrl_l1.atomic import write_atomically
from torchrl_l1.checks import check_choice, check_count
from torchrl_l1.control import ActionJacobian, L1Config, L1State, L1Transform, augment, init
from torchrl_l1.control.pipeline import transforms_of
from torchrl_l1.deployment.assessment import run_episodes
from torchrl_l1.deployment.controller_folder import check_spares
from torchrl_l1.deployment.policies import FunctionPolicy
from torchrl_l1.deployment.robust_controller import RobustController
from torchrl_l1.deployment.unrolled import UNROLLED
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs.references import require
from torchrl_l1.experiment.files import make_place

FORMATS = {".pt": "torchscript", ".ts": "torchscript", ".onnx": "onnx", ".pt2": "export"}
"""Format of a file by its suffix."""

# Draws around the recorded steps, and the difference allowed there as a fraction of half the action
# range: far from the data, rounding errors are larger.
_DRAWS, _AWAY = 200, 1e-2

_DECIDES = "it branches on values that it sees, and only one branch would be written"

# Loggers that would print whole programs.
_LOGGERS = ("torch.onnx", "torch.export", "torch.fx")

Step = Callable[..., Sequence[Tensor]]


class ControlledStep(nn.Module):
    """One step of policy and L1: observation and state to the executed input and the next state.

    Args:
        policy: the policy; without one, its action is an input beside the observation.
        model: the learned dynamics.
        config: settings of L1, bounds of the action included.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase | None,
        model: EnsembleDynamics,
        config: L1Config,
    ) -> None:
        super().__init__()
        self.config = config
        # Neither is registered, so their weights become constants: tracers walk through the
        # attributes of registered modules, and those of TorchRL's actors raise.
        self.jacobian = ActionJacobian(copy.deepcopy(model).requires_grad_(False))
        self.policies: tuple[TensorDictModuleBase, ...] = ()
        if policy is not None:
            copied = copy.deepcopy(policy)
            for parameter in copied.parameters():
                parameter.detach_()  # parameters of a copied script are not leaves
                parameter.requires_grad_(False)
            self.policies = (copied,)
            # A trace includes scripts as they are, but only registered ones.
            parts = [part for part in copied.modules() if isinstance(part, torch.jit.ScriptModule)]
            self.scripts = nn.ModuleList(parts)
        fresh = init([1], model.observation_dim, model.action_dim, config)
        self.fresh = fresh.entries()

    def forward(self, observation: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The executed input ``(1, m)`` and the next state, in the order of :attr:`fresh`.

        Args:
            observation: ``(1, n)``.
            inputs: the policy's action ``(1, m)`` if there is no policy, then the state.
        """
        if self.policies:
            action, entries = self._act(self.policies[0], observation), list(inputs)
        else:
            action, *entries = inputs
        state = L1State(**dict(zip(self.fresh, entries, strict=True)))
        executed, following, _ = augment(self.config, self.jacobian, state, observation, action)
        return executed, *following.entries().values()

    def _act(self, policy: TensorDictModuleBase, observation: Tensor) -> Tensor:
        if isinstance(policy, FunctionPolicy):
            return policy.act(observation)
        data = TensorDict({"observation": observation}, batch_size=[1])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return policy(data).get("action")


@dataclass(frozen=True)
class Exported:
    """An exported function.

    Attributes:
        file: its file.
        inputs: names of the inputs; all have a batch dimension of one.
        outputs: names of the outputs.
        error: largest difference of the executed input on recorded steps, in action units.
        steps: number of these steps.
        dt: time between two calls of the function in seconds; with any other, the controller is
            wrong.
        preset: its settings of L1.
        transforms: transforms of the environment, starting at the plant, that must be applied to
            observation and action outside the file; where one joins parts to an observation, the
            parts are listed in order.
    """

    file: Path
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    error: float
    steps: int
    dt: float
    preset: str
    transforms: tuple[str, ...] = ()


def export(
    robust: RobustController,
    file: str | Path,
    *,
    format: str | None = None,
    preset: str | None = None,
    with_policy: bool = True,
    steps: int = 100,
    tolerance: float = 1e-4,
    seed: int = 0,
) -> Exported:
    """Write a policy with L1 as one function, and compare it with the original.

    Inputs are ``observation (1, n)`` and the entries of :class:`~torchrl_l1.control.L1State` that
    the settings need; outputs are ``action (1, m)`` and the same entries for the next step, with
    ``next_`` prefixed to their names. An episode begins with zeros (``started`` false), as
    :func:`~torchrl_l1.control.init` makes them. All are float32 except ``n_switch`` (int64) and
    ``started`` (bool).

    Observation and action are those seen through the environment's transforms, which are not
    exported. ``dt``, the time between two calls, and ``preset`` are stored in the file as text:
    ``_extra_files`` of TorchScript, ``extra_files`` of ``torch.export``, metadata of ONNX.

    Args:
        robust: the controller to export.
        file: ``.pt`` or ``.ts`` for TorchScript, ``.onnx``, or ``.pt2`` for a program of
            ``torch.export``.
        format: ``"torchscript"``, ``"onnx"`` or ``"export"``, if the suffix does not tell.
        preset: settings of L1; the default preset if ``None``.
        with_policy: if false, the policy's action is a second input ``u_rl (1, m)``.
        steps: maximum number of environment steps compared; the episode may end earlier.
        tolerance: largest difference allowed, as a fraction of half the action range.
        seed: seed of those steps.

    Returns:
        names of inputs and outputs, the largest difference, and the transforms left outside.

    Raises:
        OSError: if the file cannot be written there.
        ValueError: for an unknown format; a file that the policy comes from; a policy that has a
            memory or is not made of torch operations; a difference above the tolerance; or one
            above a hundredth at observations around the recorded ones, as with a policy that
            branches on values in Python.

    Warns:
        UserWarning: if a traced policy reads values in Python, or if the environment transforms
            the observation or the action.
    """
    file = Path(file)
    if format is None and file.suffix not in FORMATS:
        raise ValueError(f"{file} must end in {', '.join(FORMATS)}; otherwise give a format")
    format = FORMATS[file.suffix] if format is None else format
    check_choice("format", format, ("torchscript", "onnx", "export"))
    check_count("steps", steps)
    if format == "onnx":
        for name in ("onnx", "onnxscript", "onnxruntime"):
            require(name, "onnx")
    check_spares(robust.origin, file)
    if with_policy and get_primers_from_module(robust.policy, warn=False) is not None:
        raise ValueError(
            "the policy remembers something from step to step, as a planner does its plan, which "
            "no file can hold: export L1 alone (with_policy=False, --without-policy)"
        )
    make_place(file)
    config, recorded = _recorded(robust, preset, steps, seed)
    steps = len(recorded)  # the episode may end earlier
    policy = robust.policy if with_policy else None
    preset = robust.preset if preset is None else preset
    facts = {"dt": str(config.dt), "preset": preset}
    first = recorded["observation"][:1]
    given = () if with_policy else (recorded["action"][:1],)
    module: ControlledStep | None = None
    # In a temporary folder: an existing file is kept if this export fails.
    with torch.no_grad(), _quiet() as told, TemporaryDirectory() as folder:
        written = Path(folder, f"function{file.suffix}")
        try:
            module = ControlledStep(policy, robust.model, config).eval()
            names = list(module.fresh)
            inputs = ("observation", *([] if with_policy else ["u_rl"]), *names)
            outputs = ("action", *(f"next_{name}" for name in names))
            example = (first, *given, *module.fresh.values())
            step = _WRITERS[format](module, example, written, facts, inputs, outputs)
        except Exception as error:  # tracers may raise anything
            if not with_policy:
                raise
            raise ValueError(_not_written(error, format, module)) from error
        worst = _compare(step, recorded, module, with_policy)
        box = robust.model.box
        reach = torch.where((box.high - box.low).isfinite(), box.high - box.low, 0.0)
        away = _compare_away(step, recorded, module, with_policy, reach, seed)
        content = written.read_bytes()
    _check_exact(file, config, worst, away, tolerance, steps)
    if lines := _looked_at(told):
        warnings.warn(
            f"the policy reads values in Python ({'; '.join(lines)}): if it branches on them, "
            f"{file} holds only one branch; it agrees with the original in {steps} steps and "
            f"{_DRAWS} draws around them; use torch.where to export both branches",
            stacklevel=2,
        )
    outside = tuple(_outside(robust.source.one()))
    if outside:
        warnings.warn(
            f"{file} does not include the environment's transforms between plant and policy: apply "
            f"{', '.join(outside)} to its observations and actions",
            stacklevel=2,
        )
    write_atomically(file, content)
    return Exported(file, inputs, outputs, worst, steps, config.dt, preset, outside)


def _not_written(error: Exception, format: str, module: ControlledStep | None) -> str:
    """Why a policy cannot be written, and what can be written instead."""
    why = next(iter(str(error).split("\n", 1)), "").strip() or type(error).__name__
    why = _DECIDES if isinstance(error, GuardOnDataDependentSymNode) else why
    other = ""
    if module is not None and why != _DECIDES:  # otherwise no format can hold it
        better = ".pt" if module.scripts else ".pt2"
        other = f"try {better}, or " * (format != FORMATS[better])
    return (
        f"the policy cannot be written as {format} ({why}): {other}export L1 alone "
        "(with_policy=False, --without-policy)"
    )


def _check_exact(
    file: Path, config: L1Config, worst: float, away: float, tolerance: float, steps: int
) -> None:
    """Refuse a function that differs from the original on the recorded steps or around them."""
    half = config.half_range
    half_range = min(half) if isinstance(half, tuple) else half
    allowed = tolerance * half_range
    if not worst <= allowed:
        raise ValueError(
            f"{file} differs from the original by up to {worst:.3g} action units in {steps} steps, "
            f"and {allowed:.3g} are allowed: a policy that draws random numbers or is not made of "
            "torch operations cannot be exported (see with_policy, --without-policy)"
        )
    if not away <= _AWAY * half_range:
        raise ValueError(
            f"{file} equals the original along the recorded steps, but differs by up to "
            f"{away:.3g} action units away from them: the policy branches on values in Python or "
            "NumPy, and only one branch is written (use torch.where, or see with_policy, "
            "--without-policy)"
        )


def _outside(env: EnvBase) -> list[str]:
    """The transforms that the observation or the action passes through, as text."""
    transforms = [one for one in transforms_of(env) if isinstance(one, Transform)]
    observations, actions, found = {"observation"}, {"action"}, []
    for transform in reversed(transforms):
        if isinstance(transform, Compose):
            continue
        reads = observations.intersection(transform.out_keys)
        sends = actions.intersection(transform.out_keys_inv)
        observations |= set(transform.in_keys) if reads else set()
        actions |= set(transform.in_keys_inv) if sends else set()
        # A change of dtype does not count: everything is float32.
        if (reads or sends) and not isinstance(transform, DTypeCastTransform):
            parts = ", ".join(map(str, transform.in_keys))
            joins = isinstance(transform, CatTensors)
            found.append(type(transform).__name__ + f"({parts})" * joins)
    return found[::-1]


def _recorded(
    robust: RobustController, preset: str | None, steps: int, seed: int
) -> tuple[L1Config, TensorDictBase]:
    """The settings with the environment's bounds, and steps ``[T]`` of one episode."""
    transform = L1Transform(robust.model, robust.settings(preset))
    with torch.random.fork_rng(devices=[]):
        data = run_episodes(robust.source, robust.policy, {}, [transform], 1, steps, seed)
    spec = vector_bounds(robust)
    return replace(transform.config, **spec), data.reshape(-1)[:steps]


def vector_bounds(robust: RobustController) -> dict[str, Any]:
    """Action bounds that the settings leave open, taken from the environment."""
    space = getattr(robust.source.one().full_action_spec["action"], "space", None)
    found = {}
    for name, side in (("action_low", "low"), ("action_high", "high")):
        bound = getattr(space, side, None)
        if getattr(robust.config, name) is None and bound is not None:
            found[name] = tuple(bound.reshape(-1).tolist())
    return found


def _compare(
    step: Step, recorded: TensorDictBase, module: ControlledStep, with_policy: bool
) -> float:
    """Largest difference of executed inputs along recorded steps."""
    state: Sequence[Tensor] = list(module.fresh.values())
    worst = 0.0
    for row in recorded:
        given = () if with_policy else (row["action"][None],)
        executed, *state = step(row["observation"][None], *given, *state)
        difference = executed[0] - row["next", "l1", "u_exec"]
        worst = max(worst, float(difference.abs().max()))
        # A NaN difference must not pass for none.
        worst = worst if bool(difference.isfinite().all()) else float("inf")
    return worst


def _compare_away(
    step: Step,
    recorded: TensorDictBase,
    module: ControlledStep,
    with_policy: bool,
    reach: Tensor,
    seed: int,
) -> float:
    """Largest difference of executed inputs at observations and actions around recorded ones.

    Values that a tracer has baked in as constants show only where the policy's episode does not
    lead: up to a hundred times as far as the range of the model's data, ``reach (n,)``, or that of
    the episode if larger.
    """
    generator = torch.Generator().manual_seed(seed)
    seen = recorded["observation"]
    spread = torch.maximum(seen.amax(0) - seen.amin(0), reach.to(seen))
    spread = torch.where(spread > 0, spread, seen.abs().amax(0).clamp_min(1e-3))
    state: Sequence[Tensor] = list(module.fresh.values())
    worst = 0.0
    for number in range(_DRAWS):
        row = recorded[number % len(recorded)]
        size = 10.0 ** torch.empty(1).uniform_(-1.0, 2.0, generator=generator)
        draw = torch.randn(seen.shape[-1], generator=generator)
        observation = (row["observation"] + size * spread * draw)[None]
        given = () if with_policy else (row["action"][None],)
        now = state
        _, *state = module(row["observation"][None], *given, *now)
        try:
            expected, *_ = module(observation, *given, *now)
        except Exception:  # a policy may refuse observations out of its range
            continue
        executed, *_ = step(observation, *given, *now)
        same = (executed == expected) | (executed.isnan() & expected.isnan())
        difference = (executed - expected).abs().masked_fill(same, 0.0)
        worst = max(worst, float(difference.nan_to_num(nan=torch.inf).max()))
    return worst


def _looked_at(told: Sequence[warnings.WarningMessage]) -> list[str]:
    """Lines outside of libraries in which Python read tensor values during tracing."""
    ours = Path(__file__).parents[1]
    libraries = [ours, *(Path(str(m.__file__)).parent for m in (torch, torchrl, tensordict))]
    own = [
        (Path(one.filename), one.lineno)
        for one in told
        if issubclass(one.category, torch.jit.TracerWarning)
    ]
    return list(
        dict.fromkeys(
            f"{file.name}, line {line}"
            for file, line in own
            if not any(file.is_relative_to(folder) for folder in libraries)
        )
    )


def _torchscript(
    module: ControlledStep,
    example: tuple[Tensor, ...],
    file: Path,
    facts: dict[str, str],
    *_: object,
) -> Step:
    traced = torch.jit.freeze(torch.jit.trace(module, example, check_trace=False).eval())
    torch.jit.save(traced, str(file), _extra_files=facts)
    return torch.jit.load(str(file))


def _program(
    module: ControlledStep,
    example: tuple[Tensor, ...],
    file: Path,
    facts: dict[str, str],
    *_: object,
) -> Step:
    torch.export.save(torch.export.export(module, example), str(file), extra_files=facts)
    return torch.export.load(str(file)).module()


def _onnx(
    module: ControlledStep,
    example: tuple[Tensor, ...],
    file: Path,
    facts: dict[str, str],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Step:
    program = torch.onnx.export(
        torch.export.export(module, example).run_decompositions(UNROLLED), example,
        dynamo=True, verbose=False, input_names=list(inputs), output_names=list(outputs),
    )  # fmt: skip
    assert program is not None
    program.model.metadata_props.update(facts)
    program.save(str(file), external_data=False)
    runtime = require("onnxruntime", "onnx")
    session = runtime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    # Values that no output depends on are not inputs of the graph.
    known = {one.name for one in session.get_inputs()}

    def step(*values: Tensor) -> list[Tensor]:
        named = zip(inputs, values, strict=True)
        given = {name: value.numpy() for name, value in named if name in known}
        return [torch.as_tensor(value) for value in session.run(None, given)]

    return step


_WRITERS: dict[str, Callable[..., Step]] = {
    "torchscript": _torchscript,
    "export": _program,
    "onnx": _onnx,
}


@contextmanager
def _quiet() -> Iterator[list[warnings.WarningMessage]]:
    """Silence the exporters; yields the list of their warnings."""
    loggers = {logging.getLogger(name): logging.getLogger(name).level for name in _LOGGERS}
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(record=True) as told, redirect_stderr(StringIO()):
            warnings.simplefilter("always")
            yield told
    finally:
        for logger, before in loggers.items():
            logger.setLevel(before)
