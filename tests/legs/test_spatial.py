"""Free-base kinematics against C MuJoCo on random poses, inverse kinematics, the heading frame."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from kjax.legs import spatial
from kjax.legs.kinematics import leg_trig, planar_state
from kjax.robots import go1
from kjax.types import Leg, Observation, RobotParams

ROUNDING = {"float32": 2e-6, "float64": 2e-14}  # twenty roundings on lengths below 1 m


def robot(dtype):
    return RobotParams(*(jnp.asarray(a, dtype) for a in go1.PARAMS))


@jax.jit
def forward(params, joint_pos):
    hip, trig = spatial.hip_trig(joint_pos), leg_trig(joint_pos)
    jacobian = spatial.foot_jacobian(params, hip, trig)
    return spatial.foot_position(params, hip, trig), jacobian


inverse = jax.jit(spatial.inverse)
spatial_state = jax.jit(spatial.spatial_state)


slope_of = jax.jit(jax.grad(lambda params, feet: spatial.inverse(params, feet)[0].sum(), 1))


@jax.jit
def rates_of(params, joint_pos, velocity):
    return spatial.joint_rates(params, spatial.hip_trig(joint_pos), leg_trig(joint_pos), velocity)


@pytest.fixture(params=range(4))
def posed(request, free_go1, leg_joints):
    """A random posture and motion of the free robot, and everything that MuJoCo derives of it."""
    rng = np.random.default_rng(request.param)
    data = mujoco.MjData(free_go1)
    data.qpos[:3] = rng.uniform([-2, -2, 0.2], [2, 2, 0.5])
    # Any yaw, roll and pitch up to about a radian.
    data.qpos[3:7] = quaternion(*rng.uniform([-1.0, -1.2, -3.1], [1.0, 1.2, 3.1]))
    data.qvel[:6] = rng.normal(size=6) * [1, 1, 1, 3, 3, 3]
    low, high = [-0.8, -0.6, -2.8], [0.8, 3.0, -0.9]
    data.qpos[7:] = rng.uniform(low, high, (4, 3)).reshape(-1)
    data.qvel[6:] = rng.normal(size=12) * 5
    mujoco.mj_forward(free_go1, data)
    mujoco.mj_subtreeVel(free_go1, data)
    return data


def quaternion(roll, pitch, yaw):
    """Of turns by roll, then pitch (nose up positive), then yaw, by MuJoCo's Euler angles."""
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, np.array([yaw, -pitch, roll]), "zyx")
    return quat


def observation(data, dtype="float64"):
    values = (data.qpos[:3], data.qpos[3:7], data.qvel[:3], data.qvel[3:6])
    values += (data.qpos[7:].reshape(4, 3), data.qvel[6:].reshape(4, 3))
    return Observation(*(jnp.asarray(v, dtype) for v in values), contact=jnp.ones(4, bool))


@pytest.fixture(scope="session")
def free_legs(free_go1):
    """The joints of the free robot lie in leg order behind its free joint."""
    names = ("abduction", "thigh", "calf")
    at = [[free_go1.joint(f"{leg.name}_{n}").qposadr[0] for n in names] for leg in Leg]
    np.testing.assert_array_equal(at, 7 + np.arange(12).reshape(4, 3))


def feet_from_hips(model, data):
    """Foot centres (4, 3) relative to the abduction axes, in the trunk's axes."""
    R_world_trunk = data.body("trunk").xmat.reshape(3, 3)
    foot = np.stack([data.geom(f"{leg.name}_foot").xpos for leg in Leg])
    hip = np.stack([data.body(f"{leg.name}_hip").xpos for leg in Leg])
    return (foot - hip) @ R_world_trunk


def test_foot_and_jacobian_are_mujocos(posed, free_go1, free_legs, dtype):
    joint_pos = posed.qpos[7:].reshape(4, 3)
    foot, jacobian = forward(robot(dtype), jnp.asarray(joint_pos, dtype))
    assert foot.dtype == jacobian.dtype == dtype
    wanted = feet_from_hips(free_go1, posed)
    np.testing.assert_allclose(foot, wanted, rtol=0, atol=ROUNDING[dtype.name])
    R_world_trunk = posed.body("trunk").xmat.reshape(3, 3)
    for leg in Leg:
        world = np.zeros((3, free_go1.nv))
        mujoco.mj_jacGeom(free_go1, posed, world, None, free_go1.geom(f"{leg.name}_foot").id)
        wanted = R_world_trunk.T @ world[:, 6 + 3 * leg : 9 + 3 * leg]
        np.testing.assert_allclose(jacobian[leg], wanted, rtol=0, atol=ROUNDING[dtype.name])


def test_the_state_is_mujocos_centre_of_mass_turned_to_the_heading(posed, free_legs, dtype):
    """Every field by MuJoCo's own frames and momenta, seen from an arbitrary track."""
    track = 0.7
    state = spatial_state(
        robot(dtype),
        jnp.asarray([np.cos(track), np.sin(track)], dtype),
        observation(posed, dtype),
    )
    trunk = posed.body("trunk")
    R_world_trunk = trunk.xmat.reshape(3, 3)
    nose, left = R_world_trunk[:, 0], R_world_trunk[:, 1]
    world_yaw = np.arctan2(nose[1], nose[0])

    def about_z(angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    R_world_track, R_world_heading = about_z(track), about_z(world_yaw)
    com, com_vel = posed.subtree_com[trunk.id], posed.subtree_linvel[trunk.id]
    velocity = com_vel @ R_world_heading
    omega = R_world_trunk @ posed.qvel[3:6] @ R_world_heading
    pitch = np.arcsin(nose[2])
    # Rounding of values up to 15 m/s and rad/s.
    tolerance = 20 * ROUNDING[dtype.name]

    def close(ours, theirs):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance)

    planar = state.planar
    progress = (com @ R_world_track)[0]
    assert planar.x.dtype == dtype
    close(planar.x, [progress, com[2], pitch, velocity[0], velocity[2], -omega[1]])
    close(state.com, com @ R_world_track)
    close(state.com_vel, velocity)
    close(state.omega, omega)
    close(state.roll, np.arcsin(left[2] / np.cos(pitch)))
    close(np.exp(1j * state.yaw), np.exp(1j * (world_yaw - track)))
    feet = np.stack([posed.geom(f"{leg.name}_foot").xpos for leg in Leg])
    close(state.feet, feet @ R_world_track)
    # In the plane: places about the centre of mass, turned to the heading.
    close(planar.feet - planar.x[:2], ((feet - com) @ R_world_heading)[:, ::2])
    close(planar.base - planar.x[:2], ((trunk.xpos - com) @ R_world_heading)[::2])
    close(planar.base_vel, (posed.qvel[:3] @ R_world_heading)[::2])


def test_a_planar_robot_looks_the_same_in_both_views(posed, free_legs):
    seen = observation(posed)
    flat = seen._replace(
        base_pos=seen.base_pos.at[1].set(0.0),
        base_quat=jnp.asarray(quaternion(0.0, 0.4, 0.0)),
        base_vel=seen.base_vel.at[1].set(0.0),
        base_ang_vel=seen.base_ang_vel * jnp.array([0.0, 1.0, 0.0]),
        joint_pos=seen.joint_pos.at[:, 0].set(0.0),
        joint_vel=seen.joint_vel.at[:, 0].set(0.0),
    )
    ours = spatial_state(robot("float64"), jnp.array([1.0, 0.0]), flat).planar
    theirs = jax.jit(planar_state)(robot("float64"), flat)
    assert float(ours.x[2]) == pytest.approx(0.4, abs=1e-12)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)  # rounding of a few m/s


def test_inverse_finds_the_joint_angles_that_mujoco_used(posed, free_go1, free_legs, dtype):
    """Where the foot is below its hip: the other leg plane is not looked for."""
    foot = feet_from_hips(free_go1, posed)
    found, _, _ = inverse(robot(dtype), jnp.asarray(foot, dtype))
    assert found.dtype == dtype
    again, _ = forward(robot(dtype), found)
    joint_pos = posed.qpos[7:].reshape(4, 3)
    q1, q12 = joint_pos[:, 1], joint_pos[:, 1] + joint_pos[:, 2]
    depth = 0.213 * (np.cos(q1) + np.cos(q12))
    below = depth > 0.426 * spatial.MIN_DEPTH + 1e-3
    assert below.any()
    # Near a folded knee the distance fixes the angle only to eps / sin: ten times the rounding.
    tolerance = 10 * ROUNDING[dtype.name]
    np.testing.assert_allclose(np.asarray(again)[below], foot[below], rtol=0, atol=tolerance)
    error = (np.asarray(found) - joint_pos)[below]
    np.testing.assert_allclose(np.angle(np.exp(1j * error)), 0.0, rtol=0, atol=30 * tolerance)


@pytest.mark.parametrize(
    "target",
    [
        [0.0, 0.0, 0.0],  # the axis itself
        [0.0, 0.0, -0.02],  # inside the circle of the abduction link
        [3.0, 2.0, -1.0],  # far away
        [0.0, 0.6, 0.1],  # level, to the side
        [0.0, -0.05, 0.4],  # above
    ],
)
def test_unreachable_targets_give_finite_angles_within_the_joints_limits(target, dtype):
    feet = jnp.tile(jnp.asarray(target, dtype), (4, 1))
    angle, hip, trig = inverse(robot(dtype), feet)
    assert np.isfinite(angle).all()
    assert (np.abs(angle[:, 0]) < 0.863).all()
    assert ((angle[:, 2] > -2.818) & (angle[:, 2] < -0.888)).all()
    # What it returns is the trigonometry of these angles.
    np.testing.assert_allclose(hip.s0, np.sin(angle[:, 0]), atol=ROUNDING[dtype.name])
    np.testing.assert_allclose(trig.s1, np.sin(angle[:, 1]), atol=10 * ROUNDING[dtype.name])
    rates = rates_of(robot(dtype), angle, jnp.ones((4, 3), dtype))
    assert np.isfinite(rates).all()
    assert np.isfinite(slope_of(robot(dtype), feet)).all()


def test_joint_rates_move_the_foot_as_asked(free_legs):
    rng = np.random.default_rng(0)
    joint_pos = jnp.asarray(rng.uniform([-0.5, 0.4, -2.0], [0.5, 1.2, -1.2], (4, 3)))
    velocity = rng.normal(size=(4, 3))
    rate = rates_of(robot("float64"), joint_pos, jnp.asarray(velocity))
    h = 1e-6
    ahead, behind = (forward(robot("float64"), joint_pos + s * h * rate)[0] for s in (1, -1))
    # Central differences: truncation (h rate)^2 = 1e-9 for rates up to 30 rad/s.
    np.testing.assert_allclose((ahead - behind) / (2 * h), velocity, rtol=0, atol=1e-7)
