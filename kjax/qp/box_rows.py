"""``solve_rows_from_box``: a QP with rows that are seldom active, at the price of its box.

1. Solve the box QP without the rows, warm-started.
2. Check the rows at its solution. Where all hold, it is the solution of the whole problem.
3. Only where one is violated, solve the whole problem; in a batch, only for those members.

The derivative is that of the active set of whichever problem gave the point.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax.precision import full_precision
from kjax.qp.batching import where_needed
from kjax.qp.box import Method, solve
from kjax.qp.polish import solve_equations
from kjax.qp.problem import Prepared, Solution, Status, Warm, no_tangent
from kjax.qp.row_derivative import active_equations
from kjax.qp.row_methods import RowMethod
from kjax.qp.row_problem import RowData, rows_error
from kjax.qp.rows import solve_rows


class BoxRowSolution(NamedTuple):
    """Result of ``solve_rows_from_box``.

    Attributes:
      x: (n,) minimiser within rows and box.
      status: a ``Status``, of the whole problem.
      residual: the largest of its residuals, relative [-].
      iterations: of both problems.
      violated: whether the box's solution broke a row, so that the whole problem was solved.
      warm: for the next box problem.
    """

    x: Float[Array, "n"]
    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    violated: Bool[Array, ""]
    warm: Warm


class _Settings(NamedTuple):
    box_method: Method
    row_method: RowMethod
    tolerance: float
    max_iterations: int


class _Qp(NamedTuple):
    """The caller's problem and start, or a change of it."""

    prepared: Prepared
    which: Array | None  # of a stack of Hessians
    q: Array
    C: Array
    row_lower: Array
    row_upper: Array
    lower: Array
    upper: Array
    warm: Any

    def stacked(self) -> RowData:
        """The problem picked, in the caller's units but for H; bounds of rows and box in one."""
        H = self.prepared.H if self.which is None else self.prepared.H[self.which]
        low = jnp.concatenate([self.row_lower, self.lower])
        high = jnp.concatenate([self.row_upper, self.upper])
        return RowData(H, self.q, self.C, low, high)


@full_precision
def solve_rows_from_box(
    prepared: Prepared,
    q: Float[Array, "n"],
    C: Float[Array, "m n"],
    row_lower: Float[Array, "m"],
    row_upper: Float[Array, "m"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    warm: Warm | Float[Array, "n"] | None = None,
    *,
    index: Int[Array, ""] | None = None,
    box_method: Method = "tableau",
    row_method: RowMethod = "active_set",
    tolerance: float = 1e-9,
    max_iterations: int = 2000,
) -> BoxRowSolution:
    """Minimiser of 1/2 x^T H x + q^T x within rows and box, the box tried first.

    Thirteen arguments: those of ``solve_rows``, and options of both problems by keyword.

    Args:
      prepared: from ``prepare(H)``, H positive definite.
      q: (n,) linear term.
      C: (m, n) rows.
      row_lower: (m,) lower bounds of C x, ``-inf`` for none.
      row_upper: (m,) upper bounds of C x.
      lower: (n,) lower bounds of x.
      upper: (n,) upper bounds of x.
      warm: as in ``solve``; the box problem starts from it.
      index: as in ``solve``, which of a stack of Hessians.
      box_method: of ``solve``.
      row_method: of ``solve_rows``.
      tolerance: of either [-].
      max_iterations: of either.

    Returns:
      A ``BoxRowSolution``; ``x`` has derivatives by H (through ``prepare``), q, C and all bounds.
    """
    if C.shape[0] == 0:
        raise ValueError("C has no rows: use qp.solve")
    settings = _Settings(box_method, row_method, tolerance, max_iterations)
    warm = jax.lax.stop_gradient(warm)
    return _differentiable(
        settings, _Qp(prepared, index, q, C, row_lower, row_upper, lower, upper, warm)
    )


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(settings: _Settings, qp: _Qp) -> BoxRowSolution:
    return _with_rows(settings, _solve_box(settings, qp), qp)[0]


def _solve_box(settings: _Settings, qp: _Qp) -> Solution:
    """Step 1."""
    return solve(
        qp.prepared, qp.q, qp.lower, qp.upper, qp.warm, index=qp.which, method=settings.box_method,
        tolerance=settings.tolerance, max_iterations=settings.max_iterations,
    )  # fmt: skip


def _with_rows(settings: _Settings, box: Solution, qp: _Qp) -> tuple[BoxRowSolution, Array]:
    """Steps 2 and 3; and the multipliers (m + n,), zero where the rows hold."""
    prepared, q, C = qp.prepared, qp.q, qp.C
    d = prepared.scale if qp.which is None else prepared.scale[qp.which]
    error = rows_error(C, qp.row_lower, qp.row_upper, d, box.x)
    tolerance = max(settings.tolerance, 20.0 * float(jnp.finfo(q.dtype).eps))
    faulty = box.status > Status.ITERATION_LIMIT
    # Written so that NaN counts as a violation: the whole problem then says what is wrong.
    violated = ~faulty & ~((error <= tolerance) & (box.status == Status.SOLVED))
    y = jnp.zeros((C.shape[0] + q.shape[0],), q.dtype)
    residual = jnp.where(faulty, box.residual, jnp.maximum(box.residual, error))
    x, y, status, residual, iterations = where_needed(
        violated,
        partial(_solve_whole, settings),
        (box.x, y, box.status, residual, box.iterations),
        (prepared.H, prepared.scale),
        qp.which,
        qp.q,
        qp.C,
        (qp.row_lower, qp.row_upper, qp.lower, qp.upper),
    )
    solution = BoxRowSolution(x, status, residual, iterations, violated, box.warm)
    return solution, y


def _solve_whole(
    settings: _Settings, value: Any, hessian: Any, index: Any, q: Array, C: Array, bounds: Any
) -> Any:
    """Step 3."""
    H, d = hessian if index is None else jax.tree.map(lambda a: a[index], hessian)
    row_lower, row_upper, lower, upper = bounds
    found = solve_rows(
        H / (d[:, None] * d[None]), q, C, row_lower, row_upper, lower, upper, value[0],
        method=settings.row_method,
        tolerance=settings.tolerance,
        max_iterations=settings.max_iterations,
    )  # fmt: skip
    worst = jnp.maximum(jnp.maximum(found.primal, found.dual), found.gap)
    return found.x, found.multipliers, found.status, worst, value[4] + found.iterations


@_differentiable.defjvp
@full_precision
def _derivative(settings: _Settings, primals: Any, tangents: Any) -> tuple[Any, Any]:
    (qp,), (d_qp,) = primals, tangents
    # An index has no tangent.
    change = d_qp._replace(which=qp.which)
    box, d_box = jax.jvp(
        lambda p, q, lower, upper: _solve_box(
            settings, qp._replace(prepared=p, q=q, lower=lower, upper=upper)
        ),
        (qp.prepared, qp.q, qp.lower, qp.upper),
        (change.prepared, change.q, change.lower, change.upper),
    )
    solution, y = _with_rows(settings, box, qp)
    d = qp.prepared.scale if qp.which is None else qp.prepared.scale[qp.which]
    units = d[:, None] * d[None]
    data, change = (one._replace(H=one.H / units) for one in (qp.stacked(), change.stacked()))
    good = solution.violated & (solution.status <= Status.ITERATION_LIMIT)
    x = solution.x
    equations = active_equations(data, x, y, good)
    equations, y, x = jax.lax.stop_gradient((equations, y, x))
    n, M = qp.q.shape[0], y.shape[0]
    # dx = by_dual r_dual + by_primal r_primal; the matrices are made for members that need them.
    empty = jnp.zeros((n, n), qp.q.dtype), jnp.zeros((n, M), qp.q.dtype)
    by_dual, by_primal = where_needed(good, _inverse, empty, equations.H, equations.A)
    r_dual, r_primal = equations.right_sides(change, x, y)
    dx = (by_dual @ r_dual + by_primal @ r_primal) * equations.unit_x
    dx = jnp.where(solution.violated, jnp.where(good, dx, 0.0), d_box.x)
    return solution, jax.tree.map(no_tangent, solution)._replace(x=dx)


def _inverse(empty: Any, H: Array, A: Array) -> tuple[Array, Array]:
    """Dx of ``solve_equations`` by every entry of r_dual and of r_primal."""
    by_dual, by_primal = (jnp.eye(part.shape[1], dtype=H.dtype) for part in empty)
    columns = jax.vmap(lambda r, s: solve_equations(H, A, r, s)[0], out_axes=1)
    return (
        columns(by_dual, jnp.zeros((len(by_dual), len(by_primal)), H.dtype)),
        columns(jnp.zeros((len(by_primal), len(by_dual)), H.dtype), by_primal),
    )
