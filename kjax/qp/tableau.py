"""Principal pivoting on a swept tableau: an exact active-set method without factorisations.

With F the free variables and B those at a bound, H x + q = g splits into

    [ x_F     ]       [ -q_F ]            [ H_FF^-1            -H_FF^-1 H_FB               ]
    [ g_B-q_B ] = T * [  x_B ],      T =  [ H_BF H_FF^-1   H_BB - H_BF H_FF^-1 H_FB ].

A guess of F is right if x_F keeps its bounds and g_B presses against them. If not, the variable
that is furthest off changes sides, which changes T by one outer product (Beaton's sweep). The next
tick's problem differs in q alone, so its guess is the last F and its tableau the last T: some two
exchanges, often none. Should the rule "furthest off" go round in circles, Murty's rule (always the
last index) ends after finitely many, since H is positive definite.

Everything here is in the Jacobi-scaled coordinates of ``qp.problem``, in which x and g compare.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax.qp.batching import while_any


class Pivoted(NamedTuple):
    """Outcome of ``pivot``.

    Attributes:
      table: (n, n) T.
      bound_status: (n,) -1 at the lower bound, 0 free, 1 at the upper bound.
      y: (n,) x of the free variables, g - q of the others.
      exchanges: number made.
    """

    table: Float[Array, "n n"]
    bound_status: Int[Array, "n"]
    y: Float[Array, "n"]
    exchanges: Int[Array, ""]

    def point(self, lower: Array, upper: Array) -> Array:
        """The point (n,), within its bounds."""
        at = jnp.where(self.bound_status < 0, lower, upper)
        return jnp.clip(jnp.where(self.bound_status == 0, self.y, at), lower, upper)


def pivot(
    table: Float[Array, "n n"],
    bound_status: Int[Array, "n"],
    q: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    *,
    threshold: tuple[Array, Array],
    limit: int | Int[Array, ""],
) -> Pivoted:
    """Exchange variables until none is further off than ``threshold``, or ``limit`` is reached.

    Args:
      table: swept on the variables whose ``bound_status`` is 0.
      bound_status: guess; a variable must not be at an infinite bound.
      q: linear term.
      lower: bounds; equal ones fix their variable.
      upper: bounds.
      threshold: of a bound's violation, and of a gradient's wrong sign; () or (n,) each.
      limit: of the exchanges.
    """
    zero = jnp.zeros((), jnp.int32)
    state = _State(table, bound_status, q, pivot=zero, pending=jnp.ones((), bool), exchanges=zero)
    tiny = float(jnp.finfo(q.dtype).tiny)
    weights = tuple(1.0 / jnp.maximum(part, tiny) for part in threshold)
    problem: tuple[Any, ...] = (q, lower, upper, weights, jnp.asarray(limit, jnp.int32))
    state = while_any(lambda state: state.pending, _exchange, _choose(state, *problem), *problem)
    return Pivoted(
        table=state.table, bound_status=state.bound_status, y=state.y, exchanges=state.exchanges
    )


class _State(NamedTuple):
    """``pivot`` is the variable to exchange next, if one is ``pending``."""

    table: Array
    bound_status: Array
    y: Array
    pivot: Array
    pending: Array
    exchanges: Array


def _choose(
    state: _State, q: Array, lower: Array, upper: Array, weight: Any, limit: Array
) -> _State:
    """Which variable violates its conditions most."""
    n, dtype = q.shape[0], q.dtype
    bound_status = state.bound_status
    free, fixed = bound_status == 0, lower >= upper
    y = state.table @ jnp.where(free, -q, jnp.where(bound_status < 0, lower, upper))
    violation = jnp.where(
        free, jnp.maximum(lower - y, y - upper), jnp.sign(bound_status).astype(dtype) * (y + q)
    )
    violation = violation * jnp.where(free, weight[0], weight[1])
    violation = jnp.where(fixed, jnp.where(free, jnp.inf, -jnp.inf), violation)
    # Murty's rule as a priority: above every violation, and higher for higher indices.
    by_index = jnp.finfo(dtype).max * (jnp.arange(n) + 1).astype(dtype) / (2 * n)
    violation = jnp.where((state.exchanges > 3 * n) & (violation > 1.0), by_index, violation)
    pivot = jnp.argmax(violation).astype(jnp.int32)
    pending = state.pending & (violation[pivot] > 1.0) & (state.exchanges < limit)
    return state._replace(y=y, pivot=pivot, pending=pending)


def _exchange(
    state: _State, q: Array, lower: Array, upper: Array, weight: Any, limit: Array
) -> _State:
    """The state after the exchange of the pivot; the same one if none is pending."""
    table, bound_status, y, pivot, pending, count = state
    n, dtype = q.shape[0], q.dtype
    is_pivot = (jnp.arange(n, dtype=jnp.int32) == pivot) & pending
    unit = is_pivot.astype(dtype)
    sign = jnp.where(bound_status == 0, 1.0, -1.0).astype(dtype)
    row = (
        unit @ table
    )  # a product, not table[pivot]: XLA would index inside the update's inner loop
    # The tableau is symmetric but for the signs between free and bound variables.
    column = row * (sign * sign[pivot])
    divisor = jnp.where(pending, 1.0 / jnp.where(pending, row[pivot], 1.0), 0.0)
    table = table - ((column + unit) * divisor)[:, None] * (row - unit)[None, :]
    new_status = jnp.where((y < lower) | (lower >= upper), -1, 1).astype(bound_status.dtype)
    bound_status = jnp.where(is_pivot, jnp.where(bound_status == 0, new_status, 0), bound_status)
    next_state = state._replace(table=table, bound_status=bound_status, exchanges=count + pending)
    return _choose(next_state, q, lower, upper, weight, limit)
