"""ADMM for general rows (OSQP, Stellato et al. 2020) on the scaled problem of ``qp.row_problem``.

With v = A x split off, A the rows of C and the box, penalties rho_i, sigma and relaxation alpha:

1. Factorise K = H + sigma I + A^T diag(rho) A.
2. ``CHECK`` times:  x~ = K^-1 (sigma x - q + A^T (rho v - y)),  x = alpha x~ + (1 - alpha) x,
   v = clip(alpha A x~ + (1 - alpha) v + y / rho),  y = y + rho (...- v).
3. Polish a copy of the point on the rows that look active; stop where either is within the
   tolerance.
4. Stop where the last change of y proves infeasibility, or that of x an unbounded cost.
5. Balance primal and dual residuals by rho, and go to step 1.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax.qp.certificates import is_descent, proves_infeasible
from kjax.qp.lapack import cholesky, inverse_of_lower
from kjax.qp.polish import polish
from kjax.qp.row_problem import RowProblem

CHECK = 25  # iterations between two factorisations, OSQP's own
ALPHA = 1.6
SIGMA = 1e-6


class Split(NamedTuple):
    """Outcome of ``solve_splitting``.

    Attributes:
      x: (n,) best point.
      multipliers: (M,) its multipliers, positive at upper sides.
      infeasible: whether no point keeps all rows, proven.
      iterations: spent.
    """

    x: Float[Array, "n"]
    multipliers: Float[Array, "M"]
    infeasible: Bool[Array, ""]
    iterations: Int[Array, ""]


class _State(NamedTuple):
    x: Float[Array, "n"]
    v: Float[Array, "M"]
    y: Float[Array, "M"]
    rho: Float[Array, ""]
    best_x: Float[Array, "n"]
    best_y: Float[Array, "M"]
    error: Float[Array, ""]
    infeasible: Bool[Array, ""]
    stop: Bool[Array, ""]
    spent: Int[Array, ""]


class _Rows(NamedTuple):
    """The problem with its bounds, and the weight of each row in rho."""

    problem: RowProblem
    low: Float[Array, "M"]
    high: Float[Array, "M"]
    weight: Float[Array, "M"]

    def judged(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The point in the box, and its largest error."""
        m = self.problem.C.shape[0]
        x = jnp.clip(x, self.low[m:], self.high[m:])
        return x, jnp.max(self.problem.errors(x, y))


def solve_splitting(
    problem: RowProblem,
    good: Array,
    warm: Float[Array, "n"] | None,
    *,
    tolerance: float,
    max_iterations: int,
) -> Split:
    """Solve the problem, H semidefinite; nothing is done if not ``good``."""
    n, m, dtype = problem.q.shape[0], problem.C.shape[0], problem.q.dtype
    low, high = problem.bounds()
    free = (low == -jnp.inf) & (high == jnp.inf)
    weight = jnp.where(problem.equal, 1e3, jnp.where(free, 1e-6, 1.0)).astype(dtype)
    rows = _Rows(problem, low, high, weight)
    x0 = jnp.zeros((n,), dtype) if warm is None else warm
    start = _State(
        x=x0,
        v=jnp.clip(problem.rows(x0), low, high),
        y=jnp.zeros_like(low),
        rho=jnp.asarray(0.1, dtype),
        best_x=jnp.clip(x0, low[m:], high[m:]),
        best_y=jnp.zeros_like(low),
        error=jnp.asarray(jnp.inf, dtype),
        infeasible=jnp.zeros((), bool),
        stop=~good,
        spent=jnp.zeros((), jnp.int32),
    )
    state = jax.lax.while_loop(
        lambda state: ~state.stop & (state.spent < max_iterations),
        partial(_advance, tolerance, max_iterations, rows),
        start,
    )
    return Split(state.best_x, state.best_y, state.infeasible, state.spent)


def _advance(tolerance: float, max_iterations: int, rows: _Rows, state: _State) -> _State:
    """Steps 1 to 5."""
    problem = rows.problem
    steps = jnp.minimum(CHECK, max_iterations - state.spent)
    x, v, y, old_x, old_y = _iterate(rows, state, steps)

    plain_x, plain_error = rows.judged(x, y)  # step 3
    fine_x, fine_y, _, _ = polish(problem, x, y)
    fine_x, fine_error = rows.judged(fine_x, fine_y)
    polished = fine_error < plain_error
    new_x = jnp.where(polished, fine_x, plain_x)
    new_y = jnp.where(polished, fine_y, y)
    new_error = jnp.where(polished, fine_error, plain_error)
    better = new_error < state.error
    error = jnp.where(better, new_error, state.error)
    infeasible = proves_infeasible(problem, y - old_y)  # step 4
    broken = ~(jnp.isfinite(x).all() & jnp.isfinite(y).all())
    stop = (error <= tolerance) | infeasible | is_descent(problem, x - old_x) | broken
    return _State(
        x=x, v=v, y=y, rho=jnp.clip(state.rho * _balance(problem, x, v, y), 1e-6, 1e6),
        best_x=jnp.where(better, new_x, state.best_x),
        best_y=jnp.where(better, new_y, state.best_y),
        error=error, infeasible=infeasible, stop=stop, spent=state.spent + steps,
    )  # fmt: skip


def _iterate(rows: _Rows, state: _State, steps: Array) -> tuple[Array, ...]:
    """Steps 1 and 2: x, v, y, and the x and y before the last iteration."""
    problem, low, high, weight = rows
    n, dtype = problem.q.shape[0], problem.q.dtype
    rho = state.rho * weight
    K = problem.H + SIGMA * jnp.eye(n, dtype=dtype) + problem.gram(rho)  # step 1
    half = inverse_of_lower(cholesky(K))

    def step(_: Any, carry: Any) -> Any:  # step 2
        x, v, y, _, _ = carry
        right = SIGMA * x - problem.q + problem.adjoint(rho * v - y)
        new_x = half.T @ (half @ right)
        mixed = ALPHA * problem.rows(new_x) + (1.0 - ALPHA) * v
        new_v = jnp.clip(mixed + y / rho, low, high)
        return ALPHA * new_x + (1.0 - ALPHA) * x, new_v, y + rho * (mixed - new_v), x, y

    carry = (state.x, state.v, state.y, state.x, state.y)
    return jax.lax.fori_loop(0, steps, step, carry)


def _balance(problem: RowProblem, x: Array, v: Array, y: Array) -> Array:
    """Step 5: the factor of rho that brings primal and dual residuals to one size."""
    value = problem.rows(x)
    r_primal = jnp.max(jnp.abs(value - v)) / _largest(value, v)
    push = problem.adjoint(y)
    r_dual = jnp.max(jnp.abs(problem.H @ x + problem.q + push))
    r_dual = r_dual / _largest(problem.H @ x, problem.q, push)
    tiny = jnp.finfo(x.dtype).tiny
    factor = jnp.sqrt(jnp.maximum(r_primal, tiny) / jnp.maximum(r_dual, tiny))
    return jnp.where((factor > 5.0) | (factor < 0.2), jnp.clip(factor, 1e-3, 1e3), 1.0)


def _largest(*parts: Array) -> Array:
    size = jnp.stack([jnp.max(jnp.abs(part), initial=0.0) for part in parts]).max()
    return jnp.where(size > 0, size, 1.0)
