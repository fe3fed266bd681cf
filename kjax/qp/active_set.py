"""Dual active-set method (Goldfarb and Idnani 1983) on the scaled problem of ``qp.row_problem``.

Start from the unconstrained minimiser and take in violated rows one by one. With N the normals of
the active rows, each pointing inwards, two matrices are kept,

    P = H^-1 - H^-1 N U,    U = (N^T H^-1 N)^-1 N^T H^-1:

a row with normal a moves x along P a and the multipliers of the active rows by -U a, until it
holds, or until a multiplier is used up and its row leaves first. Either event changes the stack
(P, U) by one outer product, so nothing is factorised after H. The multipliers stay right at every
step and the objective rises, so the method ends; a row that nothing can give way to proves the
problem infeasible. Few active rows, the case of a walking robot, mean few iterations.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from kjax.qp.batching import while_any
from kjax.qp.row_problem import RowProblem


class _State(NamedTuple):
    """Iterate of the method; M = m + n rows, those of the box last.

    Attributes:
      stack: (n + M, n) P, and U with a row per row of the problem, zero where not active.
      x: (n,) point.
      y: (M,) multipliers along the inward normals, not negative but for equations.
      side: (M,) 1 active at the lower side, -1 at the upper one, 0 not active.
      at: row to take in.
      sign: of its inward normal.
      more: whether there is one.
      infeasible: whether a row cannot be made to hold.
      iterations: spent.
    """

    stack: Float[Array, "n+M n"]
    x: Float[Array, "n"]
    y: Float[Array, "M"]
    side: Float[Array, "M"]
    at: Array
    sign: Array
    more: Array
    infeasible: Array
    iterations: Int[Array, ""]


class ActiveSet(NamedTuple):
    """Outcome of ``take_in_rows``.

    Attributes:
      x: (n,) point.
      multipliers: (M,) positive at upper sides.
      definite: whether H is positive definite to working precision; else all this is nothing.
      infeasible: whether no point keeps all rows.
      iterations: rows taken in and put out.
    """

    x: Float[Array, "n"]
    multipliers: Float[Array, "M"]
    definite: Array
    infeasible: Array
    iterations: Int[Array, ""]


def take_in_rows(
    problem: RowProblem, good: Array, *, tolerance: float, max_iterations: int
) -> ActiveSet:
    """Solve the problem; H must be positive definite. Nothing is done if not ``good``.

    Args:
      problem: scaled.
      good: whether it is worth it.
      tolerance: violation of a row, scaled, that is none [-].
      max_iterations: limit on rows taken in and put out.
    """
    n, dtype = problem.q.shape[0], problem.q.dtype
    M = problem.low.shape[0]
    factor = jnp.linalg.cholesky(problem.H)
    pivots = jnp.diagonal(factor)
    definite = (pivots > (n * float(jnp.finfo(dtype).eps)) ** 0.5).all()
    factor = jnp.where(definite, factor, jnp.eye(n, dtype=dtype))
    # An inverse, not solves: products are what XLA does fast.
    half = solve_triangular(factor, jnp.eye(n, dtype=dtype), lower=True)
    inverse = half.T @ half
    zero = jnp.zeros((), jnp.int32)
    state = _State(
        stack=jnp.concatenate([inverse, jnp.zeros((M, n), dtype)]),
        x=-(inverse @ problem.q),
        y=jnp.zeros((M,), dtype),
        side=jnp.zeros((M,), dtype),
        at=zero,
        sign=jnp.ones((), dtype),
        more=good & definite,
        infeasible=jnp.zeros((), bool),
        iterations=zero,
    )
    threshold = max(tolerance, 10.0 * float(jnp.finfo(dtype).eps))
    settings = (threshold, max_iterations)
    state = while_any(
        lambda state: state.more,
        partial(_advance, settings),
        _look(settings, state, problem),
        problem,
        10.0 * float(jnp.finfo(dtype).eps) * jnp.max(jnp.diagonal(inverse)),
    )
    state = _polish(problem, _polish(problem, state))
    y = -state.side * state.y
    return ActiveSet(state.x, y, definite, state.infeasible, state.iterations)


def _look(settings: tuple[float, int], state: _State, problem: RowProblem) -> _State:
    """Which row is violated most."""
    threshold, limit = settings
    value = problem.rows(state.x)
    inactive = state.side == 0
    low = jnp.where((problem.has_low | problem.equal) & inactive, problem.low - value, -jnp.inf)
    high = jnp.where((problem.has_high | problem.equal) & inactive, value - problem.high, -jnp.inf)
    worst = jnp.maximum(low, high)
    # Equations come first, and count even where they hold by chance.
    worst = jnp.where(problem.equal & inactive, jnp.inf, worst)
    at = jnp.argmax(worst).astype(jnp.int32)
    size = jnp.maximum(jnp.max(jnp.abs(value)), 1.0)
    more = (
        state.more & (worst[at] > threshold * size) & (state.iterations < limit) & ~state.infeasible
    )
    sign = jnp.where(low[at] >= high[at], 1.0, -1.0).astype(value.dtype)
    return state._replace(at=at, sign=sign, more=more)


def _advance(
    settings: tuple[float, int], state: _State, problem: RowProblem, rounding: Array
) -> _State:
    """Take in a row, or put out the one that is in its way."""
    n, dtype = problem.q.shape[0], problem.q.dtype
    eps = float(jnp.finfo(dtype).eps)
    more = state.more
    U = state.stack[n:]
    index = jnp.arange(state.y.shape[0], dtype=jnp.int32)
    here = (index == state.at).astype(dtype)
    normal = state.sign * problem.adjoint(here)
    pushed = state.stack @ normal
    z, r = pushed[:n], pushed[n:]
    bend = z @ normal
    wanted = here @ jnp.where(state.sign > 0, problem.low, problem.high)
    miss = state.sign * (wanted - here @ problem.rows(state.x))
    # Rows of equations never leave; their normals may push either way.
    may_leave = (state.side != 0) & ~problem.equal & (r > eps)
    ratio = jnp.where(may_leave, state.y / jnp.where(may_leave, r, 1.0), jnp.inf)
    leaving = jnp.argmin(ratio).astype(jnp.int32)
    until_out = ratio[leaving]
    # A row that depends on the active ones moves nothing: rounding alone is left of its bend.
    depends = bend <= rounding
    until_in = jnp.where(depends, jnp.inf, jnp.maximum(miss, 0.0) / jnp.where(depends, 1.0, bend))
    step = jnp.minimum(until_in, until_out)
    # An equation that follows from others and holds already is not in anyone's way.
    stuck = ~jnp.isfinite(step)
    redundant = stuck & (miss <= 1e3 * eps * n)
    entering = until_in <= until_out
    t = jnp.where(more & ~stuck, step, 0.0)

    x = state.x + jnp.where(depends, 0.0, t) * z
    y = jnp.maximum(state.y - t * r, jnp.where(problem.equal, -jnp.inf, 0.0)) + t * here
    out = (index == leaving).astype(dtype)
    u = out @ U
    Hu = problem.H @ u
    kept = u @ Hu
    # Entering: the new row is active and P loses z. Leaving: P gains u back.
    put_in, put_out = more & ~stuck & entering, more & ~stuck & ~entering
    inwards = jnp.concatenate([z, r - here]) / jnp.where(put_in, bend, 1.0)
    outwards = jnp.concatenate([-u, U @ Hu]) / jnp.where(put_out, kept, 1.0)
    left = jnp.where(put_in, inwards, jnp.where(put_out, outwards, 0.0))
    stack = state.stack - left[:, None] * jnp.where(put_in, z, u)[None, :]
    side = state.side + jnp.where(put_in, state.sign, 0.0) * here
    side = jnp.where(put_out, side * (1.0 - out), side)
    y = jnp.where(put_out, y * (1.0 - out), y)
    moved = state._replace(
        stack=stack,
        x=x,
        y=y,
        side=jnp.where(more & redundant, side + state.sign * here, side),
        infeasible=state.infeasible | (more & stuck & ~redundant),
        iterations=state.iterations + more,
    )
    looked = _look(settings, moved, problem)
    # A row that could not come in yet is tried again.
    again = put_out & (moved.iterations < settings[1])
    return looked._replace(
        at=jnp.where(put_out, state.at, looked.at),
        sign=jnp.where(put_out, state.sign, looked.sign),
        more=jnp.where(put_out, again, looked.more),
    )


def _polish(problem: RowProblem, state: _State) -> _State:
    """A Newton step of the equations that the active rows make, for what rounding has left."""
    n = problem.q.shape[0]
    P, U = state.stack[:n], state.stack[n:]
    force = problem.adjoint(state.side * state.y)
    r = force - problem.H @ state.x - problem.q
    wanted = jnp.where(state.side > 0, problem.low, problem.high)
    gap = jnp.where(state.side != 0, state.side * (wanted - problem.rows(state.x)), 0.0)
    gap = jnp.where(jnp.abs(U).max(axis=1) > 0, gap, 0.0)
    dx = P @ r + U.T @ gap
    return state._replace(x=state.x + dx, y=state.y + U @ (problem.H @ dx - r))
