"""A robot that is not the Go1 goes through controller and simulators: nothing knows who walks."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import toy_robot

from kjax import RunConfig, load_config
from kjax.legs import spatial
from kjax.legs.kinematics import leg_trig
from kjax.legs.posture import stand_pose
from kjax.robots import get_robot, robot_names
from kjax.robots.robot import Robot
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.metrics import metrics
from kjax.sim.observe import find_addresses
from kjax.sim.resolve import (
    batch_spec,
    build_scene,
    resolve_episode,
    resolve_episodes,
    resolve_goal,
)
from kjax.types import Leg

NAME = "toy_robot:ROBOT"
ROBOT = toy_robot.ROBOT
KEYS = {
    "robot": NAME,
    "duration": 3.0,
    "command.times": [0.0, 0.5],
    "command.v_x": [0.0, 0.4],
    "sim.base": "free",
    "sim.contacts": "feet",
    "lmpc.model_dt": 0.02,
    "lmpc.horizon": 10,
    "lmpc.Q": [3.63, 18.15, 50.0, 25.0, 4.18, 3.45],
}


@pytest.fixture(scope="module")
def config():
    return load_config(RunConfig, None, KEYS)


@pytest.fixture(scope="module")
def model(config):
    return build_scene(config, visual=False)


@pytest.fixture(scope="module")
def at(model):
    return find_addresses(ROBOT, model)


@pytest.fixture(scope="module")
def run(config):
    return simulate(MujocoEngine(batch_spec(config)), resolve_episode(config))


def test_its_numbers_are_those_of_its_model(model, at):
    params = ROBOT.params
    assert model.body_mass.sum() == pytest.approx(float(params.mass), rel=1e-12)
    np.testing.assert_array_equal(
        model.actuator_ctrlrange[at.actuator, 1], [params.torque_limit] * 4
    )
    low, high = np.moveaxis(model.jnt_range[model.dof_jntid[at.qvel]], -1, 0)
    ours = at.sign * (np.stack([low, high]) - at.zero)
    assert (ours.min(axis=0) < params.joint_range[:, 0]).all()
    assert (ours.max(axis=0) > params.joint_range[:, 1]).all()


def test_its_inertia_is_that_of_its_nominal_stance(model, at):
    data = mujoco.MjData(model)
    height, joints = stand_pose(ROBOT.params, float(ROBOT.params.stand_height))
    data.qpos[2], data.qpos[3] = height, 1.0
    at.set_joints(data.qpos, joints)
    mujoco.mj_forward(model, data)
    com = data.subtree_com[at.trunk]
    assert com[2] == pytest.approx(0.36, abs=1e-11)
    inertia = np.zeros((3, 3))
    for body in range(1, model.nbody):
        R, arm = data.ximat[body].reshape(3, 3), data.xipos[body] - com
        inertia += R @ np.diag(model.body_inertia[body]) @ R.T
        inertia += model.body_mass[body] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    np.testing.assert_allclose(ROBOT.params.inertia, inertia, rtol=0, atol=1e-6)


def test_its_joints_are_read_in_our_convention(model, at):
    """Feet where MuJoCo has them, whatever the joints' names, order, signs and zeros."""
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    joints = stand_pose(ROBOT.params, 0.36)[1] + 0.2 * rng.standard_normal((4, 3))
    rates = rng.standard_normal((4, 3))
    data.qpos[3] = 1.0
    at.set_joints(data.qpos, joints)
    data.qvel[at.qvel] = at.sign * rates
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(at.joint_pos(data.qpos), joints, atol=1e-15)
    trig, hip = leg_trig(jnp.asarray(joints)), spatial.hip_trig(jnp.asarray(joints))
    foot = ROBOT.params.hip_pos + spatial.foot_position(ROBOT.params, hip, trig)
    np.testing.assert_allclose(data.geom_xpos[at.feet] - data.qpos[:3], foot, atol=1e-12)
    speed = np.einsum("lij,lj->li", spatial.foot_jacobian(ROBOT.params, hip, trig), rates)
    for leg in Leg:
        J = np.zeros((3, model.nv))
        mujoco.mj_jacGeom(model, data, J, None, at.feet[leg])
        np.testing.assert_allclose(J @ data.qvel, speed[leg], atol=1e-12)


def test_it_trots(run, config):
    """The default gait, gains and bounds scale with it: 25.4 kg on legs of 0.51 m."""
    result = metrics(run, resolve_goal(config))
    assert not run.fell
    assert result["velocity_late_rmse_mps"] < 0.03
    assert result["pitch_max_deg"] < 4.0
    assert result["roll_max_deg"] < 4.0
    assert result["height_mean_m"] == pytest.approx(0.6338 * 0.51, abs=0.01)
    assert result["foot_slip_m"] < 0.01
    assert result["qp_unsolved"] == 0


def test_planned_forces_carry_its_weight(run):
    """The swing legs' loops press the body up as well: the Go1's planned forces are 0.95 of it."""
    late, weight = run.time > 1.0, 25.4 * 9.81
    assert 0.92 < run.force[late, :, 2].sum(axis=1).mean() / weight < 1.02
    assert run.foot_force[late].sum(axis=1).mean() == pytest.approx(weight, rel=0.01)


def test_the_batch_engine_walks_it_alike(run, config):
    recording = BatchEngine(batch_spec(config), dtype=np.float64).run(resolve_episodes([config]))
    assert not recording.fell.any()
    ticks = slice(0, 60)
    single = run.x[:: round(recording.dt / run.dt)][ticks]
    # The same program in another order of sums, before a foot's touchdown makes it grow.
    np.testing.assert_allclose(recording.log.x[ticks, 0], single, atol=1e-8)
    scale = np.abs(run.torque).max()
    np.testing.assert_allclose(
        recording.torque[ticks, 0].reshape(-1, 4, 3),
        run.torque[:: round(recording.dt / run.dt)][ticks],
        atol=1e-6 * scale,
    )


def test_robots_differ_in_the_spec_of_a_batch(config):
    other = dataclasses.replace(config, robot="go1")
    assert batch_spec(config) != batch_spec(other)
    with pytest.raises(ValueError, match=r"scene\.robot is .go1., the engine.s .toy_"):
        BatchEngine(batch_spec(config)).run(resolve_episodes([config, other]))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("go3", r"robot: got 'go3', wanted one of a1, go1, go2, the path of .*did you mean 'go"),
        ("toy_robot:NONE", r"robot: 'toy_robot:NONE' cannot be loaded: .*no attribute 'NONE'"),
        ("no_module:ROBOT", r"robot: 'no_module:ROBOT' cannot be loaded: No module named"),
        ("toy_robot:PARAMS", r"robot: 'toy_robot:PARAMS' is a RobotParams, wanted a Robot"),
    ],
)
def test_a_robot_that_is_none_is_refused(name, text):
    with pytest.raises(ValueError, match=text):
        get_robot(name)


def test_every_robot_of_kjax_loads():
    assert "go1" in robot_names()
    for name in robot_names():
        assert isinstance(get_robot(name), Robot)
        assert get_robot(name).name == name
