"""Proofs that a problem with rows has no solution: no feasible point, or no lower end.

Both come from strictly convex problems with H = I, which the dual active-set method solves without
regard to how H and q are conditioned:

1. The feasible point of least norm. If there is none, multipliers y with A^T y = 0 and a negative
   support sum(y_+ high - y_- low) prove it (Farkas).
2. The projection d of -q onto the directions of descent that nothing stops: H d = 0, and A d within
   the recession cone of the rows. q^T d = -|d|^2, so d is zero exactly where the problem has a
   lower end.

What is found is checked before it counts.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.qp.active_set import farkas, solve_active_set
from kjax.qp.factor import factorise
from kjax.qp.row_problem import RowProblem


class Verdict(NamedTuple):
    """Outcome of ``classify``.

    Attributes:
      infeasible: no point keeps rows and box.
      unbounded: a point does, and the cost has no lower end.
      x: (n,) a feasible point where there is one, else the least infeasible so far.
    """

    infeasible: Bool[Array, ""]
    unbounded: Bool[Array, ""]
    x: Float[Array, "n"]


def classify(problem: RowProblem, good: Array) -> Verdict:
    """Whether the scaled problem is infeasible, unbounded, or neither can be proven."""
    n, m = problem.q.shape[0], problem.C.shape[0]
    dtype = problem.q.dtype
    length = jnp.linalg.norm(problem.H, axis=1, keepdims=True)
    curved = length[:, 0] > 0
    # The rows of H stand between those of C and the box in both problems, so that one loop does.
    rows = jnp.concatenate([problem.C, problem.H / jnp.where(length > 0, length, 1.0)])
    zero, never = jnp.zeros((n,), dtype), jnp.zeros((n,), bool)

    def between(whole: Array, extra: Array) -> Array:
        return jnp.concatenate([whole[:m], extra, whole[m:]])

    none = jnp.zeros_like(problem.low)
    low, high = between(problem.low, zero), between(problem.high, zero)
    at_zero = between(none, zero)
    kinds = (
        (zero, low, high, between(problem.equal, never)),
        (problem.q, at_zero, at_zero, between(problem.equal, curved)),
    )
    q, low, high, equal = (jnp.stack(parts) for parts in zip(*kinds, strict=True))
    has_low, has_high = (between(has, never) for has in (problem.has_low, problem.has_high))

    def solve(q: Array, low: Array, high: Array, equal: Array) -> tuple[Array, ...]:
        one = RowProblem(
            H=jnp.eye(n, dtype=dtype), q=q, C=rows, low=low, high=high,
            has_low=has_low, has_high=has_high, equal=equal,
        )  # fmt: skip
        eps, limit = float(jnp.finfo(dtype).eps), 10 * (2 * n + m)
        found = solve_active_set(one, factorise(one.H), good, eps, limit)
        return found.x, found.infeasible, farkas(one, found)

    # No vmap: a loop of two is one compiled body as well, and neither waits for the other.
    x, failed, proof = jax.lax.map(lambda parts: solve(*parts), (q, low, high, equal))
    y = jnp.concatenate([proof[0, :m], proof[0, m + n :]])
    infeasible = good & failed[0] & proves_infeasible(problem, y)
    unbounded = good & ~failed[0] & is_feasible(problem, x[0]) & is_descent(problem, x[1])
    return Verdict(infeasible, unbounded, x[0])


def proves_infeasible(problem: RowProblem, y: Float[Array, "M"]) -> Bool[Array, ""]:
    """Whether multipliers y prove that no point of reasonable size keeps all rows (Farkas)."""
    m, n, eps = problem.C.shape[0], problem.q.shape[0], float(jnp.finfo(problem.q.dtype).eps)
    low, high = problem.bounds()
    y = y / jnp.maximum(jnp.max(jnp.abs(y), initial=0.0), jnp.finfo(y.dtype).tiny)
    y = jnp.where(jnp.where(y > 0, high < jnp.inf, low > -jnp.inf), y, 0.0)
    # What A^T y leaves is taken up by the box, where it has a side to do so.
    left = -(problem.C.T @ y[:m])
    closed = jnp.where(jnp.where(left > 0, high[m:] < jnp.inf, low[m:] > -jnp.inf), left, 0.0)
    y = jnp.concatenate([y[:m], closed])
    terms = jnp.where(y > 0, y * high, jnp.where(y < 0, y * low, 0.0))
    # x is about 1 in these coordinates; beyond this many times that nothing is claimed.
    reach = eps**-0.4
    rest = reach * jnp.sum(jnp.abs(left - closed))
    margin = 100.0 * n * eps * jnp.sum(jnp.abs(terms))
    return jnp.sum(terms) + rest + margin < 0


def is_feasible(problem: RowProblem, x: Float[Array, "n"]) -> Bool[Array, ""]:
    """Whether a point keeps all rows to within rounding."""
    return problem.errors(x, jnp.zeros_like(problem.low))[0] < jnp.finfo(x.dtype).eps ** 0.6


def is_descent(problem: RowProblem, d: Float[Array, "n"]) -> Bool[Array, ""]:
    """Whether the cost falls along d for ever, and every row lets it."""
    n, eps = d.shape[0], float(jnp.finfo(d.dtype).eps)
    size = jnp.max(jnp.abs(d))
    d = d / jnp.where(size > 0, size, 1.0)
    rounding = 100.0 * n * eps
    flat = (jnp.abs(problem.H @ d) <= rounding * jnp.max(jnp.abs(problem.H), initial=0.0)).all()
    along = problem.rows(d)
    kept = jnp.where(problem.has_low | problem.equal, along >= -rounding, True)
    kept &= jnp.where(problem.has_high | problem.equal, along <= rounding, True)
    return flat & kept.all() & (problem.q @ d < -(eps**0.6) * (jnp.abs(problem.q) @ jnp.abs(d)))
