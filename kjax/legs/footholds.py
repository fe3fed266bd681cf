"""Footholds of a trunk that turns: Raibert's law in three dimensions."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.types import GRAVITY, RobotParams


class Arrival(NamedTuple):
    """The body as each leg touches down, in one horizontal frame.

    Attributes:
      place: (4, 2) centre of mass [m].
      velocity: (4, 2) its velocity [m/s].
      error: (4, 2) velocity less the one wanted [m/s].
      heading: (4, 2) cosine and sine of the yaw [-].
      height: of the centre of mass above the ground [m].
    """

    place: Float[Array, "4 2"]
    velocity: Float[Array, "4 2"]
    error: Float[Array, "4 2"]
    heading: Float[Array, "4 2"]
    height: Float[Array, ""]


def footholds(
    robot: RobotParams,
    offset: Float[Array, "4"],
    body: Arrival,
    com: Float[Array, "3"],
    stance_time: Float[Array, "4"],
    gain: Float[Array, "2"],
    yaw_rate: Float[Array, ""],
) -> Float[Array, "4 2"]:
    """Next foothold (x, y) of each leg, in the frame of ``body`` [m].

    Below the thigh joint of a level trunk at touchdown, half a stance's way of that point further,
    and a correction of the velocity's error. On a curve the feet stand outside by height / g times
    the centripetal acceleration: two feet bear no moment about the line between them.

    Seven arguments: robot, gait, and what is expected.

    Args:
      robot: hip positions and abduction offsets.
      offset: (4,) foothold ahead of the hip, standing still [m].
      body: at each leg's touchdown.
      com: (3,) centre of mass in the trunk frame [m].
      stance_time: (4,) length of the stance to come [s].
      gain: (2,) foothold per velocity error ahead and to the left [s].
      yaw_rate: wanted [rad/s].
    """
    hip = robot.hip_pos[:, :2] - com[None, :2]
    hip = hip + jnp.stack([offset, robot.abduction_offset], axis=-1)
    lever = _rotate(body.heading, hip)
    turning = yaw_rate * jnp.stack([-lever[:, 1], lever[:, 0]], axis=-1)
    back = body.heading * jnp.array([[1.0, -1.0]], body.heading.dtype)
    correction = _rotate(body.heading, gain[None] * _rotate(back, body.error))
    way = 0.5 * stance_time[:, None] * (body.velocity + turning)
    inwards = yaw_rate * jnp.stack([-body.velocity[:, 1], body.velocity[:, 0]], axis=-1)
    outside = -body.height / GRAVITY * inwards
    return body.place + lever + way + outside + correction


def turned(angle: Float[Array, "*k"], vector: Float[Array, "2"]) -> Float[Array, "*k 2"]:
    """A horizontal vector turned to the left by each angle [rad]."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]], axis=-1)


def _rotate(heading: Float[Array, "4 2"], vector: Float[Array, "4 2"]) -> Float[Array, "4 2"]:
    c, s = heading[:, 0], heading[:, 1]
    x, y = vector[:, 0], vector[:, 1]
    return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)
