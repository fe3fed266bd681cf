"""The box-constrained QP, what counts as its solution, and what a solver reports.

    minimise  1/2 x^T H x + q^T x   subject to  lower <= x <= upper,   H positive definite

Everything is measured in Jacobi-scaled coordinates x_hat = x / d with d = diag(H)^-1/2, in which H
has a unit diagonal and x_hat, its gradient and q share one unit. The residual is relative to the
size of q_hat and x_hat, so it does not change when H and q are multiplied by any number or when
the unit of x does.
"""

from enum import IntEnum
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Status(IntEnum):
    """Outcome of a solve."""

    SOLVED = 0
    ITERATION_LIMIT = 1
    INFEASIBLE_BOUNDS = 2
    NON_FINITE = 3
    NOT_POSITIVE_DEFINITE = 4


STATUS_TEXT = {
    Status.SOLVED: "solved to the tolerance",
    Status.ITERATION_LIMIT: "iteration limit reached; the point is the best so far",
    Status.INFEASIBLE_BOUNDS: "a lower bound exceeds its upper bound, or is +inf, or upper is -inf",
    Status.NON_FINITE: "H, q or a bound holds NaN, or H or q infinity",
    Status.NOT_POSITIVE_DEFINITE: "H is not positive definite to working precision",
}


class Prepared(NamedTuple):
    """What depends on H alone; made once by ``prepare``, stackable over modes.

    Attributes:
      H: (n, n) Jacobi-scaled Hessian, unit diagonal [-].
      scale: (n,) d, with x = d x_hat.
      eig_min: smallest eigenvalue of the scaled Hessian [-].
      eig_max: largest one [-].
      rho: ADMM's penalty, sqrt(eig_min eig_max) [-].
      resolvent: (n, n) (H + rho I)^-1 [-].
      inverse: (n, n) H^-1 [-].
      finite: whether H is finite.
      definite: whether H is positive definite to working precision.
    """

    H: Float[Array, "n n"]
    scale: Float[Array, "n"]
    eig_min: Float[Array, ""]
    eig_max: Float[Array, ""]
    rho: Float[Array, ""]
    resolvent: Float[Array, "n n"]
    inverse: Float[Array, "n n"]
    finite: Bool[Array, ""]
    definite: Bool[Array, ""]


class Solution(NamedTuple):
    """Result of a solve.

    Attributes:
      x: (n,) minimiser, always within the bounds where these are consistent.
      status: a ``Status``; nothing but ``SOLVED`` may be trusted to the tolerance.
      residual: relative KKT residual of ``x`` (see ``kkt_residual``) [-].
      iterations: number of iterations spent.
    """

    x: Float[Array, "n"]
    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]


def prepare(H: Float[Array, "n n"]) -> Prepared:
    """Scaling, spectrum and ADMM resolvent of a Hessian (its symmetric part is used).

    Traceable and ``vmap``-able; for a constant H call it once, in float64.
    """
    n = H.shape[-1]
    finite = jnp.isfinite(H).all()
    diagonal = jnp.diagonal(H)
    positive = (diagonal > 0).all()
    usable = finite & positive
    # A harmless stand-in keeps the branch that nobody will read free of NaN.
    safe = jnp.where(usable, 0.5 * (H + H.T), jnp.eye(n, dtype=H.dtype))
    scale = 1.0 / jnp.sqrt(jnp.diagonal(safe))
    scaled = safe * scale[:, None] * scale[None, :]
    eigenvalues, vectors = jnp.linalg.eigh(scaled)
    floor = n * jnp.finfo(H.dtype).eps * eigenvalues[-1]
    definite = positive & (eigenvalues[0] > floor)
    eigenvalues = jnp.maximum(eigenvalues, floor)
    rho = jnp.sqrt(eigenvalues[0] * eigenvalues[-1])
    return Prepared(
        H=scaled,
        scale=scale,
        eig_min=eigenvalues[0],
        eig_max=eigenvalues[-1],
        rho=rho,
        resolvent=(vectors / (eigenvalues + rho)) @ vectors.T,
        inverse=(vectors / eigenvalues) @ vectors.T,
        finite=finite,
        definite=definite | ~finite,
    )


def kkt_residual(
    H: Float[Array, "n n"],
    q: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    x: Float[Array, "n"],
) -> Float[Array, ""]:
    """Relative natural residual |x - clip(x - grad)|_inf of the Jacobi-scaled problem.

    It is zero exactly at the minimiser: there a free variable has no gradient, and at a bound the
    gradient pushes against the bound. Relative to max(|q_hat|, |x_hat|).
    """
    scale = 1.0 / jnp.sqrt(jnp.diagonal(H))
    scaled = H * scale[:, None] * scale[None, :]
    return natural_residual(scaled, q * scale, lower / scale, upper / scale, x / scale)


def natural_residual(
    H: Float[Array, "n n"],
    q: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    x: Float[Array, "n"],
) -> Float[Array, ""]:
    """``kkt_residual`` for a problem that is scaled already."""
    step = x - jnp.clip(x - (H @ x + q), lower, upper)
    size = jnp.maximum(jnp.max(jnp.abs(q)), jnp.max(jnp.abs(x)))
    return jnp.max(jnp.abs(step)) / jnp.where(size > 0, size, 1.0)
