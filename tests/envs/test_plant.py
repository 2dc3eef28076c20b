"""Changes of the plant: against MuJoCo's own compiler, and against Gymnasium."""

from __future__ import annotations

import pickle

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_l1.envs import (
    BatchedMujocoEnv,
    Uniform,
    disturbed_model,
    get_task,
    make_env,
    wind_force,
)
from torchrl_l1.envs.plant import cannot_change

CHANGES = {
    "payload": 0.3,
    "mass": 1.5,
    "friction": 0.5,
    "damping": 2.0,
    "armature": 2.0,
    "slope": 7.0,
    "softness": 2.0,
    "wind": 0.1,
}


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("task", ["half_cheetah", "hopper"])
def test_motion_is_that_of_gymnasium_with_the_changed_model(task, name):
    spec = {"half_cheetah": "HalfCheetah-v5", "hopper": "Hopper-v5"}[task]
    value = CHANGES[name]
    ours = BatchedMujocoEnv(
        task, 2, seed=0, dtype=torch.float64, plant={name: [value, 1e-9 + value]}
    )
    plain = BatchedMujocoEnv(task, 1, seed=0)
    theirs = gymnasium.make(spec, frame_skip=ours.task.frame_skip).unwrapped
    nominal = ours.model
    theirs.model = disturbed_model(nominal, {} if name == "wind" else {name: value})
    theirs.data = mujoco.MjData(theirs.model)
    theirs.reset(seed=0)
    ours.reset()
    qpos, qvel = ours.simulator_state()
    plain.reset()
    plain.set_simulator_state(qpos[:1], qvel[:1])
    theirs.set_state(qpos[0], qvel[0])
    if name == "wind":
        theirs.data.xfrc_applied[:] = wind_force(nominal, value)
    generator = np.random.default_rng(0)
    for _ in range(40):
        action = generator.uniform(-1, 1, ours.task.action_dim)
        both = torch.from_numpy(np.stack([action, action]))
        ours.step(TensorDict({"action": both}, batch_size=[2]))
        plain.step(TensorDict({"action": both[:1]}, batch_size=[1]))
        theirs.do_simulation(action, ours.task.frame_skip)
        found = ours.simulator_state()
        np.testing.assert_array_equal(found[0][0], theirs.data.qpos)
        np.testing.assert_array_equal(found[1][0], theirs.data.qvel)
    assert not np.allclose(plain.simulator_state()[0][0], theirs.data.qpos, atol=1e-6)


def edited(task: str, edit) -> mujoco.MjModel:
    """The model that the compiler makes of an edited file."""
    spec = get_task(task).build_spec()
    edit(spec)
    return get_task(task).build_model(spec)


def test_factors_are_those_that_the_compiler_would_see():
    def edit(spec):
        for joint in spec.joints:
            joint.damping = joint.damping * 3
            joint.armature *= 2
        for geom in spec.geoms:
            geom.friction = geom.friction * 0.5

    reference = edited("hopper", edit)
    factors = {"damping": 3.0, "armature": 2.0, "friction": 0.5}
    model = disturbed_model(get_task("hopper").build_model(), factors)
    for field in (*("dof_damping", "dof_armature", "geom_friction"), *("dof_M0", "dof_invweight0")):
        np.testing.assert_allclose(getattr(model, field), getattr(reference, field), rtol=1e-12)


def test_mass_scales_what_the_compiler_derives_from_it():
    model = get_task("hopper").build_model()
    heavy = disturbed_model(model, {"mass": 2.0, "armature": 2.0})
    np.testing.assert_allclose(heavy.body_mass, 2 * model.body_mass)
    np.testing.assert_allclose(heavy.body_inertia, 2 * model.body_inertia)
    np.testing.assert_allclose(heavy.body_subtreemass, 2 * model.body_subtreemass)
    np.testing.assert_allclose(heavy.dof_M0, 2 * model.dof_M0)
    np.testing.assert_allclose(heavy.dof_invweight0, model.dof_invweight0 / 2)


def test_payload_slope_and_wind_in_newtons():
    model = get_task("hopper").build_model()
    total = model.body_mass.sum()
    loaded = disturbed_model(model, {"payload": 0.25})
    assert loaded.body_mass.sum() == pytest.approx(1.25 * total)
    assert loaded.body("torso").mass[0] - model.body("torso").mass[0] == pytest.approx(total / 4)
    tilted = disturbed_model(model, {"slope": 30.0}).opt.gravity
    np.testing.assert_allclose(tilted, [-9.81 / 2, 0, -9.81 * np.sqrt(3) / 2])
    force = wind_force(model, -0.1, body="foot")
    assert np.flatnonzero(force.any(1)).tolist() == [model.body("foot").id]
    np.testing.assert_allclose(force[force != 0], [-0.1 * 9.81 * total])


def test_a_payload_in_a_fluid_leaves_the_drag_as_it_is():
    task = get_task("swimmer")
    model = task.build_model()
    torso = model.body("torso").id
    denser = 1 + 0.3 * model.body_mass.sum() / model.body_mass[torso]

    def edit(spec):
        spec.body("torso").geoms[0].density *= denser

    loaded, reference = disturbed_model(model, {"payload": 0.3}), edited("swimmer", edit)
    for field in ("body_mass", "body_inertia", "dof_M0", "body_subtreemass"):
        np.testing.assert_allclose(getattr(loaded, field), getattr(reference, field), rtol=1e-9)
    drags = []
    for one in (model, loaded):
        data = mujoco.MjData(one)
        data.qvel[:] = [0.3, -0.2, 0.5, 0.4, -0.3]
        mujoco.mj_forward(one, data)
        drags.append(data.qfrc_passive.copy())
    np.testing.assert_allclose(*drags, rtol=1e-9)
    assert abs(drags[0]).min() > 1


def test_damping_that_grows_with_the_velocity_is_scaled_as_a_whole():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint type="hinge" axis="0 1 0" damping="1 2"/>
        <geom size=".1"/></body></worldbody></mujoco>"""
    )
    forces = []
    for one in (model, disturbed_model(model, {"damping": 3.0})):
        data = mujoco.MjData(one)
        data.qvel[:] = 2.0
        mujoco.mj_forward(one, data)
        forces.append(data.qfrc_passive[0])
    assert forces[0] < -2.0  # more than its constant part
    assert forces[1] == pytest.approx(3 * forces[0])


def test_friction_of_one_body_is_a_factor_on_its_contacts_or_refused():
    model = get_task("half_cheetah").build_model()
    foot = model.geom("bfoot").id

    def friction(changes):
        one = disturbed_model(model, changes, body="bfoot") if changes else model
        data = mujoco.MjData(one)
        data.qpos[1] = -0.15
        mujoco.mj_forward(one, data)
        return {
            tuple(contact.geom): contact.friction[0]
            for contact in data.contact
            if foot in contact.geom
        }

    before = friction({})
    assert len(before) == 1
    for factor in (0.5, 0.0):
        with pytest.raises(
            ValueError, match=r"friction .* of 'bfoot' alone: a contact has the lar"
        ):
            friction({"friction": factor})
    assert friction({"friction": 2.0}) == {pair: 2 * value for pair, value in before.items()}
    model.geom_priority[foot] = 1
    assert friction({"friction": 0.5}) == {pair: value / 2 for pair, value in before.items()}


def test_softness_keeps_the_damping_ratio_of_either_format():
    model = get_task("hopper").build_model()
    model.geom_solref[0] = [0.02, 0.7]
    model.geom_solref[1] = [-900.0, -30.0]
    soft = disturbed_model(model, {"softness": 3.0})
    np.testing.assert_allclose(soft.geom_solref[:2], [[0.06, 0.7], [-100.0, -10.0]])


def test_the_model_itself_stays_and_one_body_can_be_chosen():
    model = get_task("half_cheetah").build_model()
    before = (model.body_mass.copy(), model.geom_friction.copy(), model.dof_damping.copy())
    changed = disturbed_model(model, {"mass": 2.0, "friction": 3.0, "damping": 4.0}, body="bshin")
    for old, now in zip(
        before, (model.body_mass, model.geom_friction, model.dof_damping), strict=True
    ):
        np.testing.assert_array_equal(old, now)
    number = model.body("bshin").id
    assert np.flatnonzero(changed.body_mass != model.body_mass).tolist() == [number]
    geoms = np.flatnonzero((changed.geom_friction != model.geom_friction).any(1))
    assert (model.geom_bodyid[geoms] == number).all() and geoms.size
    joints = np.flatnonzero(changed.dof_damping != model.dof_damping)
    assert (model.dof_bodyid[joints] == number).all() and joints.size


def test_values_are_drawn_where_an_episode_starts_and_survive_pickles():
    torch.manual_seed(0)
    env = BatchedMujocoEnv("hopper", 3, seed=0, plant={"mass": Uniform(0.5, 2.0), "wind": 0.1})
    env.reset()
    simulator = env._simulation.simulator

    def masses() -> list[float]:
        return [float(simulator.batch.get_model(i).body_mass.sum()) for i in range(3)]

    first = masses()
    assert len(set(first)) == 3
    env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, batch_size=[3]))
    second = masses()
    assert second[0] == first[0] and second[2] == first[2] and second[1] != first[1]
    twin = pickle.loads(pickle.dumps(env))
    action = torch.rand(3, 3)
    for one in (env, twin):
        one.step(TensorDict({"action": action}, batch_size=[3]))
    np.testing.assert_array_equal(env.simulator_state()[1], twin.simulator_state()[1])


def test_wind_blows_on_after_partial_resets():
    env = make_env("hopper", 2, wind=[0.1, -0.2], seed=0)
    env.reset()
    expected = np.stack([wind_force(env.base_env.model, v) for v in (0.1, -0.2)])
    forces = env.base_env._simulation.simulator.batch.bind("xfrc_applied")
    np.testing.assert_array_equal(forces, expected)
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, batch_size=[2]))
    env.rand_step(env.reset())
    np.testing.assert_array_equal(forces, expected)


def test_what_can_be_given_a_wind_is_named():
    words = "wind changes the plant, which needs a task of ours, not mine.py:f: leave it out"
    assert cannot_change("mine.py:f", "wind") == words
    assert "a task of ours or one of Gymnasium's MuJoCo environments" in cannot_change("f", "mass")


def test_refusals():
    model = get_task("hopper").build_model()
    for changes, message in (
        ({"colour": 1.0}, "unknown change of the plant 'colour'"),
        ({"mass": 0.0}, "mass must be positive"),
        ({"friction": -1.0}, "friction must not be negative"),
        ({"slope": 90.0}, "slope must be within 90 degrees"),
        ({"damping": float("nan")}, "damping must be finite"),
        ({"wind": 0.1}, "wind is a force"),
    ):
        with pytest.raises(ValueError, match=message):
            disturbed_model(model, changes)
    with pytest.raises(ValueError, match="there is no body 'tail'; there are 'world', 'torso'"):
        disturbed_model(model, {"mass": 2.0}, body="tail")
    with pytest.raises(ValueError, match="leave body out"):
        disturbed_model(model, {"slope": 2.0}, body="torso")
    with pytest.raises(ValueError, match=r"mass has values of shape \(2,\)"):
        BatchedMujocoEnv("hopper", 3, plant={"mass": [1.0, 2.0]})
