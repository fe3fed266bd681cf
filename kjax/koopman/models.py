"""Linear Koopman predictors  Pi(x_{t+1}) = A Pi(x_t) + B(r) u_t  (Eq. 3 projected, Eq. 4).

``B`` depends on the contact points: B(r) = B_0 + sum_k r_k B_k with r = (front, rear) x (x, z).
A model with fixed contact points (the paper) has B_k = 0.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.koopman.observables import STATE_ROWS
from kjax.precision import full_precision


class LinearModel(NamedTuple):
    """Linear predictor in the lifted space; stacked over contact modes on a leading axis.

    Attributes:
      A: (N, N) transition of the lifted state per step.
      B: (N, 4) input map at contact points r = 0 (or at the fixed ones) [1/N].
      B_feet: (4, N, 4) its change per metre of each contact coordinate, order front x, front z,
        rear x, rear z [1/(N m)].
    """

    A: Float[Array, "N N"]
    B: Float[Array, "N 4"]
    B_feet: Float[Array, "4 N 4"]


class BilinearModel(NamedTuple):
    """z+ = A z + sum_i z_i B[i] u + sum_k r_k B_feet[k] u.

    Attributes:
      A: (N, N) transition.
      B: (N, N, 4) input map of each observable; that of the constant, B[0], is the linear one.
      B_feet: (4, N, 4) change of B[0] per metre of each contact coordinate, as in ``LinearModel``.
    """

    A: Float[Array, "N N"]
    B: Float[Array, "N N 4"]
    B_feet: Float[Array, "4 N 4"]

    def step(
        self, z: Float[Array, "N"], u: Float[Array, "4"], feet: Float[Array | np.ndarray, "2 2"]
    ) -> Float[Array, "N"]:
        """Lifted state one step later."""
        response = self.A @ z + jnp.einsum("inm,i,m->n", self.B, z, u)
        return response + jnp.einsum("k,knm,m->n", feet.reshape(4), self.B_feet, u)


@full_precision
def input_map(model: LinearModel, feet: Float[Array | np.ndarray, "2 2"]) -> Float[Array, "N 4"]:
    """B(r) for contact points ``feet`` (2, 2), body frame [m]."""
    return model.B + jnp.tensordot(feet.reshape(4), model.B_feet, axes=1)


@full_precision
def step(
    model: LinearModel,
    z: Float[Array, "N"],
    u: Float[Array, "4"],
    feet: Float[Array | np.ndarray, "2 2"],
) -> Float[Array, "N"]:
    """Lifted state one step later (the paper's K Pi-hat)."""
    return model.A @ z + input_map(model, feet) @ u


@full_precision
def rollout(
    model: LinearModel,
    z0: Float[Array, "N"],
    inputs: Float[Array, "steps 4"],
    feet: Float[Array | np.ndarray, "2 2"],
) -> Float[Array, "steps_plus_1 6"]:
    """Predicted states (steps + 1, 6) from a lifted initial state; no re-lifting on the way."""
    B = input_map(model, feet)

    def one(z: Array, u: Array) -> tuple[Array, Array]:
        z_next = model.A @ z + B @ u
        return z_next, z_next[STATE_ROWS]

    _, states = jax.lax.scan(one, z0, inputs)
    return jnp.concatenate([z0[STATE_ROWS][None], states])


@full_precision
def aggregate(model: LinearModel, steps: int) -> LinearModel:
    """The same model over ``steps`` of its own steps at once, the input held."""
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    powers = [jnp.eye(model.A.shape[-1], dtype=model.A.dtype)]
    for _ in range(steps):
        powers.append(model.A @ powers[-1])
    held = sum(powers[1:-1], powers[0])  # I + A + ... + A^(steps - 1)
    return LinearModel(A=powers[-1], B=held @ model.B, B_feet=held @ model.B_feet)
