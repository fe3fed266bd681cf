"""Rotations in three dimensions: vectors, matrices, and the map between them."""

import jax.numpy as jnp
from jaxtyping import Array, Float

_SMALL = 1e-4  # rad^2 below which series stand in for the quotients; exact to float64's rounding


def skew(w: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Matrix of the cross product with w: times a vector a it is w x a."""
    x, y, z = jnp.moveaxis(w, -1, 0)
    zero = jnp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def exp(w: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Rotation by |w| [rad] about w (Rodrigues); smooth at zero."""
    square = jnp.sum(w**2, axis=-1)
    small = square < _SMALL
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    a = jnp.where(
        small, 1 - square / 6 + square**2 / 120 - square**3 / 5040, jnp.sin(angle) / angle
    )
    b = jnp.where(
        small,
        0.5 - square / 24 + square**2 / 720 - square**3 / 40320,
        (1 - jnp.cos(angle)) / safe,
    )
    K = skew(w)
    one = jnp.broadcast_to(jnp.eye(3, dtype=w.dtype), K.shape)
    return one + a[..., None, None] * K + b[..., None, None] * (K @ K)


def inverse(M: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3 3"]:
    """Inverse of a well-conditioned 3 x 3 matrix, by its cofactors: no call of LAPACK."""
    a, b, c = (M[..., i, :] for i in range(3))
    columns = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    return columns / jnp.sum(a * columns[..., 0], axis=-1)[..., None, None]


def log(R: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """The shortest w with exp(w) = R, below half a turn [rad]; smooth at the identity."""
    # |v| = 2 sin(angle); the arctangent is well conditioned at both ends.
    v = jnp.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]],
        axis=-1,
    )
    trace = jnp.trace(R, axis1=-2, axis2=-1)
    square = 0.25 * jnp.sum(v**2, axis=-1)  # sin^2
    small = (square < _SMALL) & (trace > 0)
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    angle = jnp.arctan2(sine, 0.5 * (trace - 1))
    # angle / sin(angle) by its series in sin^2.
    series = 1 + square / 6 + 3 * square**2 / 40 + 5 * square**3 / 112
    tiny = jnp.finfo(R.dtype).tiny
    return 0.5 * jnp.where(small, series, angle / jnp.maximum(sine, tiny))[..., None] * v


def trunk_angles(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Roll (right side down), pitch (nose up) and yaw (to the left) of a trunk [rad]."""
    level = jnp.sqrt(R[0, 0] ** 2 + R[1, 0] ** 2)
    return jnp.stack(
        [
            jnp.arctan2(R[2, 1], R[2, 2]),
            jnp.arctan2(R[2, 0], level),
            jnp.arctan2(R[1, 0], R[0, 0]),
        ]
    )
