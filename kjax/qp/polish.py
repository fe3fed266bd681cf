r"""The equations that the active rows make: a method's point brought to rounding, and derivatives.

[ H  A^T ] [ dx ]     [ -r_dual   ]
[ A  0   ] [ dy ]  =  [  r_primal ]      with A the active rows
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.qp.lapack import cholesky, inverse_of_lower
from kjax.qp.row_problem import RowProblem


def polish(
    problem: RowProblem, x: Float[Array, "n"], y: Float[Array, "M"]
) -> tuple[Float[Array, "n"], Float[Array, "M"], Bool[Array, "M"], Bool[Array, "M"]]:
    """Point, multipliers, and the rows that are active at their lower and upper sides.

    A side counts as active where its multiplier outweighs its slack, as in an interior point's
    complementarity; the point is the minimiser where these sides hold as equations.
    """
    value = problem.rows(x)
    at_low = problem.has_low & (-y > value - problem.low)
    at_high = problem.has_high & (y > problem.high - value) & ~at_low
    active = at_low | at_high | problem.equal
    y = jnp.where(active, y, 0.0)
    A = jnp.concatenate([problem.C, jnp.eye(x.shape[0], dtype=x.dtype)])
    wanted = jnp.where(at_low, problem.low, problem.high)
    r_dual = problem.H @ x + problem.q + problem.adjoint(y)
    r_primal = jnp.where(active, wanted - value, 0.0)
    dx, dy = solve_equations(problem.H, jnp.where(active[:, None], A, 0.0), r_dual, r_primal)
    return x + dx, y + jnp.where(active, dy, 0.0), at_low, at_high


def solve_equations(
    H: Float[Array, "n n"],
    A: Float[Array, "M n"],
    r_dual: Float[Array, "n"],
    r_primal: Float[Array, "M"],
) -> tuple[Float[Array, "n"], Float[Array, "M"]]:
    """dx, dy of  H dx + A^T dy = -r_dual,  A dx = r_primal, where rows not active are zero.

    Augmented Lagrangian: one Cholesky of H + rho A^T A with rho = eps^(-1/2), then a few steps,
    each of which brings sqrt(eps); rows that depend on one another share their multipliers evenly.
    """
    n, eps = H.shape[0], float(jnp.finfo(H.dtype).eps)
    # In units of the largest curvature, or rho would drown a small H.
    h = jnp.max(jnp.diagonal(H))
    h = jnp.where(h > 0, h, 1.0)
    H, r_dual = H / h, r_dual / h
    rho = eps**-0.5
    ridge = 10.0 * n * eps
    half = inverse_of_lower(cholesky(H + rho * A.T @ A + ridge * jnp.eye(n, dtype=H.dtype)))
    dx, dy = jnp.zeros_like(r_dual), jnp.zeros_like(r_primal)
    for _ in range(4):
        missing = A @ dx - r_primal
        residual = r_dual + H @ dx + A.T @ (dy + rho * missing)
        step = -(half.T @ (half @ residual))
        dx = dx + step
        dy = dy + rho * (missing + A @ step)
    return dx, h * dy
