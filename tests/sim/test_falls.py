"""What counts as a fall, wherever the ground is."""

import jax.numpy as jnp
import numpy as np
import pytest

from kjax.legs.base import build_base
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.sim.closed_loop import standing
from kjax.types import Observation

FREE = build_base("free")
LYING = np.tile([0.0, 1.4, -2.8], (4, 1))  # legs folded


def is_up(height, joints, roll=0.0):
    seen = Observation(
        base_pos=jnp.array([0.0, 0.0, height]),
        base_quat=jnp.array([np.cos(roll / 2), np.sin(roll / 2), 0.0, 0.0]),
        base_vel=jnp.zeros(3),
        base_ang_vel=jnp.zeros(3),
        joint_pos=jnp.asarray(joints),
        joint_vel=jnp.zeros((4, 3)),
        contact=jnp.ones(4, bool),
    )
    body = FREE.view(go1.PARAMS, jnp.array([1.0, 0.0]), seen).planar
    return bool(standing(go1.PARAMS, body.x, body.feet, seen))


@pytest.mark.parametrize("ground", [0.0, -0.5, 0.5])
def test_a_robot_stands_or_lies_on_the_ground_that_is_below_it(ground):
    height, joints = stand_pose(go1.PARAMS, 0.27)
    assert is_up(ground + height, joints)
    assert not is_up(ground + 0.09, LYING)
    assert not is_up(ground + height, joints, roll=1.2)
    assert not is_up(np.nan, joints)
    assert not is_up(ground + 0.4, np.zeros((4, 3)))  # MuJoCo's state after a reset
