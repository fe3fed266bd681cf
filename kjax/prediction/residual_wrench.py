"""A wrench that the rigid body in three dimensions misses, learned from the whole robot.

    (f, tau) = W[feet that stand] phi(attitude, velocity, angular velocity, height, forces, phase)

f acts at the centre of mass, tau is about it, both in the axes of the heading. It stands for legs
that move within the body, contacts that give way, forces that the joints do not deliver. Swing
legs pull back and forth within a stance, as far as the robot moves: so the gait's phase and its
products with the velocity. ``sysid.spatial_residual`` fits it.
"""

from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.dynamics.srb_spatial import BodyState
from kjax.prediction import storage

PATTERNS = 16  # sets of standing legs: bit i is leg i
FEATURES = (
    "1", "v_x", "v_y", "v_z", "omega_x", "omega_y", "omega_z", "up_x", "up_y", "height",
    *(f"F_{leg}_{axis}" for leg in ("FR", "FL", "RR", "RL") for axis in "xyz"),
    "cos", "sin", "cos2", "sin2",
    *(f"{wave} {rate}" for wave in ("cos", "sin") for rate in ("v_x", "v_y", "omega_z")),
)  # fmt: skip
SIZE = len(FEATURES)
SHAPE = (PATTERNS, 6, SIZE)
FAMILY = "residual_wrench"


class ResidualWrench(NamedTuple):
    """The model.

    Attributes:
      W: (16, 6, 32) weights of each set of standing legs; zero where too little was known.
    """

    W: Float[Array, "16 6 32"]


def heading_axes(R: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Axes ahead, left and up of a trunk's attitude in the columns."""
    ahead = R[:2, 0] / jnp.linalg.norm(R[:2, 0])
    c, s = ahead
    zero = jnp.zeros_like(c)
    return jnp.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]])


def features(
    state: BodyState,
    omega: Float[Array, "3"],
    force: Float[Array, "4 3"],
    phase: Float[Array, ""],
) -> Float[Array, "32"]:
    """phi; the state's height is that above the ground.

    Args:
      state: of the body, world.
      omega: its angular velocity, world [rad/s].
      force: of each leg, world [N].
      phase: part of the gait's present phase that is over [-].
    """
    axes = heading_axes(state.R)
    up, v, w = axes.T @ state.R[:, 2], axes.T @ state.v, axes.T @ omega
    one = jnp.ones((1,), state.p.dtype)
    angle = 2 * jnp.pi * phase
    once = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    twice = jnp.stack([jnp.cos(2 * angle), jnp.sin(2 * angle)])
    moving = (once[:, None] * jnp.stack([v[0], v[1], w[2]])[None]).reshape(-1)
    state_parts = (one, v, w, up[:2], state.p[2:])
    return jnp.concatenate([*state_parts, (force @ axes).reshape(-1), once, twice, moving])


def wrench(
    model: ResidualWrench,
    state: BodyState,
    omega: Float[Array, "3"],
    force: Float[Array, "4 3"],
    phase: Float[Array, ""],
) -> Float[Array, "2 3"]:
    """Force and moment, world [N, N m]; legs without a force are in the air.

    Arguments as of ``features``.
    """
    own = model.W[pattern(force[:, 2] != 0.0)]
    return (own @ features(state, omega, force, phase)).reshape(2, 3) @ heading_axes(state.R).T


def pattern(stance: Array) -> Array:
    """Number of a set of standing legs (..., 4): its row of the weights."""
    return stance.astype(jnp.int32) @ jnp.array([1, 2, 4, 8], jnp.int32)


def save(path: str | Path, model: ResidualWrench) -> Path:
    """Write a model whole or not at all; returns the file."""
    W = np.asarray(model.W)
    return storage.write(path, {"family": np.array(FAMILY), "W": W})


def load(path: str | Path) -> ResidualWrench:
    """Read what ``save`` wrote.

    Raises:
      ValueError: in one line that names the file and what is wrong with it.
    """
    file, arrays = storage.read(path, FAMILY)
    try:
        storage.check_array("W", arrays["W"], SHAPE, rows="sets of standing legs")
    except KeyError as error:
        raise storage.fault(file, f"lacks {error}") from None
    except ValueError as error:
        raise storage.fault(file, str(error)) from None
    return ResidualWrench(arrays["W"])
