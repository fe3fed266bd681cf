"""Primal-dual interior point on the scaled problem of ``qp.rows``: Mehrotra's predictor-corrector.

Slacks of every finite side; rows with equal bounds are equations. Memory and time are those of one
dense Cholesky of H + C^T W C per iteration, and some ten iterations are usual. H may be singular.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from kjax.qp.row_problem import RowProblem, residuals


class _Point(NamedTuple):
    """Iterate: point, slacks and duals of the lower and upper sides, duals of the equations."""

    x: Float[Array, "n"]
    s_low: Float[Array, "M"]
    s_high: Float[Array, "M"]
    z_low: Float[Array, "M"]
    z_high: Float[Array, "M"]
    y: Float[Array, "M"]


def descend_central_path(
    problem: RowProblem, good: Array, *, tolerance: float, max_iterations: int
) -> tuple[Float[Array, "n"], Float[Array, "M"], Float[Array, "3"], Int[Array, ""]]:
    """Best point, its multipliers, its residuals and the iterations spent; nothing if not good."""
    n = problem.q.shape[0]
    # A ridge far below the tolerance lets a singular H through.
    ridge = float(10.0 * n * jnp.finfo(problem.q.dtype).eps)
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

    _, best, error, _, count, _ = jax.lax.while_loop(
        unfinished, advance, (start, start, first, first, jnp.zeros((), jnp.int32), good)
    )
    return best.x, _multipliers(best), error, count


def _factor(problem: RowProblem, weight: Array, ridge: float) -> Array:
    """L^-1 of H + C^T W C = L L^T with a relative ridge, which refinement makes up for.

    Products with the inverse factor cost a tenth of XLA's triangular solves on a CPU.
    """
    K = problem.H + problem.gram(weight)
    factor = jnp.linalg.cholesky(K + ridge * jnp.diag(1.0 + jnp.diagonal(K)))
    return solve_triangular(factor, jnp.eye(K.shape[0], dtype=K.dtype), lower=True)


def _solve(half: Array, right: Array) -> Array:
    return half.T @ (half @ right)


def _start(problem: RowProblem) -> _Point:
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
    x = _solve(factor, problem.adjoint(weight * middle) - problem.q)
    value = problem.rows(x)

    def side(slack: Array, has: Array) -> tuple[Array, Array]:
        return jnp.where(has, jnp.maximum(slack, 0.1), 1.0), has.astype(slack.dtype)

    s_low, z_low = side(value - problem.low, problem.has_low)
    s_high, z_high = side(problem.high - value, problem.has_high)
    return _Point(x, s_low, s_high, z_low, z_high, y=jnp.zeros_like(value))


def _multipliers(point: _Point) -> Array:
    return point.z_high - point.z_low + point.y


def _residuals(problem: RowProblem, point: _Point) -> Array:
    return residuals(problem, point.x, _multipliers(point))


def _iterate(problem: RowProblem, point: _Point, ridge: float) -> tuple[_Point, Array]:
    """One predictor-corrector step; the flag tells whether it could be taken."""
    low, high, equal = problem.has_low, problem.has_high, problem.equal
    s_low, s_high, z_low, z_high = point[1:5]
    value = problem.rows(point.x)
    dual = problem.H @ point.x + problem.q + problem.adjoint(_multipliers(point))
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
        dx = _solve(factor, right)
        # One refinement: the weights spread over many decades near the solution.
        error = right - (problem.H @ dx + problem.adjoint(weight * problem.rows(dx)))
        dx = dx + _solve(factor, error)
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
