"""``solve_rows``: the QP with general rows, by either method, with its derivatives.

    minimise  1/2 x^T H x + q^T x   subject to  row_lower <= C x <= row_upper,
                                                lower <= x <= upper,

H free to change from call to call: nothing is prepared. The derivative is that of the active rows
(implicit function theorem). Where a row is weakly active it is that of one side, and where active
rows depend on one another the multipliers' is one of several; ``RowSolution.margin`` tells how near
the former is.
"""

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float, Int

from kjax.qp.active_set import take_in_rows
from kjax.qp.interior import descend_central_path
from kjax.qp.problem import Status, no_tangent
from kjax.qp.row_problem import residuals, scale_rows

RowMethod = Literal["interior_point", "active_set"]
ROW_METHODS: tuple[RowMethod, ...] = ("interior_point", "active_set")


class RowSolution(NamedTuple):
    """Result of ``solve_rows``; m rows, n variables.

    Attributes:
      x: (n,) minimiser, within the box where that is consistent.
      multipliers: (m + n,) y of the rows and of the box: H x + q + C^T y_rows + y_box = 0,
        positive at upper, negative at lower bounds.
      status: a ``Status``.
      primal: largest violation of a row or bound, relative to the largest of them, scaled [-].
      dual: residual of the equation above, relative to its largest term, scaled [-].
      gap: complementarity sum, relative to the size of the objective's terms [-].
      margin: smallest of every active side's |multiplier| and every other side's slack, scaled;
        where it is near 0 a row is weakly active [-].
      iterations: spent.
    """

    x: Float[Array, "n"]
    multipliers: Float[Array, "m+n"]
    status: Int[Array, ""]
    primal: Float[Array, ""]
    dual: Float[Array, ""]
    gap: Float[Array, ""]
    margin: Float[Array, ""]
    iterations: Int[Array, ""]


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
    *,
    method: RowMethod = "interior_point",
    tolerance: float = 1e-9,
    max_iterations: int = 100,
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
      method: ``"interior_point"``, or ``"active_set"``: exact, faster where few rows are active,
        and it proves infeasibility.
      tolerance: on primal, dual and gap; in effect not below 20 times the rounding of q's type [-].
      max_iterations: bound on the iterations.

    Returns:
      A ``RowSolution``. An infeasible problem ends as ``INFEASIBLE`` or at the iteration limit,
      with a primal residual that tells; faulty data gives its status and a finite point, never a
      hang. ``x`` and ``multipliers`` have derivatives by all data; with faulty data these are zero.
    """
    if method not in ROW_METHODS:
        raise ValueError(f"method must be one of {sorted(ROW_METHODS)}, got {method!r}")
    if max_iterations < 1:
        raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be above 0, got {tolerance}")
    settings = _Settings(method, tolerance, max_iterations)
    return _differentiable(settings, H, q, C, row_lower, row_upper, lower, upper)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(settings: _Settings, *data: Array) -> RowSolution:
    return _solve(settings, *data)


@_differentiable.defjvp
def _derivative(settings: _Settings, primals: Any, tangents: Any) -> tuple[Any, Any]:
    H, q, C, row_lower, row_upper, lower, upper = primals
    dH, dq, dC, d_row_lower, d_row_upper, d_lower, d_upper = tangents
    solution = _differentiable(settings, *primals)
    x, y = solution.x, solution.multipliers
    n, m = q.shape[0], C.shape[0]
    good = solution.status <= Status.ITERATION_LIMIT
    low, high = jnp.concatenate([row_lower, lower]), jnp.concatenate([row_upper, upper])
    d_low, d_high = jnp.concatenate([d_row_lower, d_lower]), jnp.concatenate([d_row_upper, d_upper])

    diagonal = jnp.abs(jnp.diagonal(H))
    largest = jnp.maximum(jnp.max(diagonal), jnp.finfo(q.dtype).tiny)
    d = 1.0 / jnp.sqrt(jnp.where(diagonal > jnp.finfo(q.dtype).eps * largest, diagonal, largest))
    A = jnp.concatenate([C, jnp.eye(n, dtype=q.dtype)])
    length = jnp.linalg.norm(A * d, axis=1)
    length = jnp.where(length > 0, length, 1.0)
    # A side is active where its multiplier, in units of the objective, outweighs its slack.
    value = A @ x
    unit = jnp.maximum(jnp.max(jnp.abs(q * d)), jnp.finfo(q.dtype).tiny)
    force, scale = jnp.abs(y) * length / unit, length * unit
    at_low = (y < 0) & (force > jnp.abs(value - low) / scale)
    at_high = (y > 0) & (force > jnp.abs(value - high) / scale)
    active = (at_low | at_high | (low == high)) & good
    rows = jnp.where(active[:, None], A * d / length[:, None], 0.0)
    wanted = jnp.where(at_low | ((low == high) & (y < 0)), d_low, d_high)
    shift = wanted - jnp.concatenate([dC @ x, jnp.zeros_like(dq)])
    shift = jnp.where(active, shift, 0.0) / length
    push = d * (0.5 * (dH + dH.T) @ x + dq + dC.T @ y[:m])
    scaled = 0.5 * (H + H.T) * d[:, None] * d
    scaled = jnp.where(good, scaled, jnp.eye(n, dtype=q.dtype))
    dx, dy = _equations(jax.lax.stop_gradient(scaled), jax.lax.stop_gradient(rows), push, shift)
    still = jax.tree.map(no_tangent, solution)
    return solution, still._replace(
        x=jnp.where(good, dx * d, 0.0), multipliers=jnp.where(active, dy / length, 0.0)
    )


def _equations(H: Array, rows: Array, push: Array, shift: Array) -> tuple[Array, Array]:
    """dx, dy of  H dx + rows^T dy = -push,  rows dx = shift, where rows not active are zero.

    Augmented Lagrangian: one Cholesky of H + rows^T rows / eps^(1/2), then a few steps, each of
    which brings sqrt(eps); rows that depend on one another share their multipliers evenly.
    """
    n = H.shape[0]
    stiff = float(jnp.finfo(H.dtype).eps) ** -0.5
    ridge = 10.0 * n * float(jnp.finfo(H.dtype).eps)
    factor = cho_factor(H + stiff * rows.T @ rows + ridge * jnp.eye(n, dtype=H.dtype), lower=True)
    dx, dy = jnp.zeros_like(push), jnp.zeros_like(shift)
    for _ in range(4):
        miss = rows @ dx - shift
        error = push + H @ dx + rows.T @ (dy + stiff * miss)
        step = -cho_solve(factor, error)
        dx = dx + step
        dy = dy + stiff * (miss + rows @ step)
    return dx, dy


def _solve(
    settings: _Settings,
    H: Array,
    q: Array,
    C: Array,
    row_lower: Array,
    row_upper: Array,
    lower: Array,
    upper: Array,
) -> RowSolution:
    n, m = q.shape[0], C.shape[0]
    eps = float(jnp.finfo(q.dtype).eps)
    tolerance = max(settings.tolerance, 20.0 * eps)
    low, high = jnp.concatenate([row_lower, lower]), jnp.concatenate([row_upper, upper])
    readable = jnp.stack([jnp.isfinite(a).all() for a in (H, q, C)]).all()
    readable = readable & ~(jnp.isnan(low) | jnp.isnan(high)).any()
    consistent = ((low <= high) & (low < jnp.inf) & (high > -jnp.inf)).all()
    sound = readable & consistent
    symmetric = jnp.where(sound, 0.5 * (H + H.T), jnp.eye(n, dtype=H.dtype))
    problem, scaling = scale_rows(
        symmetric,
        jnp.where(sound, q, 0.0),
        jnp.where(sound, C, 0.0),
        jnp.where(sound, low, -jnp.inf),
        jnp.where(sound, high, jnp.inf),
    )
    infeasible = jnp.zeros((), bool)
    if settings.method == "interior_point":
        ridge = 10.0 * n * eps * jnp.eye(n, dtype=q.dtype)
        definite = jnp.isfinite(jnp.linalg.cholesky(problem.H + ridge)).all()
        x_hat, y_hat, error, count = descend_central_path(
            problem,
            sound & definite,
            tolerance=tolerance,
            max_iterations=settings.max_iterations,
        )
    else:
        found = take_in_rows(
            problem, sound, tolerance=0.1 * tolerance, max_iterations=settings.max_iterations
        )
        x_hat, y_hat, count = found.x, found.multipliers, found.iterations
        definite, infeasible = found.definite, found.infeasible
        error = residuals(problem, x_hat, y_hat)
    good = sound & definite

    solved = jnp.max(error) <= tolerance
    status = jnp.select(
        [~readable, ~consistent, ~definite, infeasible & ~solved, ~solved],
        [
            Status.NON_FINITE,
            Status.INFEASIBLE_BOUNDS,
            Status.NOT_POSITIVE_DEFINITE,
            Status.INFEASIBLE,
            Status.ITERATION_LIMIT,
        ],
        Status.SOLVED,
    )
    inner = jnp.where(consistent & ~jnp.isnan(lower), lower, -jnp.inf)
    outer = jnp.where(consistent & ~jnp.isnan(upper), upper, jnp.inf)
    x = jnp.clip(jnp.where(good, x_hat * scaling.x, 0.0) + scaling.at, inner, outer)
    y = jnp.where(good, y_hat * scaling.multipliers, 0.0)
    # What holds a fixed variable in place is the rest of its equation.
    held = -(symmetric @ x + jnp.where(sound, q, 0.0) + jnp.where(sound, C, 0.0).T @ y[:m])
    error = jnp.where(good, error, jnp.inf)
    value = problem.rows(x_hat)
    below = jnp.where(problem.has_low, jnp.maximum(value - problem.low, -y_hat), jnp.inf)
    above = jnp.where(problem.has_high, jnp.maximum(problem.high - value, y_hat), jnp.inf)
    margin = jnp.min(jnp.minimum(below, above), initial=jnp.inf)
    return RowSolution(
        x=x,
        multipliers=jnp.concatenate([y[:m], jnp.where(scaling.fixed & good, held, y[m:])]),
        status=status.astype(jnp.int32),
        primal=error[0],
        dual=error[1],
        gap=error[2],
        margin=jnp.where(good, margin, 0.0),
        iterations=count,
    )
