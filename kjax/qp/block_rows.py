"""Rows that touch one block of variables each, as a foot's force has its own cone.

As a rule none of them is active. Then H alone is factorised, the rows are checked block by block,
and the many zeros of the whole matrix are never written down:

1. The unconstrained minimiser, by Cholesky in the variables' own units.
2. Judged as by ``kkt_errors``: within rows and box, and the slope zero. Then it is the solution.
3. What it does not solve, whatever the reason, goes to the active set with the whole matrix.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from kjax.precision import full_precision
from kjax.qp.batching import where_needed
from kjax.qp.factor import factorise, unconstrained
from kjax.qp.problem import Status
from kjax.qp.row_methods import MethodUsed, RowSettings
from kjax.qp.row_problem import RowData, RowTerms, kkt_errors, largest_violation, variable_units
from kjax.qp.rows import RowSolution, derivative, solve_data

SOLUTION = "qp_solution"  # name of a solution that is differentiated


class BlockRows(NamedTuple):
    """F blocks of b variables, in their order, with r rows each: low <= matrix x <= high.

    Attributes:
      matrix: (F, r, b) rows.
      low: (F, r) lower bounds, ``-inf`` for none.
      high: (F, r) upper bounds.
    """

    matrix: Float[Array, "F r b"]
    low: Float[Array, "F r"]
    high: Float[Array, "F r"]

    def whole(self) -> Float[Array, "m n"]:
        """The rows of all blocks in one matrix (F r, F b)."""
        F, r, b = self.matrix.shape
        spread = jnp.einsum("frb,fg->frgb", self.matrix, jnp.eye(F, dtype=self.matrix.dtype))
        return spread.reshape(F * r, F * b)


class _Qp(NamedTuple):
    """The caller's problem, or a change of it."""

    H: Array
    q: Array
    rows: BlockRows
    lower: Array
    upper: Array

    def stacked(self) -> RowData:
        """With the whole matrix; bounds of rows and box in one."""
        low, high = (
            jnp.concatenate([side.reshape(-1), box])
            for side, box in ((self.rows.low, self.lower), (self.rows.high, self.upper))
        )
        return RowData(self.H, self.q, self.rows.whole(), low, high)


@full_precision
def solve_block_rows(
    H: Float[Array, "n n"],
    q: Float[Array, "n"],
    rows: BlockRows,
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    *,
    tolerance: float = 1e-9,
    max_iterations: int = 100,
) -> RowSolution:
    """Minimiser of 1/2 x^T H x + q^T x within rows of blocks and box, by the active set.

    Args:
      H: (n, n) positive definite; its symmetric part is used.
      q: (n,) linear term.
      rows: of n / b blocks.
      lower: (n,) lower bounds of x, ``-inf`` for none, equal to the upper to fix a variable.
      upper: (n,) upper bounds of x.
      tolerance: on primal, dual and gap; in effect not below 20 times the rounding of q's type [-].
      max_iterations: bound on rows added and dropped.

    Returns:
      A ``RowSolution``, as ``solve_rows`` gives with the whole matrix and ``"active_set"``; its
      multipliers are those of the blocks' rows, then those of the box.

    Raises:
      ValueError: for blocks of another number of variables, or settings that make no sense.
    """
    F, _, b = rows.matrix.shape
    if F * b != q.shape[0]:
        raise ValueError(f"rows: wanted blocks of all {q.shape[0]} variables, got {F} of {b}")
    settings = RowSettings("active_set", tolerance, max_iterations).checked()
    return _differentiable(settings, _Qp(H, q, rows, lower, upper))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(settings: RowSettings, qp: _Qp) -> RowSolution:
    found, solved = _without_rows(settings, qp)
    return where_needed(~solved, partial(_with_rows, settings), found, qp)


@_differentiable.defjvp
@full_precision
def _derivative(settings: RowSettings, primals: Any, tangents: Any) -> tuple[Any, Any]:
    (qp,), (d_qp,) = primals, tangents
    # Who recomputes a loop backward (``jax.checkpoint``) may keep this instead of solving again.
    solution = checkpoint_name(_differentiable(settings, qp), SOLUTION)
    return solution, derivative(solution, qp.stacked(), d_qp.stacked())


def _with_rows(settings: RowSettings, old: RowSolution, qp: _Qp) -> RowSolution:
    """Step 3."""
    del old
    return solve_data(settings, None, qp.stacked())


def _without_rows(settings: RowSettings, qp: _Qp) -> tuple[RowSolution, Bool[Array, ""]]:
    """Steps 1 and 2: the point, and whether it is the solution."""
    settings = settings.reachable(qp.q.dtype)
    H, q, rows, lower, upper = qp
    n, (F, r, b) = q.shape[0], rows.matrix.shape
    H = 0.5 * (H + H.T)
    d = variable_units(H, jnp.zeros((0, n), q.dtype), jnp.ones((n,), bool))
    factor = factorise(H * (d[:, None] * d[None]))
    slope = jnp.max(jnp.abs(q * d))
    x = d * unconstrained(factor, q * d)
    # Expected sizes, as ``scale_rows`` has them where no bound is near.
    d = d * jnp.where(slope > 0, slope / factor.curvature, 1.0)
    box = RowData(H, q, jnp.zeros((0, n), q.dtype), lower, upper)
    error, y, _ = kkt_errors(box, d, d, x, jnp.zeros_like(x))

    size = jnp.abs(rows.matrix)
    terms = RowTerms(
        *(jnp.einsum("frb,fb->fr", M, v.reshape(F, b))
          for M, v in ((rows.matrix, x), (size, jnp.abs(x)), (size, d)))
    )  # fmt: skip
    primal = largest_violation(terms, rows.low, rows.high, jnp.max(jnp.abs(x) / d), n)
    error = error.at[0].max(primal)
    lengths = jnp.linalg.norm(rows.matrix * d.reshape(F, 1, b), axis=-1)
    slacks = [
        jnp.where(unit > 0, jnp.minimum(value - low, high - value) / jnp.where(unit > 0, unit, 1.0),
                  jnp.inf)
        for value, low, high, unit in
        ((terms.value, rows.low, rows.high, lengths), (x, lower, upper, d))
    ]  # fmt: skip
    inside = ((x >= lower) & (x <= upper)).all()
    solved = factor.definite & inside & (jnp.max(error) <= settings.tolerance)
    found = RowSolution(
        x=x,
        multipliers=jnp.concatenate([jnp.zeros((F * r,), q.dtype), y]),
        status=jnp.full((), Status.SOLVED, jnp.int32),
        primal=error[0],
        dual=error[1],
        gap=error[2],
        margin=jnp.minimum(*(jnp.min(slack, initial=jnp.inf) for slack in slacks)),
        iterations=jnp.zeros((), jnp.int32),
        method=jnp.full((), MethodUsed.ACTIVE_SET, jnp.int32),
    )
    return found, solved
