"""Disturbances of the plant: changes of a MuJoCo model, and a force that acts on a body.

A change turns one :class:`mujoco.MjModel` into another, so it can disturb both the batched
environments of this package and any MuJoCo environment of Gymnasium. None counts as matched: its
effect on the motion depends on the state, and reaches degrees of freedom without a motor.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch

from torchrl_l1.envs.disturbances import Draw

PlantValue = float | Sequence[float] | np.ndarray | Draw
"""A number, one for each environment, or drawn at resets, for example by ``Uniform``."""

_GRAVITY = 9.81
_ANY = slice(None)

Rows = slice | np.ndarray


def _setconst(model: mujoco.MjModel) -> None:
    # Quantities that MuJoCo derives from masses and armatures when it compiles a model.
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _payload(model: mujoco.MjModel, fraction: float, body: int | None) -> None:
    row = _first_body(model) if body is None else body
    before, added = float(model.body_mass[row]), fraction * float(model.body_mass.sum())
    if before and (model.opt.density or model.opt.viscosity):
        # MuJoCo derives the shape around which a fluid flows from the ratio of inertia and mass.
        model.body_inertia[row] *= (before + added) / before
    model.body_mass[row] = before + added
    _setconst(model)


def _mass(model: mujoco.MjModel, factor: float, body: int | None) -> None:
    rows = _ANY if body is None else [body]
    model.body_mass[rows] *= factor
    model.body_inertia[rows] *= factor
    _setconst(model)


def _friction(model: mujoco.MjModel, factor: float, body: int | None) -> None:
    first, second = (model.geom_bodyid[geoms] for geoms in _touching(model))
    before = _contact_friction(model)
    model.geom_friction[_geoms(model, body)] *= factor
    model.pair_friction[_pairs(model, body)] *= factor
    if body is None:
        return
    own = (first == body) | (second == body)
    if not np.allclose(_contact_friction(model)[own], factor * before[own]):
        raise ValueError(
            f"friction {factor:g} of {model.body(body).name!r} alone: a contact has the larger "
            "friction of its two geoms, and what this body touches keeps its own; leave body out, "
            "or give the geoms of the body a higher priority in the model"
        )


def _damping(model: mujoco.MjModel, factor: float, body: int | None) -> None:
    model.dof_damping[_joints(model, body)] *= factor
    model.dof_dampingpoly[_joints(model, body)] *= factor


def _armature(model: mujoco.MjModel, factor: float, body: int | None) -> None:
    model.dof_armature[_joints(model, body)] *= factor
    _setconst(model)


def _slope(model: mujoco.MjModel, degrees: float, body: int | None) -> None:
    if body is not None:
        raise ValueError("slope tilts gravity, which acts on all bodies; leave body out")
    angle = math.radians(degrees)
    x, _, z = model.opt.gravity.copy()
    model.opt.gravity[0] = x * math.cos(angle) + z * math.sin(angle)
    model.opt.gravity[2] = z * math.cos(angle) - x * math.sin(angle)


def _softness(model: mujoco.MjModel, factor: float, body: int | None) -> None:
    for references in (model.geom_solref, model.pair_solref):
        rows = _geoms(model, body) if references is model.geom_solref else _pairs(model, body)
        chosen = references[rows]
        # Either (time constant, damping ratio), or the negatives of (stiffness, damping).
        timed = chosen[:, :1] > 0
        references[rows] = np.where(timed, chosen * [factor, 1.0], chosen / [factor**2, factor])


class _Change(NamedTuple):
    """How a value changes a model, which values are allowed, and what the model must contain."""

    apply: Callable[[mujoco.MjModel, float, int | None], None]
    neutral: float
    sound: Callable[[float], bool]
    rule: str
    what: str


def _not_negative(value: float) -> bool:
    return value >= 0


def _positive(value: float) -> bool:
    return value > 0


_CHANGES = {
    "payload": _Change(_payload, 0, _not_negative, "must not be negative", "masses"),
    "mass": _Change(_mass, 1, _positive, "must be positive", "masses"),
    "friction": _Change(_friction, 1, _not_negative, "must not be negative", "contacts"),
    "damping": _Change(_damping, 1, _not_negative, "must not be negative", "damped joints"),
    "armature": _Change(_armature, 1, _not_negative, "must not be negative", "inertia of rotors"),
    "slope": _Change(_slope, 0, lambda v: abs(v) < 90, "must be within 90 degrees", "gravity"),
    "softness": _Change(_softness, 1, _positive, "must be positive", "contacts"),
}
_WIND = "wind"
_NAMES = (*_CHANGES, _WIND)


def check_plant(name: str, value: float) -> None:
    """Reject an unknown disturbance of the plant, or a value that it cannot have.

    Raises:
        ValueError: naming both.
    """
    if name not in _NAMES:
        raise ValueError(f"unknown change of the plant {name!r}; there are {', '.join(_NAMES)}")
    if not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value}")
    if name in _CHANGES and not _CHANGES[name].sound(value):
        raise ValueError(f"{name} {_CHANGES[name].rule}, got {value}")


def survives_resets(name: str) -> bool:
    """Whether a change survives Gymnasium's resets, which clear the force of a wind."""
    return name != _WIND


def cannot_change(environment: str, name: str) -> str:
    """The error for a change of the plant that an environment from elsewhere cannot be given."""
    others = "" if name == _WIND else " or one of Gymnasium's MuJoCo environments"
    return (
        f"{name} changes the plant, which needs a task of ours{others}, not {environment}: leave "
        "it out"
    )


def disturbed_model(
    model: mujoco.MjModel, changes: Mapping[str, float], body: str | int | None = None
) -> mujoco.MjModel:
    """A changed copy of a MuJoCo model.

    ======== =============================================== ==============================
    name     what changes                                    value
    ======== =============================================== ==============================
    payload  a point mass in the centre of mass of a body,   fraction of the model's mass
             the first that moves; in a fluid it is spread
             as the mass of the body, whose drag stays
    mass     mass and inertia of all bodies                  factor
    friction friction of all contacts                        factor
    damping  damping of all joints                           factor
    armature inertia of the rotors of all joints             factor
    slope    direction of gravity in the plane of x and z;   degrees
             uphill is along x
    softness time constant of all contacts                   factor
    ======== =============================================== ==============================

    They are applied in this order, and one without any effect (friction where nothing can touch)
    causes a warning. None of them is matched. Damping and armature come closest: if only joints
    with motors have any, the change acts like an input, though one that depends on velocity and
    acceleration.

    Args:
        model: the model, which is not modified.
        changes: value of each change, by name; a factor of 1 changes nothing, nor does 0 for the
            others.
        body: name or number of a body, to change only it, its geoms or its joints.

    Raises:
        ValueError: if there is no such change, value or body; if the friction of a single body is
            changed although its contacts take that of what it touches; for a wind, which is a force
            and not part of a model, see :func:`wind_force`.

    Examples:
        >>> from torchrl_l1.envs import get_task
        >>> model = get_task("half_cheetah").build_model()
        >>> torso = disturbed_model(model, {"mass": 2.0}, body="torso").body("torso")
        >>> round(float(torso.mass[0] / model.body("torso").mass[0]), 2)
        2.0
    """
    if _WIND in changes:
        raise ValueError(
            "wind is a force, not a change of the model: write wind_force to xfrc_applied"
        )
    for name, value in changes.items():
        check_plant(name, value)
    number = _number(model, body)
    changed = copy.copy(model)
    for name, change in _CHANGES.items():
        if name in changes:
            before = _felt(changed)
            change.apply(changed, changes[name], number)
            if changes[name] != change.neutral and np.array_equal(_felt(changed), before):
                warnings.warn(
                    f"{name} {changes[name]:g} does nothing here: the model has no {change.what} "
                    "that it could change",
                    stacklevel=2,
                )
    return changed


def does_nothing(model: mujoco.MjModel, name: str, value: float) -> bool:
    """Whether a change does not affect a model's motion, like friction where nothing touches.

    Args:
        model: the model, which is not modified.
        name: name of the change.
        value: value of the change.
    """
    if name == _WIND:
        return False
    changed = copy.copy(model)
    _CHANGES[name].apply(changed, value, None)
    return np.array_equal(_felt(changed), _felt(model))


def wind_force(model: mujoco.MjModel, value: float, body: str | int | None = None) -> np.ndarray:
    """A force along x on a body, for ``xfrc_applied`` of an ``MjData``; resets clear it.

    Generally not matched: it acts on the body, not on a motor. (On the cart of a pendulum it is.)

    Args:
        model: the model before any other changes.
        value: the force, as a fraction of the weight of all the model's bodies at 9.81 m/s^2.
        body: name or number of a body; the first moving one if ``None``. The force acts at its
            centre of mass.

    Returns:
        Forces and torques ``(nbody, 6)``, newtons and newton metres.

    Raises:
        ValueError: if the value is not finite, or there is no such body.
    """
    check_plant(_WIND, value)
    number = _number(model, body)
    force = np.zeros((model.nbody, 6))
    weight = _GRAVITY * float(model.body_mass.sum())
    force[_first_body(model) if number is None else number, 0] = value * weight
    return force


def _first_body(model: mujoco.MjModel) -> int:
    """The first body with a joint: a torso, a cart."""
    return int(np.flatnonzero(model.body_jntnum)[0])


def _number(model: mujoco.MjModel, body: str | int | None) -> int | None:
    if body is None:
        return None
    try:
        number: int = model.body(body).id
    except (KeyError, IndexError):
        names = ", ".join(repr(model.body(i).name) for i in range(model.nbody))
        raise ValueError(f"there is no body {body!r}; there are {names}") from None
    return number


def _geoms(model: mujoco.MjModel, body: int | None) -> Rows:
    return _ANY if body is None else np.flatnonzero(model.geom_bodyid == body)


def _joints(model: mujoco.MjModel, body: int | None) -> Rows:
    return _ANY if body is None else np.flatnonzero(model.dof_bodyid == body)


def _pairs(model: mujoco.MjModel, body: int | None) -> Rows:
    if body is None:
        return _ANY
    first, second = model.geom_bodyid[model.pair_geom1], model.geom_bodyid[model.pair_geom2]
    return np.flatnonzero((first == body) | (second == body))


def _touching(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of geoms that MuJoCo lets touch each other, apart from a model's explicit pairs."""
    first, second = np.triu_indices(model.ngeom, 1)
    kind, with_ = model.geom_contype, model.geom_conaffinity
    meet = (kind[first] & with_[second] | kind[second] & with_[first]) != 0
    bodies = model.body_weldid[model.geom_bodyid]
    parents = model.body_weldid[model.body_parentid[bodies]]
    one, other = bodies[first], bodies[second]
    joined = (parents[first] == other) & (other != 0) | (parents[second] == one) & (one != 0)
    meet &= (one != other) & ~joined
    return first[meet], second[meet]


def _contact_friction(model: mujoco.MjModel) -> np.ndarray:
    """Sliding friction of each of these pairs: that of the higher priority, else the larger."""
    first, second = _touching(model)
    one, other = model.geom_friction[first, 0], model.geom_friction[second, 0]
    lead = model.geom_priority[first] - model.geom_priority[second]
    return np.where(lead > 0, one, np.where(lead < 0, other, np.maximum(one, other)))


def _felt(model: mujoco.MjModel) -> np.ndarray:
    """The quantities that the changes affect, as far as they affect the motion."""
    references = np.vstack([model.geom_solref[np.union1d(*_touching(model))], model.pair_solref])
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        # No contact is harder than this.
        timed, shortest = references[:, 0] > 0, 2 * model.opt.timestep
        references[timed, 0] = np.maximum(references[timed, 0], shortest)
    fields = (
        *(model.body_mass, model.body_inertia, model.opt.gravity),
        *(model.dof_damping, model.dof_dampingpoly, model.dof_armature),
        *(_contact_friction(model), model.pair_friction, references),
    )
    return np.concatenate([np.ravel(field) for field in fields])


class Plant:
    """Changes of a model, with a value for each of several environments.

    Args:
        model: the model, which is not modified.
        num_envs: number of environments ``N``.
        changes: by name, see :func:`disturbed_model`; also ``wind``, see :func:`wind_force`. Each
            is a number, one for each environment, or drawn at resets.
        body: the body on which all of them act.

    Attributes:
        values: values by name, ``(N,)`` float64.
        is_drawn: whether any are drawn at resets.

    Raises:
        ValueError: if there is no such change, value or body, or not one value for each
            environment.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        changes: Mapping[str, PlantValue],
        body: str | int | None = None,
    ) -> None:
        self._model, self._num_envs, self._body = model, num_envs, body
        self._draws = {name: value for name, value in changes.items() if callable(value)}
        self.is_drawn = bool(self._draws)
        self.values: dict[str, np.ndarray] = {}
        for name, value in changes.items():
            found = self._drawn(name, num_envs) if callable(value) else np.asarray(value, float)
            if found.ndim > 1 or found.size not in (1, num_envs):
                raise ValueError(
                    f"{name} has values of shape {found.shape}, expected one number, or one for "
                    f"each of the {num_envs} environments"
                )
            self.values[name] = np.broadcast_to(found, num_envs).copy()
        self._check()

    def _drawn(self, name: str, count: int) -> np.ndarray:
        return self._draws[name](torch.Size([count, 1])).double().numpy().reshape(count)

    def _check(self) -> None:
        for name, values in self.values.items():
            for value in values:
                check_plant(name, float(value))

    def redraw(self, indices: np.ndarray) -> None:
        """Redraw drawn values, for some environments, from torch's global generator."""
        for name in self._draws:
            self.values[name][indices] = self._drawn(name, len(indices))
        self._check()

    def models(self) -> list[mujoco.MjModel]:
        """The model of each environment; environments with the same values share theirs."""
        names = [name for name in self.values if name != _WIND]
        if not names:
            return [self._model] * self._num_envs
        made: dict[tuple[float, ...], mujoco.MjModel] = {}
        found = []
        for row in zip(*(self.values[name] for name in names), strict=True):
            key = tuple(map(float, row))
            if key not in made:
                changes = dict(zip(names, key, strict=True))
                made[key] = disturbed_model(self._model, changes, self._body)
            found.append(made[key])
        return found

    def forces(self) -> np.ndarray | None:
        """Forces on the bodies ``(N, nbody, 6)``, if there is wind."""
        if _WIND not in self.values:
            return None
        return np.stack([wind_force(self._model, float(v), self._body) for v in self.values[_WIND]])
