"""Stance torques against MuJoCo's own J^T f and against virtual work."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from kjax.legs.kinematics import leg_trig
from kjax.legs.posture import stand_pose
from kjax.legs.stance import stance_torque
from kjax.robots import go1
from kjax.types import Leg, RobotParams


@jax.jit
def press(joint_pos, force):
    params = RobotParams(*(jnp.asarray(a, force.dtype) for a in go1.PARAMS))
    return stance_torque(params, leg_trig(joint_pos), force)


@pytest.mark.parametrize("pitch", [0.0, 0.4])
def test_torques_balance_the_ground_reaction_in_mujoco(planar_go1, leg_joints, dtype, pitch):
    """A force on the foot, turned into joint forces by the engine, and our torque cancel."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(planar_go1)
    data.joint("root_pitch").qpos = -pitch
    sagittal = leg_joints[:, 1:]
    data.qpos[planar_go1.jnt_qposadr[sagittal]] += rng.uniform([0.2, -2.2], [1.4, -1.0], (4, 2))
    mujoco.mj_forward(planar_go1, data)
    force = rng.uniform([-60.0, 0.0], [60.0, 160.0], (4, 2))
    torque = press(
        jnp.asarray(data.qpos[planar_go1.jnt_qposadr[leg_joints]], dtype),
        jnp.asarray(force, dtype),
    )
    assert torque.dtype == dtype
    R_world_trunk = data.body("trunk").xmat.reshape(3, 3)
    for leg in Leg:
        foot = planar_go1.geom(f"{leg.name}_foot")
        world = R_world_trunk @ np.array([force[leg, 0], 0.0, force[leg, 1]])
        generalised = np.zeros(planar_go1.nv)
        mujoco.mj_applyFT(
            planar_go1,
            data,
            world,
            np.zeros(3),
            data.geom(foot.id).xpos,
            foot.bodyid[0],
            generalised,
        )
        reaction = generalised[planar_go1.jnt_dofadr[sagittal[leg]]]
        assert np.abs(reaction).max() > 1.0
        # Ten roundings of forces of 160 N at 0.4 m.
        tolerance = 640 * np.finfo(dtype).eps
        np.testing.assert_allclose(torque[leg] + reaction, 0.0, rtol=0, atol=tolerance)


def test_a_leg_that_pushes_up_on_the_robot_stretches_its_knee():
    """The knee points back (calf angle negative): an upward ground force wants it to fold."""
    _, joint_pos = stand_pose(go1.PARAMS, 0.27)
    force = jnp.tile(jnp.array([0.0, 31.0]), (4, 1))
    torque = np.asarray(press(jnp.asarray(joint_pos), force))
    assert (torque[:, 1] > 0).all()
    # The foot is below the hip, so the force passes through the thigh joint; 1e-12 of rounding
    # and of the pose's own tolerance (1e-12 m) times 31 N.
    np.testing.assert_allclose(torque[:, 0], 0.0, rtol=0, atol=1e-10)


def test_no_force_needs_no_torque():
    zero = press(jnp.ones((4, 3)), jnp.zeros((4, 2)))
    np.testing.assert_array_equal(zero, 0.0)
