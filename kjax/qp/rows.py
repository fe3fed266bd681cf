"""``solve_rows``: the QP with general rows, by any of the methods, with its derivatives.

    minimise  1/2 x^T H x + q^T x   subject to  row_lower <= C x <= row_upper,
                                                lower <= x <= upper,

H free to change from call to call: nothing is prepared.

1. Scale; a row that no free variable can move is judged by its constant side.
2. Solve by the method. ``"auto"`` takes the active set, and the interior point where H is not
   positive definite (or rounding has defeated the active set).
3. Judge the point as it is returned, clipped, in the caller's units (``kkt_errors``).
4. What is not solved may be proven infeasible or unbounded (``qp.certificates``).

The derivative is that of the active rows (implicit function theorem). Where a row is weakly active
it is that of one side, and where active rows depend on one another the multipliers' is one of
several; ``RowSolution.margin`` tells how near the former is.
"""

from enum import IntEnum
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax.qp.active_set import ActiveSet, farkas, solve_active_set
from kjax.qp.batching import where_needed
from kjax.qp.certificates import Verdict, classify, proves_infeasible
from kjax.qp.interior import descend_central_path
from kjax.qp.polish import polish, solve_equations
from kjax.qp.problem import Status, no_tangent
from kjax.qp.row_derivative import active_equations
from kjax.qp.row_problem import (
    RowProblem,
    RowScaling,
    contradicts,
    kkt_errors,
    scale_rows,
    snapped,
)
from kjax.qp.splitting import solve_splitting

RowMethod = Literal["auto", "active_set", "interior_point", "admm"]
ROW_METHODS: tuple[RowMethod, ...] = ("auto", "active_set", "interior_point", "admm")


class MethodUsed(IntEnum):
    """Which method a ``RowSolution`` comes from."""

    ACTIVE_SET = 0
    INTERIOR_POINT = 1
    ADMM = 2


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


class _Settings(NamedTuple):
    method: RowMethod
    tolerance: float
    max_iterations: int


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
    if max_iterations < 1:
        raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be above 0, got {tolerance}")
    settings = _Settings(method, tolerance, max_iterations)
    warm = None if warm is None else jax.lax.stop_gradient(warm)
    return _differentiable(settings, warm, H, q, C, row_lower, row_upper, lower, upper)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(settings: _Settings, warm: Array | None, *data: Array) -> RowSolution:
    return _solve(settings, warm, *data)


@_differentiable.defjvp
def _derivative(settings: _Settings, primals: Any, tangents: Any) -> tuple[Any, Any]:
    _, H, q, C, row_lower, row_upper, lower, upper = primals
    _, dH, dq, dC, d_row_lower, d_row_upper, d_lower, d_upper = tangents
    solution = _differentiable(settings, *primals)
    low, high = jnp.concatenate([row_lower, lower]), jnp.concatenate([row_upper, upper])
    d_low, d_high = jnp.concatenate([d_row_lower, d_lower]), jnp.concatenate([d_row_upper, d_upper])
    good = solution.status <= Status.ITERATION_LIMIT
    x, y = solution.x, solution.multipliers
    equations = jax.lax.stop_gradient(active_equations(H, q, C, low, high, x, y, good))
    right = equations.right_sides(dH, dq, dC, d_low, d_high, x, y)
    dx, dy = solve_equations(equations.H, equations.A, *right)
    still = jax.tree.map(no_tangent, solution)
    return solution, still._replace(
        x=jnp.where(good, dx * equations.unit_x, 0.0),
        multipliers=jnp.where(equations.active, dy * equations.unit_y, 0.0),
    )


class _Data(NamedTuple):
    """The caller's problem, faulty data replaced; H symmetric, the box's bounds last."""

    H: Array
    q: Array
    C: Array
    low: Array
    high: Array
    good: Array


class _Found(NamedTuple):
    """What a method hands back: the point in the caller's units, and what is known of it.

    Attributes:
      x: (n,) point, clipped.
      y: (m + n,) multipliers.
      error: (3,) ``kkt_errors``.
      margin: see ``RowSolution``.
      usable: whether H is such that the method can be used.
      infeasible: whether that is proven.
      iterations: spent.
      method: a ``MethodUsed``.
    """

    x: Array
    y: Array
    error: Array
    margin: Array
    usable: Array
    infeasible: Array
    iterations: Array
    method: Array

    def solved(self, tolerance: float) -> Array:
        return jnp.max(self.error) <= tolerance


def _solve(
    settings: _Settings,
    warm: Array | None,
    H: Array,
    q: Array,
    C: Array,
    row_lower: Array,
    row_upper: Array,
    lower: Array,
    upper: Array,
) -> RowSolution:
    n = q.shape[0]
    tolerance = max(settings.tolerance, 20.0 * float(jnp.finfo(q.dtype).eps))
    low, high = jnp.concatenate([row_lower, lower]), jnp.concatenate([row_upper, upper])
    finite = jnp.stack([jnp.isfinite(a).all() for a in (H, q, C)]).all()
    finite = finite & ~(jnp.isnan(low) | jnp.isnan(high)).any()
    consistent = ((low <= high) & (low < jnp.inf) & (high > -jnp.inf)).all()
    sound = finite & consistent
    data = _Data(
        jnp.where(sound, 0.5 * (H + H.T), jnp.eye(n, dtype=H.dtype)),
        jnp.where(sound, q, 0.0),
        jnp.where(sound, C, 0.0),
        jnp.where(sound, low, -jnp.inf),
        jnp.where(sound, high, jnp.inf),
        sound,
    )
    # step 1; the active set wants curvature everywhere, and needs no other units then
    by_curvature = settings.method in ("auto", "active_set")
    problem, scaling = scale_rows(*data[:5], equilibrate=not by_curvature)
    inner = settings._replace(tolerance=tolerance)
    if settings.method == "interior_point":  # step 2
        found = _by_interior_point(inner, problem, scaling, data)
    elif settings.method == "admm":
        found = _by_splitting(inner, problem, scaling, data, warm)
    else:
        found = _by_active_set(inner, problem, scaling, data)
    if settings.method == "auto":
        defeated = ~found.solved(tolerance) & (found.iterations < settings.max_iterations)
        found = where_needed(
            data.good & (~found.usable | (defeated & ~found.infeasible)),
            partial(_better_by_interior_point, inner),
            found,
            data,
        )
    solved = found.solved(tolerance)
    verdict = Verdict(found.infeasible, jnp.zeros((), bool), found.x)
    if settings.method != "active_set":  # step 4; it proves infeasibility as it goes
        verdict = where_needed(
            data.good & found.usable & ~solved & ~found.infeasible,
            partial(_classified, tolerance),
            verdict,
            data,
        )
    status = jnp.select(
        [
            ~finite,
            ~consistent,
            ~found.usable,
            solved,
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
    usable = data.good & found.usable
    # Whatever the data, the point is finite and inside the bounds that make sense.
    inside, outside = (
        jnp.where(consistent & ~jnp.isnan(bound), bound, end)
        for bound, end in ((lower, -jnp.inf), (upper, jnp.inf))
    )
    x = jnp.where(usable, jnp.where(verdict.unbounded, verdict.x, found.x), scaling.at)
    x = jnp.clip(jnp.where(jnp.isfinite(x), x, 0.0), inside, outside)
    error = jnp.where(usable, found.error, jnp.inf)
    y = jnp.where(usable & jnp.isfinite(found.y), found.y, 0.0)
    return RowSolution(
        x=x,
        multipliers=y,
        status=status.astype(jnp.int32),
        primal=error[0],
        dual=error[1],
        gap=error[2],
        margin=jnp.where(usable, found.margin, 0.0),
        iterations=found.iterations,
        method=found.method,
    )


def _by_active_set(
    settings: _Settings, problem: RowProblem, scaling: RowScaling, data: _Data
) -> _Found:
    state, definite = solve_active_set(
        problem, data.good, 0.1 * settings.tolerance, settings.max_iterations
    )
    found = _judge(
        problem, scaling, data, state.x, state.multipliers,
        state.bound_status > 0, state.bound_status < 0, usable=definite | ~data.good,
        infeasible=state.infeasible, iterations=state.iterations, method=MethodUsed.ACTIVE_SET,
    )  # fmt: skip

    def proven(_: Array, state: ActiveSet, problem: Any, scaling: Any, data: Any) -> Array:
        claimed = state.infeasible & proves_infeasible(problem, farkas(problem, state))
        return claimed | contradicts(scaling, data.C, data.low, data.high, settings.tolerance)

    needed = data.good & definite & ~found.solved(settings.tolerance)
    infeasible = where_needed(needed, proven, jnp.zeros((), bool), state, problem, scaling, data)
    return found._replace(infeasible=infeasible)


def _by_interior_point(
    settings: _Settings, problem: RowProblem, scaling: RowScaling, data: _Data
) -> _Found:
    usable = _semidefinite(problem) | ~data.good
    x, y, count = descend_central_path(
        problem,
        data.good & usable,
        tolerance=0.5 * settings.tolerance,
        max_iterations=settings.max_iterations,
    )
    return _judge_or_polish(
        settings, problem, scaling, data, x, y, usable=usable, infeasible=jnp.zeros((), bool),
        iterations=count, method=MethodUsed.INTERIOR_POINT,
    )  # fmt: skip


def _by_splitting(
    settings: _Settings, problem: RowProblem, scaling: RowScaling, data: _Data, warm: Array | None
) -> _Found:
    usable = _semidefinite(problem) | ~data.good
    if warm is not None:
        warm = jnp.where(jnp.isfinite(warm), warm - scaling.at, 0.0) / scaling.x
        warm = jnp.where(scaling.fixed, 0.0, warm)
    result = solve_splitting(
        problem,
        data.good & usable,
        warm,
        tolerance=0.5 * settings.tolerance,
        max_iterations=settings.max_iterations,
    )
    return _judge_or_polish(
        settings, problem, scaling, data, result.x, result.multipliers, usable=usable,
        infeasible=result.infeasible, iterations=result.iterations, method=MethodUsed.ADMM,
    )  # fmt: skip


def _better_by_interior_point(settings: _Settings, old: _Found, data: _Data) -> _Found:
    problem, scaling = scale_rows(*data[:5])
    new = _by_interior_point(settings, problem, scaling, data)
    new = new._replace(iterations=old.iterations + new.iterations)
    keep = old.usable & (jnp.max(old.error) <= jnp.max(new.error))
    return jax.tree.map(lambda a, b: jnp.where(keep, a, b), old, new)


def _classified(tolerance: float, old: Verdict, data: _Data) -> Verdict:
    del old
    problem, scaling = scale_rows(*data[:5])
    verdict = classify(problem, data.good)
    m = data.C.shape[0]
    x = jnp.clip(verdict.x * scaling.x + scaling.at, data.low[m:], data.high[m:])
    contradicted = contradicts(scaling, data.C, data.low, data.high, tolerance)
    return Verdict(verdict.infeasible | contradicted, verdict.unbounded & ~contradicted, x)


def _semidefinite(problem: RowProblem) -> Array:
    """Whether H is positive semidefinite to working precision."""
    n, eps = problem.q.shape[0], float(jnp.finfo(problem.q.dtype).eps)
    size = jnp.max(jnp.abs(problem.H), initial=0.0)
    H = problem.H / jnp.where(size > 0, size, 1.0)
    ridge = 10.0 * n * eps * jnp.eye(n, dtype=H.dtype)
    return jnp.isfinite(jnp.linalg.cholesky(H + ridge)).all()


def _judge_or_polish(
    settings: _Settings,
    problem: RowProblem,
    scaling: RowScaling,
    data: _Data,
    x: Array,
    y: Array,
    *,
    usable: Array,
    infeasible: Array,
    iterations: Array,
    method: MethodUsed,
) -> _Found:
    """The judged point; polished on its active rows where it is not good enough as it is."""
    never = jnp.zeros_like(problem.has_low)
    found = _judge(
        problem, scaling, data, x, y, never, never,
        usable=usable, infeasible=infeasible, iterations=iterations, method=method,
    )  # fmt: skip

    def polished(old: _Found, problem: Any, scaling: Any, data: Any, x: Array, y: Array) -> _Found:
        fine = _judge(
            problem, scaling, data, *polish(problem, x, y), usable=old.usable,
            infeasible=old.infeasible, iterations=old.iterations, method=method,
        )  # fmt: skip
        better = jnp.max(fine.error) < jnp.max(old.error)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), fine, old)

    needed = data.good & usable & ~found.solved(settings.tolerance)
    return where_needed(needed, polished, found, problem, scaling, data, x, y)


def _judge(
    problem: RowProblem,
    scaling: RowScaling,
    data: _Data,
    x_hat: Array,
    y_hat: Array,
    at_low: Array,
    at_high: Array,
    *,
    usable: Array,
    infeasible: Array,
    iterations: Array,
    method: MethodUsed,
) -> _Found:
    """Step 3. A bound that is active (``at_low``, ``at_high``) is kept to the last bit."""
    m = data.C.shape[0]
    lower, upper = data.low[m:], data.high[m:]
    x = jnp.clip(snapped(x_hat) * scaling.x + scaling.at, lower, upper)
    x = jnp.where(at_low[m:], lower, jnp.where(at_high[m:], upper, x))
    y = y_hat * scaling.multipliers
    y = jnp.where(jnp.concatenate([scaling.immovable, jnp.zeros_like(scaling.fixed)]), 0.0, y)
    d = jnp.where(scaling.fixed, 0.0, scaling.x)
    error, y, value = kkt_errors(
        data.H, data.q, data.C, data.low, data.high, d, scaling.values, x, y
    )
    force = y / scaling.multipliers
    slack_low, slack_high = (
        (value - data.low) / scaling.values,
        (data.high - value) / scaling.values,
    )
    below = jnp.where(problem.has_low, jnp.maximum(slack_low, -force), jnp.inf)
    above = jnp.where(problem.has_high, jnp.maximum(slack_high, force), jnp.inf)
    return _Found(
        x=x,
        y=y,
        error=error,
        margin=jnp.min(jnp.minimum(below, above), initial=jnp.inf),
        usable=usable,
        infeasible=infeasible,
        iterations=iterations,
        method=jnp.asarray(method, jnp.int32),
    )
