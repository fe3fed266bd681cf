"""The box-constrained QP, what counts as its solution, and what a solver reports.

    minimise  1/2 x^T H x + q^T x   subject to  lower <= x <= upper,   H positive definite

Everything is measured in Jacobi-scaled coordinates x_hat = x / d with d = diag(H)^-1/2, in which H
has a unit diagonal. What is left of a gradient is judged against the two terms that it is the sum
of, H x and q, variable by variable, and a distance from a bound against the point: so the residual
does not change when H and q are multiplied by any number, when the unit of x does, or when the box
is small beside the unconstrained minimiser.
"""

from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax.precision import full_precision
from kjax.qp.lapack import cholesky, inverse_of_lower


class Status(IntEnum):
    """Outcome of a solve."""

    SOLVED = 0
    ITERATION_LIMIT = 1
    INFEASIBLE_BOUNDS = 2
    NON_FINITE = 3
    NOT_POSITIVE_DEFINITE = 4
    INFEASIBLE = 5
    UNBOUNDED = 6


STATUS_TEXT = {
    Status.SOLVED: "solved to the tolerance",
    Status.ITERATION_LIMIT: "iteration limit reached; the point is the best so far",
    Status.INFEASIBLE_BOUNDS: "a lower bound exceeds its upper bound, or is +inf, or upper is -inf",
    Status.NON_FINITE: "H, q or a bound holds NaN, or H or q infinity",
    Status.NOT_POSITIVE_DEFINITE: "H is not positive definite to working precision",
    Status.INFEASIBLE: "no point keeps all rows and bounds",
    Status.UNBOUNDED: "the cost has no lower end within the rows and bounds",
}


class Prepared(NamedTuple):
    """What depends on H alone; made once by ``prepare``, stackable over modes.

    Attributes:
      H: (n, n) Jacobi-scaled Hessian, unit diagonal [-].
      scale: (n,) d, with x = d x_hat.
      table: (n, n) tableau that a cold start pivots from, see ``qp.tableau``; H^-1 where no
        variable is known to be fixed [-].
      bound_status: (n,) -1 where a variable is known to be fixed, else 0.
      inverse: (n, n) H^-1 [-].
      eig_min: smallest eigenvalue of the scaled Hessian [-].
      eig_max: largest one [-].
      rho: ADMM's penalty, sqrt(eig_min eig_max) [-].
      resolvent: (n, n) (H + rho I)^-1 [-].
      finite: whether H is finite.
      definite: whether H is positive definite to working precision.
    """

    H: Float[Array, "n n"]
    scale: Float[Array, "n"]
    table: Float[Array, "n n"]
    bound_status: Int[Array, "n"]
    inverse: Float[Array, "n n"]
    eig_min: Float[Array, ""]
    eig_max: Float[Array, ""]
    rho: Float[Array, ""]
    resolvent: Float[Array, "n n"]
    finite: Bool[Array, ""]
    definite: Bool[Array, ""]

    @property
    def condition(self) -> Float[Array, ""]:
        """Condition number of the scaled Hessian [-]."""
        return self.eig_max / self.eig_min


class ScaledBox(NamedTuple):
    """The box QP in scaled coordinates."""

    H: Float[Array, "n n"]
    q: Float[Array, "n"]
    lower: Float[Array, "n"]
    upper: Float[Array, "n"]

    def clip(self, x: Array) -> Array:
        """The nearest point of the box."""
        return jnp.clip(x, self.lower, self.upper)

    def residual(self, x: Array) -> Array:
        """``box_error`` of a point of the box."""
        return box_error(self.H, self.q, self.lower, self.upper, x)


class Warm(NamedTuple):
    """Where the next solve with the same ``Prepared`` may start; data, to be carried.

    Attributes:
      x: (n,) point.
      table: (n, n) tableau swept on the free variables.
      bound_status: (n,) -1 at the lower bound, 0 free, 1 at the upper bound.
    """

    x: Float[Array, "n"]
    table: Float[Array, "n n"]
    bound_status: Int[Array, "n"]


class Solution(NamedTuple):
    """Result of a solve.

    Attributes:
      x: (n,) minimiser, always within the bounds where these are consistent.
      multipliers: (n,) y with H x + q + y = 0: positive at upper, negative at lower bounds.
      status: a ``Status``; nothing but ``SOLVED`` may be trusted to the tolerance.
      residual: relative KKT residual of ``x`` (see ``kkt_residual``) [-].
      primal: largest violation of a bound, relative; 0, as x is clipped [-].
      dual: residual of the equation of the multipliers, relative [-].
      gap: sum of |y| times the distance from its bound, relative to the objective's terms; 0, as
        multipliers belong to bounds that x is at [-].
      margin: smallest of every bound variable's |gradient| and every free variable's distance from
        a bound, relative; where it is near 0 a bound is weakly active, and the derivative is that
        of one side [-].
      iterations: number of iterations spent.
      warm: where to go on from.
    """

    x: Float[Array, "n"]
    multipliers: Float[Array, "n"]
    status: Int[Array, ""]
    residual: Float[Array, ""]
    primal: Float[Array, ""]
    dual: Float[Array, ""]
    gap: Float[Array, ""]
    margin: Float[Array, ""]
    iterations: Int[Array, ""]
    warm: Warm


@full_precision
def prepare(H: Float[Array, "n n"], fixed: Bool[Array, "n"] | None = None) -> Prepared:
    """Scaling, inverse and spectrum of a Hessian (its symmetric part is used).

    Traceable, ``vmap``-able and differentiable; for a constant H call it once, in float64. What a
    solver does not use is not computed inside ``jit``.

    Args:
      H: (n, n) symmetric positive definite.
      fixed: (n,) variables whose bounds will be equal: a cold start then begins with them fixed.
        A hint, not a promise.
    """
    n = H.shape[-1]
    finite = jnp.isfinite(H).all()
    diagonal = jnp.diagonal(H)
    positive = (diagonal > 0).all()
    usable = finite & positive
    # A harmless stand-in keeps the branch that nobody will read free of NaN.
    safe = jnp.where(usable, 0.5 * (H + H.T), jnp.eye(n, dtype=H.dtype))
    # The scaling is a choice, not a part of the problem: no derivative goes through it.
    scale = jax.lax.stop_gradient(1.0 / jnp.sqrt(jnp.diagonal(safe)))
    scaled = safe * scale[:, None] * scale[None, :]
    constant = jax.lax.stop_gradient(scaled)
    # By Cholesky, which costs a tenth of the spectrum that only the first-order methods need. The
    # trace of H^-1 is 1/eig_min to n/eig_min, and |H| is no less than eig_max.
    eps = float(jnp.finfo(H.dtype).eps)
    half = inverse_of_lower(cholesky(constant))
    definite = positive & (n * eps * jnp.linalg.norm(constant) * jnp.sum(half**2) < 1.0)
    stand_in = jnp.where(definite, constant, jnp.eye(n, dtype=H.dtype))
    eigenvalues, vectors = jnp.linalg.eigh(constant)
    eigenvalues = jnp.maximum(eigenvalues, n * eps * eigenvalues[-1])
    rho = jnp.sqrt(eigenvalues[0] * eigenvalues[-1])
    bound_status = jnp.zeros((n,), jnp.int32) if fixed is None else -fixed.astype(jnp.int32)
    return Prepared(
        H=scaled,
        scale=scale,
        table=swept(stand_in, bound_status == 0),
        bound_status=bound_status,
        inverse=(vectors / eigenvalues[None]) @ vectors.T,
        eig_min=eigenvalues[0],
        eig_max=eigenvalues[-1],
        rho=rho,
        resolvent=(vectors / (eigenvalues + rho)[None]) @ vectors.T,
        finite=finite,
        definite=definite | ~finite,
    )


def start(prepared: Prepared) -> Warm:
    """The cold start, as something to carry."""
    return Warm(
        x=jnp.zeros_like(prepared.scale), table=prepared.table, bound_status=prepared.bound_status
    )


def swept(H: Float[Array, "n n"], free: Bool[Array, "n"]) -> Float[Array, "n n"]:
    """Tableau of H swept on the free variables, from scratch; see ``qp.tableau``."""
    both, neither = (jnp.outer(a, a).astype(H.dtype) for a in (free, ~free))
    # Bound variables get a unit diagonal of their own, so that one factorisation does for all.
    factor = cholesky(H * both + jnp.diag((~free).astype(H.dtype)))
    half = inverse_of_lower(factor)
    inverse = both * (half.T @ half)
    right = inverse @ H
    cross = jnp.outer(free, ~free).astype(H.dtype) * right
    return inverse - cross + cross.T + neither * (H - H @ right)


def no_tangent(leaf: Array) -> Any:
    """The tangent of a result that has no derivative."""
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        return jnp.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)


@full_precision
def kkt_residual(
    H: Float[Array, "n n"],
    q: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    x: Float[Array, "n"],
) -> Float[Array, ""]:
    """Relative KKT residual of any point: zero exactly at the minimiser, continuous around it.

    Of every variable the median of (x - upper, gradient, x - lower): there a free variable has no
    gradient, and at a bound the gradient pushes against the bound. Gradients are relative to
    max(|H| |x|, |q|) of their own variable, distances to max(|x_hat|).
    """
    scale = 1.0 / jnp.sqrt(jnp.diagonal(H))
    scaled = H * scale[:, None] * scale[None, :]
    low, high, point = lower / scale, upper / scale, x / scale
    terms = jnp.maximum(jnp.abs(scaled) @ jnp.abs(point), jnp.abs(q * scale))
    slope = relative_gradient(scaled, q * scale, point, terms)
    size = jnp.max(jnp.abs(point))
    size = jnp.where(size > 0, size, 1.0)
    below, above = (point - low) / size, (point - high) / size
    return jnp.max(jnp.abs(jnp.maximum(above, jnp.minimum(slope, below))))


def relative_gradient(
    H: Float[Array, "n n"], q: Float[Array, "n"], x: Float[Array, "n"], terms: Float[Array, "n"]
) -> Float[Array, "n"]:
    """Gradient of the scaled problem less what rounding leaves of it, relative to ``terms``."""
    gradient = H @ x + q
    n, eps = q.shape[0], float(jnp.finfo(q.dtype).eps)
    noise = 4.0 * n**0.5 * eps * jnp.maximum(jnp.max(jnp.abs(q)), jnp.max(jnp.abs(x)))
    excess = jnp.maximum(jnp.abs(gradient) - noise, 0.0)
    return jnp.sign(gradient) * excess / jnp.where(terms > 0, terms, 1.0)


def box_error(
    H: Float[Array, "n n"],
    q: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    x: Float[Array, "n"],
) -> Float[Array, ""]:
    """Residual of a point of the scaled problem that is inside the box, bounds to the last bit.

    Unlike ``kkt_residual`` it takes a variable to be at a bound only where it is. Of |H| |x| the
    diagonal's part alone, which saves a product with H.
    """
    slope = relative_gradient(H, q, x, jnp.maximum(jnp.abs(x), jnp.abs(q)))
    held = ((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0))
    return jnp.max(jnp.where(held, 0.0, jnp.abs(slope)))
