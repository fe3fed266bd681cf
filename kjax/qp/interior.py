"""Primal-dual interior point for a QP with general rows and a box.

    minimise  1/2 x^T H x + q^T x   subject to  row_lower <= C x <= row_upper,
                                                lower <= x <= upper,

H positive semidefinite, and free to change from call to call: nothing is prepared. Mehrotra's
predictor-corrector on slacks of every finite side; rows with equal bounds are equations, variables
with equal bounds are taken out. Memory and time are those of one dense Cholesky of H per iteration,
and some ten iterations are usual.

The problem is solved in coordinates in which H has a unit diagonal, every row of C unit length and
q unit size, so a common factor of H and q, or another unit of x, changes nothing.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int

from kjax.qp.problem import Status


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
      iterations: spent.
    """

    x: Float[Array, "n"]
    multipliers: Float[Array, "m+n"]
    status: Int[Array, ""]
    primal: Float[Array, ""]
    dual: Float[Array, ""]
    gap: Float[Array, ""]
    iterations: Int[Array, ""]


class _Problem(NamedTuple):
    """Scaled problem; the box's rows follow those of C."""

    H: Float[Array, "n n"]
    q: Float[Array, "n"]
    C: Float[Array, "m n"]
    low: Float[Array, "m+n"]
    high: Float[Array, "m+n"]
    has_low: Bool[Array, "m+n"]
    has_high: Bool[Array, "m+n"]
    equal: Bool[Array, "m+n"]

    def rows(self, x: Array) -> Array:
        return jnp.concatenate([self.C @ x, x])

    def adjoint(self, y: Array) -> Array:
        m = self.C.shape[0]
        return self.C.T @ y[:m] + y[m:]

    def gram(self, w: Array) -> Array:
        m = self.C.shape[0]
        return (self.C.T * w[:m]) @ self.C + jnp.diag(w[m:])


class _Point(NamedTuple):
    """Iterate: point, slacks and duals of the lower and upper sides, duals of the equations."""

    x: Float[Array, "n"]
    s_low: Float[Array, "m+n"]
    s_high: Float[Array, "m+n"]
    z_low: Float[Array, "m+n"]
    z_high: Float[Array, "m+n"]
    y: Float[Array, "m+n"]


def solve_rows(
    H: Float[Array, "n n"],
    q: Float[Array, "n"],
    C: Float[Array, "m n"],
    row_lower: Float[Array, "m"],
    row_upper: Float[Array, "m"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    *,
    tolerance: float = 1e-9,
    max_iterations: int = 50,
) -> RowSolution:
    """Minimiser of 1/2 x^T H x + q^T x within rows and box; see the module's head.

    Args:
      H: (n, n) positive semidefinite; its symmetric part is used.
      q: (n,) linear term.
      C: (m, n) rows; m may be 0.
      row_lower: (m,) lower bounds of C x, ``-inf`` for none, equal to the upper for an equation.
      row_upper: (m,) upper bounds of C x.
      lower: (n,) lower bounds of x, equal to the upper to fix a variable.
      upper: (n,) upper bounds of x.
      tolerance: on primal, dual and gap [-].
      max_iterations: bound on the iterations.

    Returns:
      A ``RowSolution``. An infeasible problem ends at the iteration limit with a primal residual
      that tells; faulty data gives its status and a finite point, never a hang.
    """
    if max_iterations < 1:
        raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")
    eps = jnp.finfo(q.dtype).eps
    low, high = jnp.concatenate([row_lower, lower]), jnp.concatenate([row_upper, upper])
    readable = jnp.stack([jnp.isfinite(a).all() for a in (H, q, C)]).all()
    readable = readable & ~(jnp.isnan(low) | jnp.isnan(high)).any()
    consistent = ((low <= high) & (low < jnp.inf) & (high > -jnp.inf)).all()
    sound = readable & consistent
    n, m = q.shape[0], C.shape[0]

    symmetric = jnp.where(sound, 0.5 * (H + H.T), jnp.eye(n, dtype=H.dtype))
    diagonal = jnp.diagonal(symmetric)
    largest = jnp.maximum(jnp.max(jnp.abs(diagonal)), jnp.finfo(q.dtype).tiny)
    d = 1.0 / jnp.sqrt(jnp.where(diagonal > eps * largest, diagonal, largest))
    fixed = (lower == upper) & sound
    at = jnp.where(fixed, lower, 0.0)
    C = jnp.where(sound, C, 0.0)
    # Fixed variables leave: their columns act through q and the rows' bounds, and they keep a unit
    # diagonal of their own.
    free = ~fixed
    linear = jnp.where(free & sound, q + symmetric @ at, 0.0)
    H_free = symmetric * (d[:, None] * d) * (free[:, None] & free) + jnp.diag(fixed.astype(d.dtype))
    C_free = C * d * free
    length = jnp.linalg.norm(C_free, axis=1)
    row = 1.0 / jnp.where(length > 0, length, 1.0)
    unit = jnp.max(jnp.abs(linear * d))
    unit = jnp.where(unit > 0, unit, 1.0)  # of x_hat, and so of everything
    scale = jnp.concatenate([row, 1.0 / d]) / unit
    shift = jnp.concatenate([C @ at, at])
    low_hat, high_hat = (jnp.where(sound, (b - shift) * scale, 0.0) for b in (low, high))
    off = jnp.concatenate([length == 0, fixed])  # nothing left to decide there
    equal = (low_hat == high_hat) & ~off
    problem = _Problem(
        H=H_free,
        q=linear * d / unit,
        C=C_free * row[:, None],
        low=jnp.where(jnp.isfinite(low_hat), low_hat, 0.0),
        high=jnp.where(jnp.isfinite(high_hat), high_hat, 0.0),
        has_low=jnp.isfinite(low_hat) & ~equal & ~off,
        has_high=jnp.isfinite(high_hat) & ~equal & ~off,
        equal=equal,
    )
    # A ridge far below the tolerance lets a singular H through; an indefinite one fails here.
    ridge = float(10.0 * n * eps)
    definite = jnp.isfinite(jnp.linalg.cholesky(H_free + ridge * jnp.eye(n, dtype=d.dtype))).all()

    start = _start(problem)
    first = _residuals(problem, start)

    def unfinished(carry: Any) -> Array:
        _, _, error, _, count, moving = carry
        return (jnp.max(error) > tolerance) & (count < max_iterations) & moving

    def advance(carry: Any) -> Any:
        point, best, error, _, count, _ = carry
        moved, ok = _iterate(problem, point, ridge)
        new = _residuals(problem, moved)
        better = ok & (jnp.max(new) < jnp.max(error))
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), moved, best)
        error = jnp.where(better, new, error)
        return moved, best, error, new, count + 1, ok

    good = sound & definite
    _, best, error, _, count, _ = jax.lax.while_loop(
        unfinished, advance, (start, start, first, first, jnp.zeros((), jnp.int32), good)
    )
    solved = jnp.max(error) <= tolerance
    status = jnp.select(
        [~readable, ~consistent, ~definite, ~solved],
        [
            Status.NON_FINITE,
            Status.INFEASIBLE_BOUNDS,
            Status.NOT_POSITIVE_DEFINITE,
            Status.ITERATION_LIMIT,
        ],
        Status.SOLVED,
    )
    low_safe = jnp.where(consistent & ~jnp.isnan(lower), lower, -jnp.inf)
    high_safe = jnp.where(consistent & ~jnp.isnan(upper), upper, jnp.inf)
    x = jnp.clip(jnp.where(good, best.x * d * unit, 0.0) + at, low_safe, high_safe)
    y = (best.z_high - best.z_low + best.y) * unit * jnp.concatenate([row, 1.0 / d])
    y = jnp.where(good, y, 0.0)
    # What holds a fixed variable in place is the rest of its equation.
    held = -(symmetric @ x + jnp.where(sound, q, 0.0) + C.T @ y[:m])
    error = jnp.where(good, error, jnp.inf)
    return RowSolution(
        x=x,
        multipliers=jnp.concatenate([y[:m], jnp.where(fixed & good, held, y[m:])]),
        status=status.astype(jnp.int32),
        primal=error[0],
        dual=error[1],
        gap=error[2],
        iterations=count,
    )


def _factor(problem: _Problem, weight: Array, ridge: float) -> Any:
    """Cholesky factor of H + C^T W C with a relative ridge, which refinement makes up for."""
    K = problem.H + problem.gram(weight)
    return cho_factor(K + ridge * jnp.diag(1.0 + jnp.diagonal(K)), lower=True)


def _start(problem: _Problem) -> _Point:
    """The point that is nearest to all bounds' middles, slacks and duals clear of zero."""
    one_low, one_high = (
        has & ~other
        for has, other in ((problem.has_low, problem.has_high), (problem.has_high, problem.has_low))
    )
    middle = jnp.select(
        [problem.has_low & problem.has_high, one_low | problem.equal, one_high],
        [0.5 * (problem.low + problem.high), problem.low, problem.high],
    )
    weight = (problem.has_low | problem.has_high | problem.equal).astype(problem.q.dtype)
    factor = _factor(problem, weight, 1e-8)
    x = cho_solve(factor, problem.adjoint(weight * middle) - problem.q)
    value = problem.rows(x)

    def side(slack: Array, has: Array) -> tuple[Array, Array]:
        return jnp.where(has, jnp.maximum(slack, 0.1), 1.0), has.astype(slack.dtype)

    s_low, z_low = side(value - problem.low, problem.has_low)
    s_high, z_high = side(problem.high - value, problem.has_high)
    return _Point(x, s_low, s_high, z_low, z_high, y=jnp.zeros_like(value))


def _dual_residual(problem: _Problem, point: _Point) -> Array:
    y = point.z_high - point.z_low + point.y
    return problem.H @ point.x + problem.q + problem.adjoint(y)


def _residuals(problem: _Problem, point: _Point) -> Float[Array, "3"]:
    """Primal, dual and gap, relative; see ``RowSolution``."""
    value = problem.rows(point.x)
    below = jnp.where(problem.has_low | problem.equal, problem.low - value, 0.0)
    above = jnp.where(problem.has_high | problem.equal, value - problem.high, 0.0)
    violation = jnp.maximum(jnp.max(below, initial=0.0), jnp.max(above, initial=0.0))
    Hx, y = problem.H @ point.x, point.z_high - point.z_low + point.y
    push = problem.adjoint(y)
    largest = jnp.stack([jnp.max(jnp.abs(a)) for a in (Hx, problem.q, push)]).max()
    # The true complementarity: slacks of the rows as they are, not the iterate's own.
    gap = jnp.sum(jnp.where(problem.has_low, point.z_low * jnp.abs(value - problem.low), 0.0))
    gap += jnp.sum(jnp.where(problem.has_high, point.z_high * jnp.abs(problem.high - value), 0.0))
    size = jnp.abs(point.x @ Hx) + jnp.abs(problem.q @ point.x)
    return jnp.stack(
        [
            violation / jnp.maximum(jnp.max(jnp.abs(value)), 1.0),
            jnp.max(jnp.abs(Hx + problem.q + push)) / jnp.maximum(largest, 1.0),
            gap / jnp.maximum(size, 1.0),
        ]
    )


def _iterate(problem: _Problem, point: _Point, ridge: float) -> tuple[_Point, Array]:
    """One predictor-corrector step; the flag tells whether it could be taken."""
    low, high, equal = problem.has_low, problem.has_high, problem.equal
    s_low, s_high, z_low, z_high = point[1:5]
    value = problem.rows(point.x)
    dual = _dual_residual(problem, point)
    miss_low = jnp.where(low, value - problem.low - s_low, 0.0)
    miss_high = jnp.where(high, problem.high - value - s_high, 0.0)
    miss = jnp.where(equal, value - problem.low, 0.0)
    # Proximal step of the equations' multipliers: the equations hold better by sqrt(eps) each time.
    stiff = jnp.where(equal, jnp.finfo(value.dtype).eps ** -0.5, 0.0)
    weight = z_low / s_low + z_high / s_high + stiff
    factor = _factor(problem, weight, ridge)

    def direction(target_low: Array, target_high: Array) -> _Point:
        """Newton's step towards s z = target on either side."""
        push_low = jnp.where(low, (target_low - z_low * miss_low) / s_low - z_low, 0.0)
        push_high = jnp.where(high, (target_high - z_high * miss_high) / s_high - z_high, 0.0)
        right = -dual + problem.adjoint(push_low - push_high - stiff * miss)
        dx = cho_solve(factor, right)
        # One refinement: the weights spread over many decades near the solution.
        error = right - (problem.H @ dx + problem.adjoint(weight * problem.rows(dx)))
        dx = dx + cho_solve(factor, error)
        move = problem.rows(dx)
        return _Point(
            x=dx,
            s_low=jnp.where(low, move + miss_low, 0.0),
            s_high=jnp.where(high, -move + miss_high, 0.0),
            z_low=push_low - jnp.where(low, z_low / s_low * move, 0.0),
            z_high=push_high + jnp.where(high, z_high / s_high * move, 0.0),
            y=stiff * (move + miss),
        )

    def longest(step: _Point) -> Array:
        pairs = (
            (s_low, step.s_low, low),
            (s_high, step.s_high, high),
            (z_low, step.z_low, low),
            (z_high, step.z_high, high),
        )
        ratios = [
            jnp.where(has & (d < 0), -v / jnp.where(d < 0, d, -1.0), jnp.inf) for v, d, has in pairs
        ]
        return jnp.minimum(jnp.min(jnp.stack(ratios), initial=jnp.inf), 1.0)

    count = jnp.maximum(jnp.sum(low) + jnp.sum(high), 1)
    mean = (
        jnp.sum(jnp.where(low, s_low * z_low, 0.0)) + jnp.sum(jnp.where(high, s_high * z_high, 0.0))
    ) / count
    affine = direction(jnp.zeros_like(s_low), jnp.zeros_like(s_high))
    a = longest(affine)
    after = (
        jnp.sum(jnp.where(low, (s_low + a * affine.s_low) * (z_low + a * affine.z_low), 0.0))
        + jnp.sum(jnp.where(high, (s_high + a * affine.s_high) * (z_high + a * affine.z_high), 0.0))
    ) / count
    centre = mean * jnp.clip(after / jnp.where(mean > 0, mean, 1.0), 0.0, 1.0) ** 3
    step = direction(centre - affine.s_low * affine.z_low, centre - affine.s_high * affine.z_high)
    a = longest(step)
    a = jnp.where(a < 1.0, jnp.maximum(0.99, 1.0 - mean) * a, 1.0)
    moved = jax.tree.map(lambda v, d: v + a * d, point, step)
    ok = jnp.stack([jnp.isfinite(leaf).all() for leaf in moved]).all()
    return jax.tree.map(lambda new, old: jnp.where(ok, new, old), moved, point), ok
