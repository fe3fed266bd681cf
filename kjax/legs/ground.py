"""The ground below a robot that cannot see it: a plane through the points its feet last pressed.

Points are in the local frame of ``ControllerState``: its origin is the trunk's, its axes are level.
The plane's height is given below that origin.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

STEEPEST = 0.7  # rise over run, 35 deg: no foot of ours holds on more
_TINY = 1e-4  # m^2; feet closer together than this tell nothing about a slope


class GroundSlope(NamedTuple):
    """What the last footholds tell of the ground.

    Attributes:
      holds: (4, 3) where each foot last pressed, contact points [m].
      slope: (2,) rise of the ground along x and y, filtered [-].
    """

    holds: Float[Array, "4 3"]
    slope: Float[Array, "2"]


def start_slope(radius: Float[Array, ""], feet: Float[Array, "4 3"]) -> GroundSlope:
    """Before the first plan: level.

    Args:
      radius: of the feet [m].
      feet: (4, 3) their centres [m].
    """
    level = jnp.zeros((2,), feet.dtype)
    return GroundSlope(holds=soles(radius, feet, level), slope=level)


def soles(
    radius: Float[Array, ""], feet: Float[Array, "4 3"], slope: Float[Array, "2"]
) -> Float[Array, "4 3"]:
    """Contact points (4, 3) of spherical feet with centres (4, 3) on a slope [m]."""
    return feet - radius * upright(slope)[None, :, 2]


def next_slope(
    known: GroundSlope,
    soles: Float[Array, "4 3"],
    pressed: Bool[Array, "4"],
    share: Float[Array, ""],
) -> GroundSlope:
    """The slope with new footholds taken in.

    Args:
      known: before.
      soles: (4, 3) contact points now [m].
      pressed: (4,) feet that press.
      share: of the new slope's in the filtered one [-].
    """
    holds = jnp.where(pressed[:, None], soles, known.holds)
    apart = holds - holds.mean(axis=0, keepdims=True)
    across = apart[:, :2]
    spread = across.T @ across + _TINY * jnp.eye(2, dtype=holds.dtype)
    moment = across.T @ apart[:, 2]
    # Inverse of a 2 x 2 matrix, as it stands.
    (a, b), (_, d) = spread
    seen = jnp.stack([d * moment[0] - b * moment[1], a * moment[1] - b * moment[0]])
    seen = jnp.clip(seen / (a * d - b * b), -STEEPEST, STEEPEST)
    return GroundSlope(holds, known.slope + share * (seen - known.slope))


def moved(known: GroundSlope, motion: Float[Array, "3"]) -> GroundSlope:
    """The same in a frame whose origin has moved on by ``motion`` (3,) [m]."""
    return known._replace(holds=known.holds - motion[None])


def rise(slope: Float[Array, "2"], points: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """How much higher the ground is at some places (x, y) than at the origin [m]."""
    return points[..., 0] * slope[0] + points[..., 1] * slope[1]


def upright(slope: Float[Array, "2"]) -> Float[Array, "3 3"]:
    """Axes of the ground, the third one its normal: the level ones turned by the least angle."""
    n = jnp.stack([-slope[0], -slope[1], jnp.ones_like(slope[0])])
    n = n / jnp.sqrt(jnp.sum(n**2))
    x, y, z = n
    over = 1.0 / (1.0 + z)
    rows = [
        [1.0 - x * x * over, -x * y * over, x],
        [-x * y * over, 1.0 - y * y * over, y],
        [-x, -y, z],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])
