"""Roll, yaw and sideways motion of the free trunk: what the sagittal LMPC does not see.

The LMPC plans the stance forces in the vertical plane of the heading frame. A regulator asks for a
roll moment, a yaw moment and a sideways force, and the stance forces are changed as little as it
takes to give the trunk that wrench and what the plan gave it otherwise:

    minimise  |W^(1/2) (G f - w)|^2 + ridge |f - f_plan|^2    over the forces f of the stance legs

with G the wrench of the forces about the centre of mass and w the wrench wanted. Paper: planar, so
none of this; the regulator is ours.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax.legs.spatial import SpatialState, rotate, rotate_back
from kjax.types import RobotParams


class LateralParams(NamedTuple):
    """Settings of the regulator; data, so they may differ between the robots of a batch.

    Attributes:
      roll: stiffness and damping of the roll [N m/rad, N m s/rad].
      yaw: stiffness and damping of the yaw about the heading at ``init`` [N m/rad, N m s/rad].
      damping: of the sideways velocity [N s/m].
      weights: (6,) of the wrench (force x, y, z, moment x, y, z) [1/N^2, 1/(N m)^2].
      ridge: weight of a change of the plan's forces [1/N^2].
      friction: horizontal over vertical force of a foot, at most; (G,) by gait in the controller's
        parameters, one number where it is used [-].
      torque_fraction: part of the joint torque limits that stance forces may take, likewise [-].
      foothold_gain: sideways foothold per sideways velocity, beyond Raibert's law [s].
    """

    roll: Float[Array, "2"]
    yaw: Float[Array, "2"]
    damping: Float[Array, ""]
    weights: Float[Array, "6"]
    ridge: Float[Array, ""]
    friction: Float[Array, "*gait"]
    torque_fraction: Float[Array, "*gait"]
    foothold_gain: Float[Array, ""]


def for_gait(params: LateralParams, gait: Int[Array, ""]) -> LateralParams:
    """Settings with those that depend on the gait picked for ``gait``."""
    return params._replace(
        friction=params.friction[gait], torque_fraction=params.torque_fraction[gait]
    )


def wrench_map(arms: Float[Array, "4 3"], stance: Bool[Array, "4"]) -> Float[Array, "6 12"]:
    """G: forces (4, 3) on the stance feet to (force, moment) about the centre of mass.

    Args:
      arms: (4, 3) contact points from the centre of mass [m].
      stance: (4,) legs that count; the others' columns are zero.
    """
    x, y, z = arms.T
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = [
        [one, zero, zero],
        [zero, one, zero],
        [zero, zero, one],
        [zero, -z, y],
        [z, zero, -x],
        [-y, x, zero],
    ]
    blocks = jnp.stack([jnp.stack(row, axis=-1) for row in rows])  # (wrench, leg, xyz)
    return (blocks * stance[:, None]).reshape(6, 12)


def distribute(
    params: LateralParams,
    arms: Float[Array, "4 3"],
    stance: Bool[Array, "4"],
    planned: Float[Array, "4 3"],
    wrench: Float[Array, "6"],
) -> Float[Array, "4 3"]:
    """Stance forces (4, 3) [N] near the plan's that give the wrench, as far as feet can push.

    After the least squares, F_z is cut at zero and the horizontal force at the friction cone.

    Args:
      params: weights, ridge and friction.
      arms: (4, 3) contact points from the centre of mass [m].
      stance: (4,) legs on the ground; the others get no force.
      planned: (4, 3) forces of the plan [N].
      wrench: (6,) force and moment about the centre of mass wanted [N, N m].
    """
    planned = planned * stance[:, None]
    G = wrench_map(arms, stance)
    weighted = G.T * params.weights
    H = weighted @ G + params.ridge * jnp.eye(12, dtype=G.dtype)
    missing = wrench - G @ planned.reshape(-1)
    # The ridge makes H positive definite, also with no foot on the ground.
    change = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(H), weighted @ missing)
    force = planned + change.reshape(4, 3) * stance[:, None]
    z = jnp.maximum(force[:, 2], 0.0)
    # Of a pair that slides, one foot lets go first, and the trunk rolls.
    square = force[:, 0] ** 2 + force[:, 1] ** 2
    limit = params.friction * z
    slides = square > limit**2
    # No root of 0, whose derivative is infinite.
    inside = jnp.where(slides, limit / jnp.sqrt(jnp.where(slides, square, 1.0)), 1.0)
    return jnp.stack([force[:, 0] * inside, force[:, 1] * inside, z], axis=-1)


def stance_forces(
    params: LateralParams,
    robot: RobotParams,
    body: SpatialState,
    stance: Bool[Array, "4"],
    planned: Float[Array, "4 3"],
) -> Float[Array, "4 3"]:
    """Forces (4, 3) on the robot, trunk axes [N]: the plan's, regulated in roll, yaw and y.

    Args:
      params: of the regulator.
      robot: foot radius.
      body: the free robot.
      stance: (4,) legs on the ground.
      planned: (4, 3) the LMPC's forces on the robot, track frame [N].
    """
    forces = rotate_back(body.heading, planned)
    below = jnp.stack([jnp.zeros_like(body.com[0])] * 2 + [robot.foot_radius])
    arms = rotate_back(body.heading, body.feet - below[None] - body.com[None])
    wrench = wrench_map(arms, stance) @ forces.reshape(-1)
    wrench = wrench.at[jnp.array([1, 3, 5])].set(
        jnp.stack(
            [
                -params.damping * body.com_vel[1],
                -params.roll @ jnp.stack([body.roll, body.omega[0]]),
                -params.yaw @ jnp.stack([body.yaw, body.omega[2]]),
            ]
        )
    )
    return rotate(body.heading, distribute(params, arms, stance, forces, wrench)) @ body.rotation
