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

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax.qp.batching import while_any


class Pivoted(NamedTuple):
    """Outcome of ``pivot``.

    Attributes:
      table: (n, n) T.
      side: (n,) -1 at the lower bound, 0 free, 1 at the upper bound.
      y: (n,) x of the free variables, g - q of the others.
      exchanges: number made.
    """

    table: Float[Array, "n n"]
    side: Int[Array, "n"]
    y: Float[Array, "n"]
    exchanges: Int[Array, ""]

    def point(self, lower: Array, upper: Array) -> Array:
        """The point (n,), within its bounds."""
        at = jnp.where(self.side < 0, lower, upper)
        return jnp.clip(jnp.where(self.side == 0, self.y, at), lower, upper)


def pivot(
    table: Float[Array, "n n"],
    side: Int[Array, "n"],
    q: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    *,
    threshold: Float[Array, ""],
    limit: int | Int[Array, ""],
) -> Pivoted:
    """Exchange variables until none is further off than ``threshold``, or ``limit`` is reached.

    Args:
      table: swept on the variables whose ``side`` is 0.
      side: guess; a variable must not be at an infinite bound.
      q: linear term.
      lower: bounds; equal ones fix their variable.
      upper: bounds.
      threshold: of a bound's violation or a gradient's wrong sign.
      limit: of the exchanges.
    """
    zero = jnp.zeros((), jnp.int32)
    state = _State(table, side, q, at=zero, more=jnp.ones((), bool), exchanges=zero)
    problem = (q, lower, upper, threshold, jnp.asarray(limit, jnp.int32))
    state = while_any(lambda state: state.more, _exchange, _look(state, *problem), *problem)
    return Pivoted(table=state.table, side=state.side, y=state.y, exchanges=state.exchanges)


class _State(NamedTuple):
    """``at`` is the variable to exchange next, if there is ``more`` to do."""

    table: Array
    side: Array
    y: Array
    at: Array
    more: Array
    exchanges: Array


def _look(
    state: _State, q: Array, lower: Array, upper: Array, threshold: Array, limit: Array
) -> _State:
    """Which variable is furthest off its conditions."""
    n, dtype = q.shape[0], q.dtype
    free, fixed = state.side == 0, lower >= upper
    y = state.table @ jnp.where(free, -q, jnp.where(state.side < 0, lower, upper))
    off = jnp.where(
        free, jnp.maximum(lower - y, y - upper), jnp.sign(state.side).astype(dtype) * (y + q)
    )
    off = jnp.where(fixed, jnp.where(free, jnp.inf, -jnp.inf), off)
    # Murty's rule as a priority: above every violation, and higher for higher indices.
    by_index = jnp.finfo(dtype).max * (jnp.arange(n) + 1).astype(dtype) / (2 * n)
    off = jnp.where((state.exchanges > 3 * n) & (off > threshold), by_index, off)
    at = jnp.argmax(off).astype(jnp.int32)
    more = state.more & (off[at] > threshold) & (state.exchanges < limit)
    return state._replace(y=y, at=at, more=more)


def _exchange(
    state: _State, q: Array, lower: Array, upper: Array, threshold: Array, limit: Array
) -> _State:
    """The state after the exchange of ``at``; the same one if there is none to do."""
    table, side, y, at, more, count = state
    n, dtype = q.shape[0], q.dtype
    here = (jnp.arange(n, dtype=jnp.int32) == at) & more
    unit = here.astype(dtype)
    sign = jnp.where(side == 0, 1.0, -1.0).astype(dtype)
    row = unit @ table  # a product, not table[at]: XLA would index inside the update's inner loop
    # The tableau is symmetric but for the signs between free and bound variables.
    column = row * (sign * sign[at])
    divisor = jnp.where(more, 1.0 / jnp.where(more, row[at], 1.0), 0.0)
    table = table - ((column + unit) * divisor)[:, None] * (row - unit)[None, :]
    there = jnp.where((y < lower) | (lower >= upper), -1, 1).astype(side.dtype)
    side = jnp.where(here, jnp.where(side == 0, there, 0), side)
    moved = state._replace(table=table, side=side, exchanges=count + more)
    return _look(moved, q, lower, upper, threshold, limit)
