"""Leg kinematics and the centre of mass against C MuJoCo on the compiled Go1."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kjax.legs import kinematics
from kjax.robots import go1
from kjax.types import Leg, Observation, RobotParams

LINK = 0.213  # m, both links
ROUNDING = {"float32": 1e-6, "float64": 1e-14}  # ten roundings on lengths below 1 m


def robot(dtype):
    return RobotParams(*(jnp.asarray(a, dtype) for a in go1.PARAMS))


@jax.jit
def forward(params, joint_pos):
    trig = kinematics.leg_trig(joint_pos)
    return kinematics.foot_position(params, trig), kinematics.foot_jacobian(params, trig)


inverse = jax.jit(kinematics.inverse)
planar_state = jax.jit(kinematics.planar_state)


@pytest.fixture(params=range(5))
def posed(request, planar_go1, leg_joints):
    """A random posture and motion of the planar robot, everything that MuJoCo derives of it."""
    rng = np.random.default_rng(request.param)
    data = mujoco.MjData(planar_go1)
    root = [planar_go1.joint(f"root_{name}").id for name in ("x", "z", "pitch")]
    joints = leg_joints[:, 1:]
    data.qpos[planar_go1.jnt_qposadr[root]] = rng.uniform([-2, 0.2, -1.2], [2, 0.5, 1.2])
    data.qvel[planar_go1.jnt_dofadr[root]] = rng.normal(size=3) * [1.0, 1.0, 3.0]
    data.qpos[planar_go1.jnt_qposadr[joints]] = rng.uniform([-0.6, -2.8], [3.0, -0.9], (4, 2))
    data.qvel[planar_go1.jnt_dofadr[joints]] = rng.normal(size=(4, 2)) * 5
    mujoco.mj_forward(planar_go1, data)
    mujoco.mj_subtreeVel(planar_go1, data)
    return data


def observation(model, data, leg_joints, dtype):
    """What an ideal estimator reads: pose and motion of the trunk body, joints by name."""
    trunk = model.body("trunk").id
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, trunk, velocity, 0)
    R_world_trunk = data.xmat[trunk].reshape(3, 3)
    values = (
        data.xpos[trunk],
        data.xquat[trunk],
        velocity[3:],
        R_world_trunk.T @ velocity[:3],
        data.qpos[model.jnt_qposadr[leg_joints]],
        data.qvel[model.jnt_dofadr[leg_joints]],
    )
    return Observation(*(jnp.asarray(v, dtype) for v in values), contact=jnp.ones(4, bool))


def feet_in_hip_frames(model, data):
    """Foot centres (4, 3) relative to the thigh joints, in the trunk's axes."""
    R_world_trunk = data.xmat[model.body("trunk").id].reshape(3, 3)
    foot = np.stack([data.geom(f"{leg.name}_foot").xpos for leg in Leg])
    hip = np.stack([data.body(f"{leg.name}_thigh").xpos for leg in Leg])
    return (foot - hip) @ R_world_trunk


def test_the_foot_is_where_mujoco_has_it(posed, planar_go1, leg_joints, dtype):
    joint_pos = jnp.asarray(posed.qpos[planar_go1.jnt_qposadr[leg_joints]], dtype)
    foot, _ = forward(robot(dtype), joint_pos)
    assert foot.dtype == dtype
    wanted = feet_in_hip_frames(planar_go1, posed)[:, ::2]
    np.testing.assert_allclose(foot, wanted, rtol=0, atol=ROUNDING[dtype.name])


def test_the_jacobian_is_mujocos(posed, planar_go1, leg_joints, dtype):
    joint_pos = jnp.asarray(posed.qpos[planar_go1.jnt_qposadr[leg_joints]], dtype)
    _, jacobian = forward(robot(dtype), joint_pos)
    R_world_trunk = posed.xmat[planar_go1.body("trunk").id].reshape(3, 3)
    for leg in Leg:
        world = np.zeros((3, planar_go1.nv))
        foot = planar_go1.geom(f"{leg.name}_foot").id
        mujoco.mj_jacGeom(planar_go1, posed, world, None, foot)
        columns = planar_go1.jnt_dofadr[leg_joints[leg, 1:]]
        wanted = (R_world_trunk.T @ world[:, columns])[::2]
        np.testing.assert_allclose(jacobian[leg], wanted, rtol=0, atol=ROUNDING[dtype.name])


def test_the_jacobian_is_the_slope_of_the_position():
    joint_pos = np.random.default_rng(0).uniform(-1, 1, (4, 3))
    _, jacobian = forward(robot("float64"), jnp.asarray(joint_pos))
    h = 1e-6
    for column in range(2):
        step = np.zeros(3)
        step[1 + column] = h
        ahead, behind = (
            np.asarray(forward(robot("float64"), jnp.asarray(joint_pos + sign * step))[0])
            for sign in (1, -1)
        )
        # Central differences: truncation h^2 = 1e-12, rounding eps / h = 1e-10.
        np.testing.assert_allclose(
            jacobian[:, :, column], (ahead - behind) / (2 * h), rtol=0, atol=1e-9
        )


def test_the_rigid_body_state_is_mujocos_centre_of_mass(posed, planar_go1, leg_joints, dtype):
    state = planar_state(robot(dtype), observation(planar_go1, posed, leg_joints, dtype))
    trunk = planar_go1.body("trunk").id
    pitch = posed.joint("root_pitch")
    wanted = [
        *posed.subtree_com[trunk, ::2],
        -pitch.qpos[0],  # MuJoCo's hinge about +y turns nose-down
        *posed.subtree_linvel[trunk, ::2],
        -pitch.qvel[0],
    ]
    assert state.x.dtype == dtype
    # As above on values up to 6 m/s and rad/s; the joint rates reach 15 rad/s.
    tolerance = 10 * ROUNDING[dtype.name]
    np.testing.assert_allclose(state.x, wanted, rtol=0, atol=tolerance)
    feet = np.stack([posed.geom(f"{leg.name}_foot").xpos[::2] for leg in Leg])
    np.testing.assert_allclose(state.feet, feet, rtol=0, atol=tolerance)
    np.testing.assert_allclose(state.base, posed.xpos[trunk, ::2], rtol=0, atol=tolerance)
    R_world_trunk = posed.xmat[trunk].reshape(3, 3)[::2, ::2]
    np.testing.assert_allclose(state.rotation, R_world_trunk, rtol=0, atol=tolerance)


def test_neither_sign_nor_length_of_the_quaternion_matters(posed, planar_go1, leg_joints):
    seen = observation(planar_go1, posed, leg_joints, "float64")
    plain = planar_state(robot("float64"), seen)
    for factor in (-1.0, 1.01):
        other = planar_state(robot("float64"), seen._replace(base_quat=factor * seen.base_quat))
        np.testing.assert_allclose(other.x, plain.x, rtol=0, atol=1e-13)  # rounding


def test_the_nose_points_up_when_the_pitch_is_positive(planar_go1, leg_joints):
    data = mujoco.MjData(planar_go1)
    data.joint("root_pitch").qpos = -0.3
    mujoco.mj_forward(planar_go1, data)
    state = planar_state(robot("float64"), observation(planar_go1, data, leg_joints, "float64"))
    nose = data.body("trunk").xmat.reshape(3, 3)[:, 0]
    assert nose[2] > 0.29
    assert state.x[2] > 0.29


# What the knee range -2.80 .. -0.90 rad leaves of the reach, by the law of cosines.
NEAR, FAR = 2 * LINK * np.cos(1.40), 2 * LINK * np.cos(0.45)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    distance=st.lists(st.floats(NEAR + 1e-4, FAR - 1e-4), min_size=4, max_size=4),
    angle=st.lists(st.floats(-3.1, 3.1), min_size=4, max_size=4),
    name=st.sampled_from(["float32", "float64"]),
)
def test_forward_of_inverse_is_the_target(distance, angle, name):
    target = np.stack([distance * np.sin(angle), -np.array(distance) * np.cos(angle)], axis=-1)
    q1, q2, _ = inverse(robot(name), jnp.asarray(target, name))
    foot, _ = forward(robot(name), jnp.stack([jnp.zeros_like(q1), q1, q2], axis=-1))
    assert (q2 < 0).all()
    # Near the folded knee the distance fixes its angle only to eps / sin: ten times the rounding.
    np.testing.assert_allclose(foot, target, rtol=0, atol=10 * ROUNDING[name])


def test_inverse_finds_the_joint_angles_that_mujoco_used(posed, planar_go1, leg_joints):
    foot = feet_in_hip_frames(planar_go1, posed)[:, ::2]
    q1, q2, _ = inverse(robot("float64"), jnp.asarray(foot))
    wanted = posed.qpos[planar_go1.jnt_qposadr[leg_joints[:, 1:]]]
    # Angles are unique up to a full turn; rounding 1e-16 over the sine of the knee, at least 0.33.
    error = np.stack([q1, q2], axis=-1) - wanted
    np.testing.assert_allclose(np.angle(np.exp(1j * error)), 0.0, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("distance", "limit"), [(2.0, FAR), (0.4259, FAR), (0.01, NEAR)])
def test_a_target_out_of_reach_is_pulled_along_the_line_from_the_hip(distance, limit):
    angle = np.array([-2.0, -0.3, 0.0, 1.2])
    direction = np.stack([np.sin(angle), -np.cos(angle)], axis=-1)
    _, q2, trig = inverse(robot("float64"), jnp.asarray(distance * direction))
    foot = kinematics.foot_position(robot("float64"), trig)
    # Rounding of a square root near its own scale.
    np.testing.assert_allclose(foot, limit * direction, rtol=0, atol=1e-14)
    knee = -0.90 if limit == FAR else -2.80
    np.testing.assert_allclose(q2, knee, rtol=0, atol=1e-13)


def test_inverse_returns_the_trigonometry_of_its_own_angles(dtype):
    target = jnp.asarray([[0.1, -0.2], [-0.1, -0.3], [0.0, -0.1], [0.2, -0.25]], dtype)
    q1, q2, trig = inverse(robot(dtype), target)
    q12 = q1 + q2
    wanted = (jnp.sin(q1), jnp.cos(q1), jnp.sin(q12), jnp.cos(q12))
    for ours, expected in zip(trig, wanted, strict=True):
        # Two roundings of the angles, at most 3 rad.
        np.testing.assert_allclose(ours, expected, rtol=0, atol=10 * np.finfo(dtype).eps)


EDGES = {
    "in the middle of the reach": [0.0, -0.3],
    "stretched leg": [0.0, -0.426],
    "far out of reach": [1.0, -1.0],
    "folded leg": [0.0, -0.05],
    "the hip itself": [0.0, 0.0],
}


@pytest.mark.parametrize("target", EDGES.values(), ids=EDGES)
def test_the_inverse_is_finite_everywhere(target, dtype):
    angles = inverse(robot(dtype), jnp.broadcast_to(jnp.asarray(target, dtype), (4, 2)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(angles))


@pytest.mark.parametrize("target", EDGES.values(), ids=EDGES)
def test_the_inverse_has_a_finite_derivative_everywhere(target):
    def angles(p):
        return jnp.stack(kinematics.inverse(robot("float64"), jnp.broadcast_to(p, (4, 2)))[:2])

    assert np.isfinite(jax.jit(jax.jacrev(angles))(jnp.array(target))).all()
