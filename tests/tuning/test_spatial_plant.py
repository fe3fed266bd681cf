"""The plant in three dimensions against C MuJoCo, and what the controller sees of it."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, SpatialBody
from kjax.legs import spatial
from kjax.legs.base import build_base
from kjax.legs.kinematics import leg_trig
from kjax.legs.posture import standing
from kjax.robots import go1
from kjax.tuning import spatial_plant as plant_of_body

ROBOT = go1.PARAMS
inverse = jax.jit(spatial.inverse)
position = jax.jit(lambda robot, q: spatial.foot_position(robot, spatial.hip_trig(q), leg_trig(q)))
INERTIA = np.array([[0.11, 0.004, -0.01], [0.004, 0.39, 0.002], [-0.01, 0.002, 0.42]])
STANCE = jnp.array([True, False, True, True])
FEET = jnp.array([[0.2, -0.13, 0.02], [0.2, 0.13, 0.1], [-0.2, -0.12, 0.02], [-0.18, 0.14, 0.02]])


@pytest.fixture(scope="module")
def plant():
    body = SpatialBody(jnp.asarray(12.7), jnp.asarray(INERTIA))
    return plant_of_body.nominal_spatial_plant(ROBOT, body)


@pytest.fixture(scope="module")
def compiled():
    return SimpleNamespace(
        advance=jax.jit(plant_of_body.advance),
        feasible=jax.jit(plant_of_body.feasible),
        measure=jax.jit(plant_of_body.measure),
    )


def thrown(plant):
    """A body that is tilted, moves and tumbles."""
    R = rotations.exp(jnp.array([0.2, -0.15, 0.9]))
    L = srb_spatial.momentum(plant.body, R, jnp.array([1.0, -2.0, 1.5]))
    return BodyState(jnp.array([0.02, 0.01, 0.27]), R, jnp.array([0.4, -0.2, 0.3]), L)


MODEL = """
<mujoco><option timestep="5e-5"/><worldbody><body><freejoint/>
<inertial pos="0 0 0" mass="12.7" fullinertia="{}"/></body></worldbody></mujoco>
"""


@pytest.mark.parametrize("pressed", [False, True])
def test_thrown_or_pressed_the_body_moves_as_in_mujoco(plant, compiled, pressed):
    order = [INERTIA[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    model = mujoco.MjModel.from_xml_string(MODEL.format(" ".join(map(str, order))))
    data, body = mujoco.MjData(model), thrown(plant)
    omega = np.asarray(srb_spatial.angular_velocity(plant.body, body.R, body.L))
    data.qpos[:3], data.qvel[:3], data.qvel[3:] = body.p, body.v, np.asarray(body.R).T @ omega
    mujoco.mju_mat2Quat(data.qpos[3:], np.asarray(body.R).ravel())
    force = float(pressed) * jnp.array([[10, -5, 60], [90, 90, 90], [-8, 12, 40], [5, 5, 30.0]])
    soles = np.asarray(FEET) - [0, 0, float(ROBOT.foot_radius)]
    for _ in range(200):  # 10 ms
        mujoco.mj_forward(model, data)
        data.qfrc_applied[:] = 0.0
        for leg in np.flatnonzero(STANCE):
            mujoco.mj_applyFT(
                model, data, np.asarray(force[leg]), np.zeros(3), soles[leg], 1, data.qfrc_applied
            )
        mujoco.mj_step(model, data)
    for _ in range(2):
        body = compiled.advance(ROBOT, plant, STANCE, body, FEET, force, 0.005)
    # MuJoCo's steps are of first order: 5e-5 s times accelerations of 10 to 100 per s^2.
    np.testing.assert_allclose(body.p, data.qpos[:3], atol=1e-5)
    np.testing.assert_allclose(body.v, data.qvel[:3], atol=1e-4)
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, data.qpos[3:])
    np.testing.assert_allclose(body.R, R.reshape(3, 3), atol=5e-5)
    omega = np.asarray(srb_spatial.angular_velocity(plant.body, body.R, body.L))
    np.testing.assert_allclose(omega, R.reshape(3, 3) @ data.qvel[3:], atol=2e-3)


def test_without_errors_the_controller_sees_what_it_would_of_a_robot(plant, compiled):
    rng = np.random.default_rng(0)
    body, quat = thrown(plant), np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.asarray(body.R).ravel())
    omega = srb_spatial.angular_velocity(plant.body, body.R, body.L)
    joints = np.tile([0.0, 0.9, -1.8], (4, 1)) + rng.uniform(-0.2, 0.2, (4, 3))
    still = standing(joints)._replace(base_quat=quat, base_ang_vel=body.R.T @ omega)
    view = jax.jit(build_base("free", spatial_forces=True).view)
    ahead = jnp.array([1.0, 0.0])
    com = body.R.T @ view(ROBOT, ahead, still).whole.com  # of these joints
    plant = plant._replace(com=com)
    base = plant_of_body.trunk_origin(plant, body)
    wanted = view(ROBOT, ahead, still._replace(base_vel=body.v - jnp.cross(omega, body.R @ com)))
    got = compiled.measure(ROBOT, plant, body, wanted.feet + base, jnp.zeros(9))
    parts = [(one.whole, one.base_vel, one.feet) for one in (got, wanted)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), *parts)


def test_an_error_of_the_attitude_turns_all_that_is_seen(plant, compiled):
    body, error = thrown(plant), jnp.zeros(9).at[:3].set(jnp.array([0.02, -0.01, 0.03]))
    true, seen = (compiled.measure(ROBOT, plant, body, FEET, e) for e in (0 * error, error))
    np.testing.assert_allclose(
        seen.whole.rotation, true.whole.rotation @ rotations.exp(error[:3]), atol=1e-12
    )
    for name in ("feet", "com"):
        points = [np.asarray(getattr(one.whole, name) @ one.whole.rotation) for one in (true, seen)]
        np.testing.assert_allclose(*points, atol=1e-12)  # the same in the trunk frame
    np.testing.assert_allclose(seen.planar.trig, true.planar.trig, atol=1e-12)


@pytest.mark.parametrize("force", [[200, 150, 60], [0, 0, 900], [5, -5, -50], [3, 4, 30]], ids=str)
def test_what_passes_is_within_cone_and_torques_and_the_rest_as_planned(plant, compiled, force):
    body, planned = thrown(plant), jnp.tile(jnp.array(force, float), (4, 1))
    seen = compiled.measure(ROBOT, plant, body, FEET, jnp.zeros(9))
    kept = np.asarray(compiled.feasible(ROBOT, plant, body, seen, planned))
    assert (kept[:, 2] >= 0.0).all()
    assert (np.hypot(kept[:, 0], kept[:, 1]) <= 0.8 * kept[:, 2] + 1e-9).all()
    torque = torques_of(seen, kept @ np.asarray(body.R))
    assert (np.abs(torque) <= np.asarray(ROBOT.torque_limit) * (1 + 1e-9)).all()
    possible = force == [3, 4, 30]
    assert np.allclose(kept, planned) == possible
    weak = plant._replace(gain=jnp.asarray(0.9))
    np.testing.assert_allclose(compiled.feasible(ROBOT, weak, body, seen, planned), 0.9 * kept)


def torques_of(seen, force):
    """Torques of forces (4, 3), trunk axes, from the way of a foot when a joint moves a little."""
    local = jnp.asarray(seen.feet @ seen.whole.rotation - ROBOT.hip_pos)
    joints, step, out = inverse(ROBOT, local)[0], 1e-6, np.zeros((4, 3))
    for joint, axis in enumerate(step * np.eye(3)):
        up, down = position(ROBOT, joints + axis), position(ROBOT, joints - axis)
        out[:, joint] = -(np.asarray(up - down) / (2 * step) * force).sum(axis=1)
    return out
