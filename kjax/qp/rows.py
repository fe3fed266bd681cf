"""``solve_rows``: the QP with general rows, by any of the methods, with its derivatives.

    minimise  1/2 x^T H x + q^T x   subject to  row_lower <= C x <= row_upper,
                                                lower <= x <= upper,

H free to change from call to call: nothing is prepared.

1. Scale; a row that no free variable can move is judged by its constant side.
2. Solve by the method. The active set comes after the unconstrained minimiser, where that breaks
   a row. ``"auto"`` takes it, and the interior point where H is not positive definite (or rounding
   has defeated the active set).
3. Judge the point as it is returned, clipped, in the caller's units (``kkt_errors``).
4. What is not solved may be proven infeasible or unbounded (``qp.certificates``).

The derivative is that of the active rows (implicit function theorem). Where a row is weakly active
it is that of one side, and where active rows depend on one another the multipliers' is one of
several; ``RowSolution.margin`` tells how near the former is.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax.precision import full_precision
from kjax.qp.batching import where_needed
from kjax.qp.certificates import Verdict
from kjax.qp.factor import Factor
from kjax.qp.polish import solve_equations
from kjax.qp.problem import Status, no_tangent
from kjax.qp.row_derivative import active_equations
from kjax.qp.row_methods import (
    ROW_METHODS,
    Evidence,
    Found,
    Posed,
    RowMethod,
    RowSettings,
    better_by_interior_point,
    by_active_set,
    by_interior_point,
    by_splitting,
    classified,
    pose,
    proven_by_active_set,
    without_rows,
)
from kjax.qp.row_problem import RowData


class RowSolution(NamedTuple):
    """Result of ``solve_rows``; m rows, n variables.

    Attributes:
      x: (n,) minimiser, within the box where that is consistent; finite whatever the status.
      multipliers: (m + n,) y of the rows and of the box: H x + q + C^T y_rows + y_box = 0,
        positive at upper, negative at lower bounds.
      status: a ``Status``.
      primal: largest violation of a row or bound, relative to |bound| + |C| |x| [-].
      dual: residual of the equation above, each entry relative to its own terms [-].
      gap: sum of |multiplier| slack, relative to the terms of the cost [-].
      margin: smallest of every active side's |multiplier| and every other side's slack, scaled;
        where it is near 0 a row is weakly active [-].
      iterations: spent.
      method: a ``MethodUsed``.
    """

    x: Float[Array, "n"]
    multipliers: Float[Array, "m+n"]
    status: Int[Array, ""]
    primal: Float[Array, ""]
    dual: Float[Array, ""]
    gap: Float[Array, ""]
    margin: Float[Array, ""]
    iterations: Int[Array, ""]
    method: Int[Array, ""]


@full_precision
def solve_rows(
    H: Float[Array, "n n"],
    q: Float[Array, "n"],
    C: Float[Array, "m n"],
    row_lower: Float[Array, "m"],
    row_upper: Float[Array, "m"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    warm: Float[Array, "n"] | None = None,
    *,
    method: RowMethod = "auto",
    tolerance: float = 1e-9,
    max_iterations: int | None = None,
) -> RowSolution:
    """Minimiser of 1/2 x^T H x + q^T x within rows and box; see the module's head.

    Eleven arguments: the problem's seven matrices as in any QP library, and options by keyword.

    Args:
      H: (n, n) positive semidefinite, for ``"active_set"`` definite; its symmetric part is used.
      q: (n,) linear term.
      C: (m, n) rows; m may be 0.
      row_lower: (m,) lower bounds of C x, ``-inf`` for none, equal to the upper for an equation.
      row_upper: (m,) upper bounds of C x.
      lower: (n,) lower bounds of x, equal to the upper to fix a variable.
      upper: (n,) upper bounds of x.
      warm: (n,) point that ``"admm"`` starts from; the others do not use it.
      method: ``"auto"``, or one of ``"active_set"`` (exact, fast where few rows are active),
        ``"interior_point"`` and ``"admm"``.
      tolerance: on primal, dual and gap; in effect not below 20 times the rounding of q's type [-].
      max_iterations: bound on the iterations; ``None`` for 4000 of ADMM, 100 of the others.

    Returns:
      A ``RowSolution``. A problem that is proven to have no solution ends as ``INFEASIBLE`` or
      ``UNBOUNDED``; faulty data gives its status and a finite point, never a hang. ``x`` and
      ``multipliers`` have derivatives by all data; these are zero unless the problem was solved, or
      ended at the iteration limit.
    """
    if method not in ROW_METHODS:
        raise ValueError(f"method must be one of {sorted(ROW_METHODS)}, got {method!r}")
    if max_iterations is None:
        max_iterations = 4000 if method == "admm" else 100
    settings = RowSettings(method, tolerance, max_iterations).checked()
    warm = None if warm is None else jax.lax.stop_gradient(warm)
    return _differentiable(settings, warm, _Qp(H, q, C, row_lower, row_upper, lower, upper))


class _Qp(NamedTuple):
    """The caller's problem, or a change of it."""

    H: Array
    q: Array
    C: Array
    row_lower: Array
    row_upper: Array
    lower: Array
    upper: Array

    def stacked(self) -> RowData:
        """Bounds of rows and box in one."""
        low = jnp.concatenate([self.row_lower, self.lower])
        high = jnp.concatenate([self.row_upper, self.upper])
        return RowData(self.H, self.q, self.C, low, high)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(settings: RowSettings, warm: Array | None, qp: _Qp) -> RowSolution:
    return solve_data(settings, warm, qp.stacked())


@_differentiable.defjvp
@full_precision
def _derivative(settings: RowSettings, primals: Any, tangents: Any) -> tuple[Any, Any]:
    warm, qp = primals
    _, d_qp = tangents
    solution = _differentiable(settings, warm, qp)
    return solution, derivative(solution, qp.stacked(), d_qp.stacked())


def derivative(solution: RowSolution, data: RowData, change: RowData) -> RowSolution:
    """Change of a solution with its data, by the rows that are active."""
    good = solution.status <= Status.ITERATION_LIMIT
    x, y = solution.x, solution.multipliers
    equations = jax.lax.stop_gradient(active_equations(data, x, y, good))
    dx, dy = solve_equations(equations.H, equations.A, *equations.right_sides(change, x, y))
    still = jax.tree.map(no_tangent, solution)
    return still._replace(
        x=jnp.where(good, dx * equations.unit_x, 0.0),
        multipliers=jnp.where(equations.active, dy * equations.unit_y, 0.0),
    )


def solve_data(settings: RowSettings, warm: Array | None, asked: RowData) -> RowSolution:
    """``solve_rows`` of a problem whose bounds are stacked, without derivatives."""
    settings = settings.reachable(asked.q.dtype)
    data, good, finite, consistent = _checked(asked)
    # step 1; the active set wants curvature everywhere, and needs no other units then
    by_curvature = settings.method in ("auto", "active_set")
    posed = pose(data, good, equilibrate=not by_curvature)
    more: Callable[..., tuple[Found, Verdict]] = _unsolved
    args: tuple[Any, ...] = (posed.data, posed.good)
    if settings.method == "interior_point":  # steps 2 and 3
        found = by_interior_point(settings, posed)
    elif settings.method == "admm":
        found = by_splitting(settings, posed, warm)
    else:
        found, factor = without_rows(posed)
        more, args = _constrained, (posed, factor)
    # One branch for all that an unsolved problem needs: each costs a call more than a microsecond.
    verdict = Verdict(jnp.zeros((), bool), jnp.zeros((), bool), found.x)
    found, verdict = where_needed(
        _unfinished(settings, found, posed.good),
        partial(more, settings),
        (found, verdict),
        *args,
    )
    status = jnp.select(
        [
            ~finite,
            ~consistent,
            ~found.usable,
            found.solved(settings.tolerance),
            verdict.infeasible,
            verdict.unbounded,
        ],
        [
            Status.NON_FINITE,
            Status.INFEASIBLE_BOUNDS,
            Status.NOT_POSITIVE_DEFINITE,
            Status.SOLVED,
            Status.INFEASIBLE,
            Status.UNBOUNDED,
        ],
        Status.ITERATION_LIMIT,
    )
    usable = posed.good & found.usable
    x = jnp.where(usable, jnp.where(verdict.unbounded, verdict.x, found.x), posed.scaling.at)
    error = jnp.where(usable, found.error, jnp.inf)
    return RowSolution(
        x=_inside(x, asked, consistent),
        multipliers=jnp.where(usable & jnp.isfinite(found.y), found.y, 0.0),
        status=status.astype(jnp.int32),
        primal=error[0],
        dual=error[1],
        gap=error[2],
        margin=jnp.where(usable, found.margin, 0.0),
        iterations=found.iterations,
        method=found.method,
    )


def _checked(data: RowData) -> tuple[RowData, Array, Array, Array]:
    """Symmetric data, harmless where faulty; whether it is good, finite, of consistent bounds."""
    H, q, C, low, high = data
    finite = jnp.stack([jnp.isfinite(a).all() for a in (H, q, C)]).all()
    finite = finite & ~(jnp.isnan(low) | jnp.isnan(high)).any()
    consistent = ((low <= high) & (low < jnp.inf) & (high > -jnp.inf)).all()
    good = finite & consistent
    safe = RowData(
        jnp.where(good, 0.5 * (H + H.T), jnp.eye(q.shape[0], dtype=H.dtype)),
        jnp.where(good, q, 0.0),
        jnp.where(good, C, 0.0),
        jnp.where(good, low, -jnp.inf),
        jnp.where(good, high, jnp.inf),
    )
    return safe, good, finite, consistent


def _inside(x: Array, asked: RowData, consistent: Array) -> Array:
    """A finite point inside the bounds that make sense, whatever the data."""
    m = asked.C.shape[0]
    inside, outside = (
        jnp.where(consistent & ~jnp.isnan(bound), bound, end)
        for bound, end in ((asked.low[m:], -jnp.inf), (asked.high[m:], jnp.inf))
    )
    return jnp.clip(jnp.where(jnp.isfinite(x), x, 0.0), inside, outside)


def _unfinished(settings: RowSettings, found: Found, good: Array) -> Array:
    """Whether a good problem has no solution yet."""
    return good & ~(found.usable & found.solved(settings.tolerance))


def _constrained(
    settings: RowSettings, old: tuple[Found, Verdict], posed: Posed, factor: Factor
) -> tuple[Found, Verdict]:
    """The active set, for what the unconstrained minimiser does not solve."""
    found, evidence = by_active_set(settings, posed, factor)
    return where_needed(
        _unfinished(settings, found, posed.good),
        partial(_unsolved, settings),
        (found, old[1]._replace(x=found.x)),
        posed.data,
        posed.good,
        evidence,
    )


def _unsolved(
    settings: RowSettings,
    old: tuple[Found, Verdict],
    data: RowData,
    good: Array,
    evidence: Evidence | None = None,
) -> tuple[Found, Verdict]:
    """Another method for what ``"auto"`` has not solved, then step 4."""
    found, verdict = old
    infeasible = found.infeasible
    if evidence is not None:
        infeasible = proven_by_active_set(settings, found, evidence, data)
    if settings.method == "auto":
        defeated = found.iterations < settings.max_iterations
        found = where_needed(
            ~found.usable | (defeated & ~infeasible),
            partial(better_by_interior_point, settings),
            found,
            data,
            good,
        )
    verdict = verdict._replace(infeasible=infeasible)
    if settings.method != "active_set":
        verdict = where_needed(
            found.usable & ~found.solved(settings.tolerance) & ~infeasible,
            partial(classified, settings.tolerance),
            verdict,
            data,
            good,
        )
    return found, verdict
