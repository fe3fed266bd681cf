"""SO(3) observables of a rigid body, with linear and with bilinear EDMD: 28 functions of its state.

    z = (1, p, v, vec(R), omega, vec(R [omega_b]))

omega is in the world, omega_b in the trunk's axes, so that R' = R [omega_b] is linear in z. Inputs
are the wrench of the standing feet. How a moment turns the body depends on its attitude: the linear
model takes the mean over its data, the bilinear one has the products vec(R) (x) wrench.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.dynamics.rotations import skew
from kjax.dynamics.spatial_data import Data
from kjax.koopman import regression
from kjax.precision import full_precision

SIZE = 28
P, V, ROTATION, OMEGA = slice(1, 4), slice(4, 7), slice(7, 16), slice(16, 19)


class So3Model(NamedTuple):
    """z+ = z + W^T phi(z, wrench), phi = (z, wrench), or with vec(R) (x) wrench besides.

    Attributes:
      W: (34, 28), or (88, 28) of a bilinear one.
      dt: step [s].
    """

    W: Float[Array, "c 28"]
    dt: Float[Array, ""]


def lift(
    p: Float[Array, "3"], v: Float[Array, "3"], R: Float[Array, "3 3"], omega: Float[Array, "3"]
) -> Float[Array, "28"]:
    """Lifted state of a body [m, m/s, -, rad/s]."""
    turning = R @ skew(R.T @ omega)
    return jnp.concatenate([jnp.ones_like(p[:1]), p, v, R.reshape(-1), omega, turning.reshape(-1)])


def wrench(
    feet: Float[Array, "n 3"], force: Float[Array, "n 3"], about: Float[Array, "3"]
) -> Float[Array, "6"]:
    """Sum of the forces [N], and of their moments about a point [N m]."""
    return jnp.concatenate([force.sum(axis=0), jnp.cross(feet - about[None], force).sum(axis=0)])


def regressors(
    z: Float[Array, "28"], inputs: Float[Array, "u"], *, bilinear: bool
) -> Float[Array, "c"]:
    """Phi of a lifted state and of inputs, a wrench or others."""
    if not bilinear:
        return jnp.concatenate([z, inputs])
    return jnp.concatenate([z, inputs, jnp.outer(z[ROTATION], inputs).reshape(-1)])


def step(
    model: So3Model,
    z: Float[Array, "28"],
    inputs: Float[Array, "u"],
    h: Float[Array, ""] | float,
    *,
    bilinear: bool,
) -> Float[Array, "28"]:
    """Lifted state after ``h`` [s], at most about the model's own step."""
    return z + (h / model.dt) * (regressors(z, inputs, bilinear=bilinear) @ model.W)


def lifted(data: Data, k: int) -> Float[Array, "N 28"]:
    """Lifted states of roll-outs at the end of node k."""
    now = jax.tree.map(lambda a: a[:, k], data.states)
    return jax.vmap(lift)(now.p, now.v, now.R, data.omega[:, k])


@full_precision
def fit(
    now: Float[Array | np.ndarray, "M 28"],
    inputs: Float[Array | np.ndarray, "M u"],
    then: Float[Array | np.ndarray, "M 28"],
    dt: float,
    *,
    bilinear: bool,
) -> So3Model:
    """EDMD (Eq. 5) on the increments of lifted states.

    Args:
      now: lifted states.
      inputs: of each step, held: a wrench about the body's place, or others.
      then: lifted states one step later.
      dt: step [s].
      bilinear: whether products with vec(R) are regressors.
    """
    now, inputs, then = map(jnp.asarray, (now, inputs, then))
    Z = jax.vmap(lambda z, u: regressors(z, u, bilinear=bilinear))(now, inputs)
    W = regression.solve(regression.of_rows(Z, then - now), Z.shape[1]).W
    return So3Model(W=W, dt=jnp.asarray(dt, W.dtype))


def fit_body(data: Data, dt: float, *, bilinear: bool) -> So3Model:
    """A model of one-step roll-outs, with the wrench about the body's place."""
    about = data.states.p[:, 0]
    inputs = jax.vmap(wrench)(data.feet, data.force[:, 0], about)
    return fit(lifted(data, 0), inputs, lifted(data, 1), dt, bilinear=bilinear)


def nearest_rotation(A: Float[Array, "3 3"], steps: int = 4) -> Float[Array, "3 3"]:
    """The rotation nearest to a matrix that is almost one, by Newton's iteration."""
    for _ in range(steps):
        # The inverse's transpose is that of the cofactors over the determinant.
        rows = jnp.cross(A[jnp.array([1, 2, 0])], A[jnp.array([2, 0, 1])])
        A = (A + rows / (A[0] @ rows[0])) / 2
    return A
