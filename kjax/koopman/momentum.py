"""Observables (1, p, v, H) of a rigid body in three dimensions: exactly linear under EDMD.

H = L + m (p - o) x v is the angular momentum about a point o that is fixed in the world. With
forces in the world frame on feet that stay where they stand,

    p' = v,    v' = g + sum F_i / m,    H' = sum (r_i - o) x F_i + m (p - o) x g,

so these ten observables are a finite Koopman-invariant subspace: no product of state and input is
left, whatever the attitude does, in every contact mode. Only the attitude itself stays outside. o
is near the robot: about the world's origin, a kilometre away, H is thousands of N m s.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from kjax.dynamics.rotations import skew
from kjax.dynamics.srb_spatial import BodyState, SpatialBody, gravity
from kjax.koopman import regression
from kjax.koopman.checks import require_rows
from kjax.precision import full_precision

NAMES = ("1", "p_x", "p_y", "p_z", "v_x", "v_y", "v_z", "H_x", "H_y", "H_z")
UNITS = ("-", "m", "m", "m", "m/s", "m/s", "m/s", "N m s", "N m s", "N m s")
SIZE = len(NAMES)
P, V, H = slice(1, 4), slice(4, 7), slice(7, 10)


class MomentumModel(NamedTuple):
    """z+ = A z + B u, z = (1, p, v, H), u the forces of n feet one after the other.

    Attributes:
      A: (10, 10).
      B: (10, 3n) [1/N].
    """

    A: Float[Array, "10 10"]
    B: Float[Array, "10 u"]


class MomentumFit(NamedTuple):
    """How well posed a fit was.

    Attributes:
      rank: of the scaled regressors.
      columns: number of them.
      residual_rms: (10,) of one step.
    """

    rank: Int[Array, ""]
    columns: int
    residual_rms: Float[Array, "10"]


def lift(body: SpatialBody, state: BodyState, about: Float[Array, "3"]) -> Float[Array, "10"]:
    """(1, p, v, H); p from the world's origin, H about ``about`` [m]."""
    orbital = body.mass * jnp.cross(state.p - about, state.v)
    one = jnp.ones((1,), state.p.dtype)
    return jnp.concatenate([one, state.p, state.v, state.L + orbital])


def angular_momentum(
    body: SpatialBody, z: Float[Array, "10"], about: Float[Array, "3"]
) -> Float[Array, "3"]:
    """L about the centre of mass, from a lifted state [N m s]."""
    return z[H] - body.mass * jnp.cross(z[P] - about, z[V])


def exact_model(
    body: SpatialBody,
    feet: Float[Array, "n 3"],
    about: Float[Array, "3"],
    dt: Float[Array, ""] | float,
) -> MomentumModel:
    """The model that EDMD finds, from its equations: a step ``dt`` [s] under held forces.

    Args:
      body: mass; its inertia is of no effect.
      feet: (n, 3) contact points, world [m].
      about: (3,) point that H is about, world [m].
      dt: step [s].
    """
    dtype = feet.dtype
    g, m, n = gravity(dtype), body.mass, feet.shape[0]
    eye, t = jnp.eye(3, dtype=dtype), dt
    # m (p - o) x g is -m [g]_x (p - o); p itself is integrated over the step.
    fall = -m * skew(g)
    A = jnp.eye(SIZE, dtype=dtype)
    A = A.at[P, V].set(t * eye).at[P, 0].set(t**2 / 2 * g).at[V, 0].set(t * g)
    A = A.at[H, P].set(t * fall).at[H, V].set(t**2 / 2 * fall).at[H, 0].set(-t * fall @ about)
    by_foot = jnp.concatenate(
        [
            jnp.zeros((n, 1, 3), dtype),
            jnp.broadcast_to(t**2 / (2 * m) * eye, (n, 3, 3)),
            jnp.broadcast_to(t / m * eye, (n, 3, 3)),
            t * skew(feet - about[None]) + t**3 / (6 * m) * fall[None],
        ],
        axis=1,
    )
    return MomentumModel(A=A, B=jnp.moveaxis(by_foot, 0, 1).reshape(SIZE, 3 * n))


@full_precision
def fit(
    now: Float[Array | np.ndarray, "M 10"],
    inputs: Float[Array | np.ndarray, "M u"],
    then: Float[Array | np.ndarray, "M 10"],
) -> tuple[MomentumModel, MomentumFit]:
    """EDMD (Eq. 5) on the increments of lifted states.

    Args:
      now: lifted states.
      inputs: forces of the standing feet in each step, held [N].
      then: lifted states one step later.

    Raises:
      ValueError: for fewer snapshots than regressors.
    """
    now, inputs, then = map(jnp.asarray, (now, inputs, then))
    Z = jnp.concatenate([now, inputs], axis=1)
    require_rows(*Z.shape)
    rows = regression.of_rows(Z, then - now)
    weights = regression.solve(rows, Z.shape[1])
    K = weights.W.T
    model = MomentumModel(A=jnp.eye(SIZE, dtype=K.dtype) + K[:, :SIZE], B=K[:, SIZE:])
    found = MomentumFit(weights.rank, Z.shape[1], regression.rms(rows, weights.W))
    return model, found


@full_precision
def rollout(
    model: MomentumModel, z: Float[Array, "10"], inputs: Float[Array, "steps u"]
) -> Float[Array, "steps_plus_1 10"]:
    """Lifted states (steps + 1, 10) under one input per step."""

    def one(z: Array, u: Array) -> tuple[Array, Array]:
        z = model.A @ z + model.B @ u
        return z, z

    return jnp.concatenate([z[None], jax.lax.scan(one, z, inputs)[1]])
