"""The QP with general rows in the coordinates that its solvers work in.

M = m + n rows, the box after those of C. Here H has a unit diagonal, every row of C unit length and
q unit size, so a common factor of H and q, or another unit of x, changes nothing. Fixed variables
are taken out.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class RowProblem(NamedTuple):
    """Scaled problem; the box's rows follow those of C."""

    H: Float[Array, "n n"]
    q: Float[Array, "n"]
    C: Float[Array, "m n"]
    low: Float[Array, "M"]
    high: Float[Array, "M"]
    has_low: Bool[Array, "M"]
    has_high: Bool[Array, "M"]
    equal: Bool[Array, "M"]

    def rows(self, x: Array) -> Array:
        """Values (m + n,) of rows and box."""
        return jnp.concatenate([self.C @ x, x])

    def adjoint(self, y: Array) -> Array:
        """Transposed rows times multipliers (m + n,)."""
        m = self.C.shape[0]
        return self.C.T @ y[:m] + y[m:]

    def gram(self, w: Array) -> Array:
        """Transposed rows times weights (m + n,) times rows."""
        m = self.C.shape[0]
        return (self.C.T * w[:m]) @ self.C + jnp.diag(w[m:])


class RowScaling(NamedTuple):
    """From the scaled problem back to the caller's.

    Attributes:
      x: (n,) x = x_hat * x + at.
      multipliers: (m + n,) of the rows and the box.
      at: (n,) values of the fixed variables, 0 elsewhere.
      fixed: (n,) variables whose bounds are equal.
    """

    x: Float[Array, "n"]
    multipliers: Float[Array, "M"]
    at: Float[Array, "n"]
    fixed: Bool[Array, "n"]


def scale_rows(
    H: Float[Array, "n n"],
    q: Float[Array, "n"],
    C: Float[Array, "m n"],
    low: Float[Array, "M"],
    high: Float[Array, "M"],
) -> tuple[RowProblem, RowScaling]:
    """Scaled problem of finite data with consistent bounds; H symmetric."""
    m = C.shape[0]
    eps = jnp.finfo(q.dtype).eps
    diagonal = jnp.diagonal(H)
    largest = jnp.maximum(jnp.max(jnp.abs(diagonal)), jnp.finfo(q.dtype).tiny)
    d = 1.0 / jnp.sqrt(jnp.where(diagonal > eps * largest, diagonal, largest))
    fixed = low[m:] == high[m:]
    at = jnp.where(fixed, low[m:], 0.0)
    # Fixed variables leave: their columns act through q and the rows' bounds, and they keep a unit
    # diagonal of their own.
    free = ~fixed
    linear = jnp.where(free, q + H @ at, 0.0)
    C_free = C * d * free
    length = jnp.linalg.norm(C_free, axis=1)
    row = 1.0 / jnp.where(length > 0, length, 1.0)
    unit = jnp.max(jnp.abs(linear * d))
    unit = jnp.where(unit > 0, unit, 1.0)  # of x_hat, and so of everything
    shift = jnp.concatenate([C @ at, at])
    scale = jnp.concatenate([row, 1.0 / d]) / unit
    low_hat, high_hat = (low - shift) * scale, (high - shift) * scale
    # An empty row, or a fixed variable, leaves nothing to decide there.
    off = jnp.concatenate([length == 0, fixed])
    equal = (low == high) & ~off
    problem = RowProblem(
        H=H * (d[:, None] * d) * (free[:, None] & free) + jnp.diag(fixed.astype(d.dtype)),
        q=linear * d / unit,
        C=C_free * row[:, None],
        low=jnp.where(jnp.isfinite(low_hat), low_hat, 0.0),
        high=jnp.where(jnp.isfinite(high_hat), high_hat, 0.0),
        has_low=jnp.isfinite(low_hat) & ~equal & ~off,
        has_high=jnp.isfinite(high_hat) & ~equal & ~off,
        equal=equal,
    )
    return problem, RowScaling(
        x=d * unit,
        multipliers=unit * jnp.concatenate([row, 1.0 / d]),
        at=at,
        fixed=fixed,
    )


def residuals(problem: RowProblem, x: Float[Array, "n"], y: Float[Array, "M"]) -> Float[Array, "3"]:
    """Primal, dual and gap of a point and its multipliers, relative; see ``RowSolution``."""
    value = problem.rows(x)
    below = jnp.where(problem.has_low | problem.equal, problem.low - value, 0.0)
    above = jnp.where(problem.has_high | problem.equal, value - problem.high, 0.0)
    violation = jnp.maximum(jnp.max(below, initial=0.0), jnp.max(above, initial=0.0))
    Hx, push = problem.H @ x, problem.adjoint(y)
    largest = jnp.stack([jnp.max(jnp.abs(a)) for a in (Hx, problem.q, push)]).max()
    # A multiplier at a side that does not exist is as wrong as its size.
    low, high = problem.has_low, problem.has_high
    wrong = jnp.where(problem.equal, 0.0, jnp.where(low, 0.0, jnp.maximum(-y, 0.0)))
    wrong += jnp.where(problem.equal, 0.0, jnp.where(high, 0.0, jnp.maximum(y, 0.0)))
    # The true complementarity: slacks of the rows as they are, not an iterate's own.
    gap = jnp.sum(jnp.where(low, jnp.maximum(-y, 0.0) * jnp.abs(value - problem.low), 0.0))
    gap += jnp.sum(jnp.where(high, jnp.maximum(y, 0.0) * jnp.abs(problem.high - value), 0.0))
    size = jnp.abs(x @ Hx) + jnp.abs(problem.q @ x)
    return jnp.stack(
        [
            violation / jnp.maximum(jnp.max(jnp.abs(value)), 1.0),
            (jnp.max(jnp.abs(Hx + problem.q + push)) + jnp.max(wrong)) / jnp.maximum(largest, 1.0),
            gap / jnp.maximum(size, 1.0),
        ]
    )
