"""Stance legs: joint torques that put a planned force on the ground."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.legs import spatial
from kjax.legs.kinematics import LegTrig, foot_jacobian
from kjax.types import RobotParams


def stance_torque(
    robot: RobotParams, trig: LegTrig, force: Float[Array, "4 2"]
) -> Float[Array, "4 2"]:
    """Thigh and calf torque (4, 2) [N m] for ground reaction forces: tau = -J^T f (Eq. 18).

    The paper writes tau = J^T f with f the force of the foot on the ground; ours is the reaction,
    the force on the robot, hence the sign.

    Args:
      robot: link lengths.
      trig: leg trigonometry.
      force: (4, 2) force (x, z) on each foot, body frame [N].
    """
    return -jnp.einsum("lij,li->lj", foot_jacobian(robot, trig), force)


def spatial_stance_torque(
    robot: RobotParams, hip: spatial.HipTrig, trig: LegTrig, force: Float[Array, "4 3"]
) -> Float[Array, "4 3"]:
    """Torque of all joints (4, 3) [N m] for ground reaction forces of any direction.

    Args:
      robot: link lengths and abduction offsets.
      hip: trigonometry of the abduction joints.
      trig: of the other joints.
      force: (4, 3) force on each foot, trunk axes [N].
    """
    return -jnp.einsum("lij,li->lj", spatial.foot_jacobian(robot, hip, trig), force)
