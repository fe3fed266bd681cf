"""Primal-dual interior point (Mehrotra 1992) on the scaled problem of ``qp.row_problem``.

Every finite side has a slack s and a multiplier z; rows with equal bounds are equations with
multiplier y. H may be singular.

1. Start at the point nearest to the middle of all bounds, s and z clear of zero.
2. Stop where the residuals of the point, clipped to the box, are within the tolerance; they are
   looked at once s z is small.
3. Predictor: Newton's step towards s z = 0; mu_affine is what it would leave of mu.
4. Corrector: Newton's step towards s z = sigma mu, sigma = (mu_affine / mu)^3, with the
   predictor's second-order term.
5. Go 0.99 or more of the way to the boundary, and to step 2.

Memory and time are those of one dense Cholesky of H + C^T W C per iteration; some ten are usual.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax.qp.batching import where_needed
from kjax.qp.lapack import cholesky, inverse_of_lower
from kjax.qp.row_problem import RowProblem

NEAR = 1e6  # tolerances of the complementarity from which on points are judged


class _Point(NamedTuple):
    """Iterate: point, slacks and duals of the lower and upper sides, duals of the equations."""

    x: Float[Array, "n"]
    s_low: Float[Array, "M"]
    s_high: Float[Array, "M"]
    z_low: Float[Array, "M"]
    z_high: Float[Array, "M"]
    y: Float[Array, "M"]


def solve_interior_point(
    problem: RowProblem, good: Array, *, tolerance: float, max_iterations: int
) -> tuple[Float[Array, "n"], Float[Array, "M"], Int[Array, ""]]:
    """Best point, its multipliers and the iterations spent; nothing is done if not good."""
    n = problem.q.shape[0]
    # A ridge far below the tolerance lets a singular H through.
    ridge = float(10.0 * n * jnp.finfo(problem.q.dtype).eps)
    start = _start(problem)  # step 1
    never = jnp.full((), jnp.inf, problem.q.dtype)

    def unfinished(carry: Any) -> Array:  # step 2
        _, _, error, count, moving = carry
        return ~(error <= tolerance) & (count < max_iterations) & moving

    def advance(carry: Any) -> Any:
        point, best, error, count, _ = carry
        next_point, ok = _iterate(problem, point, ridge)
        # Far from complementary it cannot be the solution, and judging costs a fifth of a step.
        near = _complementarity(problem, next_point) <= NEAR * tolerance
        new = where_needed(near, lambda _, *args: _error(*args), never, problem, next_point)
        better = ok & ((new < error) | jnp.isinf(error))  # the last one, until one is judged
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), next_point, best)
        return next_point, best, jnp.where(better, new, error), count + 1, ok

    _, best, _, count, _ = jax.lax.while_loop(
        unfinished, advance, (start, start, never, jnp.zeros((), jnp.int32), good)
    )
    return best.x, _multipliers(best), count


def _factor(problem: RowProblem, weight: Array, ridge: float) -> Array:
    """L^-1 of H + C^T W C = L L^T with a relative ridge, which refinement makes up for.

    Products with the inverse factor cost a tenth of XLA's triangular solves on a CPU.
    """
    K = problem.H + problem.gram(weight)
    return inverse_of_lower(cholesky(K + ridge * jnp.diag(1.0 + jnp.diagonal(K))))


def _solve(half: Array, right: Array) -> Array:
    return half.T @ (half @ right)


def _start(problem: RowProblem) -> _Point:
    """Step 1."""
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


def _complementarity(problem: RowProblem, point: _Point) -> Array:
    """Sum of slacks times duals."""
    below = jnp.where(problem.has_low, point.s_low * point.z_low, 0.0)
    return jnp.sum(below) + jnp.sum(jnp.where(problem.has_high, point.s_high * point.z_high, 0.0))


def _error(problem: RowProblem, point: _Point) -> Array:
    m = problem.C.shape[0]
    low, high = problem.bounds()
    x = jnp.clip(point.x, low[m:], high[m:])
    return jnp.max(problem.errors(x, _multipliers(point)))


def _iterate(problem: RowProblem, point: _Point, ridge: float) -> tuple[_Point, Array]:
    """Steps 3 to 5; the flag tells whether the step could be taken."""
    low, high, equal = problem.has_low, problem.has_high, problem.equal
    s_low, s_high, z_low, z_high = point[1:5]
    value = problem.rows(point.x)
    r_dual = problem.H @ point.x + problem.q + problem.adjoint(_multipliers(point))
    r_low = jnp.where(low, value - problem.low - s_low, 0.0)
    r_high = jnp.where(high, problem.high - value - s_high, 0.0)
    r_equal = jnp.where(equal, value - problem.low, 0.0)
    # Proximal step of the equations' multipliers: they hold better by sqrt(eps) each time.
    rho = jnp.where(equal, jnp.finfo(value.dtype).eps ** -0.5, 0.0)
    weight = z_low / s_low + z_high / s_high + rho
    factor = _factor(problem, weight, ridge)

    def direction(target_low: Array, target_high: Array, *, refine: bool) -> _Point:
        """Newton's step towards s z = target on either side."""
        push_low = jnp.where(low, (target_low - z_low * r_low) / s_low - z_low, 0.0)
        push_high = jnp.where(high, (target_high - z_high * r_high) / s_high - z_high, 0.0)
        right = -r_dual + problem.adjoint(push_low - push_high - rho * r_equal)
        dx = _solve(factor, right)
        if refine:  # the weights spread over many decades near the solution
            error = right - (problem.H @ dx + problem.adjoint(weight * problem.rows(dx)))
            dx = dx + _solve(factor, error)
        move = problem.rows(dx)
        return _Point(
            x=dx,
            s_low=jnp.where(low, move + r_low, 0.0),
            s_high=jnp.where(high, -move + r_high, 0.0),
            z_low=push_low - jnp.where(low, z_low / s_low * move, 0.0),
            z_high=push_high + jnp.where(high, z_high / s_high * move, 0.0),
            y=rho * (move + r_equal),
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
    mu = _complementarity(problem, point) / count
    # The predictor only tells how far to centre.
    affine = direction(jnp.zeros_like(s_low), jnp.zeros_like(s_high), refine=False)  # step 3
    a = longest(affine)
    mu_affine = (
        jnp.sum(jnp.where(low, (s_low + a * affine.s_low) * (z_low + a * affine.z_low), 0.0))
        + jnp.sum(jnp.where(high, (s_high + a * affine.s_high) * (z_high + a * affine.z_high), 0.0))
    ) / count
    target = mu * jnp.clip(mu_affine / jnp.where(mu > 0, mu, 1.0), 0.0, 1.0) ** 3  # step 4
    step = direction(
        target - affine.s_low * affine.z_low, target - affine.s_high * affine.z_high, refine=True
    )
    a = longest(step)  # step 5
    a = jnp.where(a < 1.0, jnp.maximum(0.99, 1.0 - mu) * a, 1.0)
    next_point = jax.tree.map(lambda v, d: v + a * d, point, step)
    ok = jnp.stack([jnp.isfinite(leaf).all() for leaf in next_point]).all()
    return jax.tree.map(lambda new, old: jnp.where(ok, new, old), next_point, point), ok
