"""Rows on the forces of one step (Eq. 16): friction pyramid, joint torque limits through J^T."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from kjax.legs.kinematics import LegTrig, foot_jacobian
from kjax.types import RobotParams


class ForceRows(NamedTuple):
    """low <= A u <= high for the four forces u of a step, body frame.

    Attributes:
      A: (r, 4) of friction [-], then of torque [m].
      low: (r,) lower limits [N, N m].
      high: (r,) upper limits [N, N m].
    """

    A: Float[Array, "r 4"]
    low: Float[Array, "r"]
    high: Float[Array, "r"]


def force_limits(
    robot: RobotParams,
    trig: LegTrig,
    rotation: Float[Array, "2 2"],
    stance: Bool[Array, "4"],
    *,
    friction: Float[Array, ""] | float | None,
    torque_fraction: Float[Array, ""] | float | None,
) -> ForceRows:
    """Rows for the present posture, which a horizon within a stance takes as constant.

    Args:
      robot: joint torque limits.
      trig: posture of the legs.
      rotation: (2, 2) R_world_body on (x, z): the ground's friction does not pitch with the trunk.
      stance: (4,) legs that stand; an end's rows are those of the mean of its standing legs.
      friction: mu of |F_x| <= mu F_z, world frame; ``None`` leaves these rows out [-].
      torque_fraction: part of the limits in |J^T F| <= tau; ``None`` leaves these rows out [-].
    """
    weight = stance.reshape(2, 2).astype(robot.thigh_length.dtype)
    weight = weight / jnp.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    jacobian = foot_jacobian(robot, trig).reshape(2, 2, 2, 2)  # end, leg, (x, z), joint
    torque = jnp.einsum("el,elfj->ejf", weight, jacobian)
    rows, low, high = [], [], []
    for end in range(2):
        place = np.eye(4)[2 * end : 2 * end + 2]  # (x, z) of this end among the four forces
        if friction is not None:
            slide = jnp.array([[1.0, 0.0], [-1.0, 0.0]]) - friction * jnp.array([[0.0, 1.0]])
            rows.append(slide @ rotation @ place)
            low.append(jnp.full((2,), -jnp.inf))
            high.append(jnp.zeros((2,)))
        if torque_fraction is not None:
            limit = torque_fraction * jnp.asarray(robot.torque_limit)[1:]
            rows.append(torque[end] @ place)
            low.append(-limit)
            high.append(limit)
    dtype = weight.dtype
    A, below, above = (jnp.concatenate(parts).astype(dtype) for parts in (rows, low, high))
    return ForceRows(A=A, low=below, high=above)
