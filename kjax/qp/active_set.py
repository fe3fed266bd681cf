"""Dual active-set method (Goldfarb and Idnani 1983) on the scaled problem of ``qp.row_problem``.

With N the normals of the active rows, each pointing inwards, two matrices are kept,

    P = H^-1 - H^-1 N U,    U = (N^T H^-1 N)^-1 N^T H^-1.

Normals of active rows are independent, so n slots hold whatever rows are active: U has a row per
slot, zero where it is empty.

1. Start from the unconstrained minimiser, no row active.
2. Choose the most violated row, normal a; without one, go to step 5.
3. Ratio test: x moves along P a and the multipliers of the active rows by -U a, until the row
   holds (it is added), or until a multiplier is used up (its row is dropped first). A row that
   nothing can give way to proves the problem infeasible.
4. Either event changes the stack (P, U) by one outer product, so nothing is factorised after H.
   Go to step 2.
5. Polish: a Newton step of the equations that the active rows make, a second one where the first
   was not small. Where the unconstrained minimiser lay far outside, rounding has hidden violations
   that show now: then once more from step 2.

The multipliers stay right at every step and the objective rises, so the method ends. Few active
rows, the case of a legged robot, mean few iterations.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax.qp.batching import where_needed, while_any
from kjax.qp.factor import Factor
from kjax.qp.lapack import inverse_of_lower
from kjax.qp.row_problem import RowProblem

ROUNDS = 3  # of steps 2 to 5; one is usual


class ActiveSet(NamedTuple):
    """Iterate of the method; M = m + n rows, those of the box last.

    Attributes:
      stack: (2 n, n) P, and U with a row per slot.
      slot_row: (n,) row that a slot holds, M where it is empty.
      slot_equal: (n,) whether that is an equation.
      x: (n,) point.
      value: (M,) of the rows at x.
      y: (n,) multipliers of the slots along the inward normals, not negative but for equations.
      bound_status: (M,) 1 active at the lower side, -1 at the upper one, 0 not active.
      chosen: row to add.
      sign: of its inward normal.
      y_chosen: its multiplier so far, above 0 if a row was dropped on the way.
      pending: whether there is one.
      infeasible: whether the chosen row cannot be made to hold.
      rounds: of steps 2 to 5.
      iterations: rows added and dropped.
    """

    stack: Float[Array, "2*n n"]
    slot_row: Int[Array, "n"]
    slot_equal: Bool[Array, "n"]
    x: Float[Array, "n"]
    value: Float[Array, "M"]
    y: Float[Array, "n"]
    bound_status: Float[Array, "M"]
    chosen: Array
    sign: Array
    y_chosen: Array
    pending: Array
    infeasible: Array
    rounds: Int[Array, ""]
    iterations: Int[Array, ""]

    @property
    def multipliers(self) -> Float[Array, "M"]:
        """Multipliers (M,) of the rows, positive at upper sides."""
        return -self.bound_status * self.spread(self.y)

    def spread(self, slots: Float[Array, "n"]) -> Float[Array, "M"]:
        """Values (M,) of the rows, 0 where not active, from those of the slots."""
        return jnp.zeros_like(self.value).at[self.slot_row].add(slots, mode="drop")


class _Settings(NamedTuple):
    tolerance: float
    max_iterations: int
    rounds: int


class _Sizes(NamedTuple):
    """Sizes that a problem's values are compared with, found once.

    Attributes:
      flat: curvature along a normal that is rounding.
      outside: size of the unconstrained minimiser, roughly.
    """

    flat: Array
    outside: Array


def solve_active_set(
    problem: RowProblem, factor: Factor, good: Array, tolerance: float, max_iterations: int
) -> ActiveSet:
    """The last iterate.

    Where H is not definite, or the problem is not ``good``, nothing is done.

    Args:
      problem: scaled.
      factor: of its H.
      good: whether it is worth it.
      tolerance: violation of a row, relative, that is none [-].
      max_iterations: limit on rows added and dropped.
    """
    n, dtype = problem.q.shape[0], problem.q.dtype
    M = problem.low.shape[0]
    eps = float(jnp.finfo(dtype).eps)
    # An inverse, not solves: products are what XLA does fast.
    half = inverse_of_lower(factor.L)
    inverse = half.T @ half / factor.curvature
    zero = jnp.zeros((), jnp.int32)
    x = -(inverse @ problem.q)
    state = ActiveSet(  # step 1
        stack=jnp.concatenate([inverse, jnp.zeros((n, n), dtype)]),
        slot_row=jnp.full((n,), M, jnp.int32),
        slot_equal=jnp.zeros((n,), bool),
        x=x,
        value=problem.rows(x),
        y=jnp.zeros((n,), dtype),
        bound_status=jnp.zeros((M,), dtype),
        chosen=zero,
        sign=jnp.ones((), dtype),
        y_chosen=jnp.zeros((), dtype),
        pending=good & factor.definite,
        infeasible=jnp.zeros((), bool),
        rounds=zero,
        iterations=zero,
    )
    settings = _Settings(
        tolerance=max(tolerance, 10.0 * eps),
        max_iterations=max_iterations,
        # In float32 what a second round finds is rounding again.
        rounds=ROUNDS if eps < 1e-12 else 1,
    )
    rounding = max(10.0 * eps, min(30.0 * n * eps, 1e-11))
    sizes = _Sizes(
        flat=rounding * jnp.max(jnp.diagonal(inverse)),
        outside=jnp.max(jnp.abs(problem.q)) / factor.curvature,
    )
    return while_any(lambda state: state.pending, partial(_round, settings), state, problem, sizes)


def farkas(problem: RowProblem, state: ActiveSet) -> Float[Array, "M"]:
    """Multipliers (M,) that prove the problem infeasible, if the iterate says that it is.

    The chosen normal is the sum of r times active ones, none of which may give way.
    """
    n = problem.q.shape[0]
    is_chosen = jnp.arange(state.value.shape[0]) == state.chosen
    r = state.spread(state.stack[n:] @ (state.sign * problem.normal(state.chosen)))
    given = jnp.where(problem.equal, r, jnp.minimum(r, 0.0))
    return state.bound_status * given - jnp.where(is_chosen, state.sign, 0.0)


def _round(settings: _Settings, state: ActiveSet, problem: RowProblem, sizes: _Sizes) -> ActiveSet:
    """Steps 2 to 4 until no row is violated, then step 5: pending again if one is violated now."""
    found = while_any(
        lambda state: state.pending,
        partial(_advance, settings),
        _choose(settings, state, problem, sizes),
        problem,
        sizes,
    )
    eps = float(jnp.finfo(problem.q.dtype).eps)
    more = state.pending & (state.rounds < settings.rounds - 1)
    x, y = _polish(problem, found)
    # The next correction is as small beside this one as this one is beside x.
    coarse = jnp.max(jnp.abs(x - found.x)) > eps**0.5 * jnp.max(jnp.abs(x))
    x, y = where_needed(
        coarse,
        lambda point, found, problem: _polish(problem, found._replace(x=point[0], y=point[1])),
        (x, y),
        found,
        problem,
    )
    fine = found._replace(x=x, value=problem.rows(x), y=y, rounds=state.rounds + 1, pending=more)
    fine = _choose(settings, fine, problem, sizes)
    # What has finished stays as it is. Its stack, the bulk of it, has not been touched.
    kept = jax.tree.map(
        lambda new, old: jnp.where(state.pending, new, old),
        fine._replace(stack=state.x),
        state._replace(stack=state.x),
    )
    return kept._replace(stack=found.stack)


def _choose(settings: _Settings, state: ActiveSet, problem: RowProblem, sizes: _Sizes) -> ActiveSet:
    """Step 2: the row that is violated most."""
    value = state.value
    inactive = state.bound_status == 0
    low, high = problem.has_low | problem.equal, problem.has_high | problem.equal
    below = jnp.where(low & inactive, problem.low - value, -jnp.inf)
    above = jnp.where(high & inactive, value - problem.high, -jnp.inf)
    violation = jnp.maximum(below, above)
    # Relative to the row's own terms; below the second number it is rounding.
    eps = float(jnp.finfo(value.dtype).eps)
    bound = jnp.where(below >= above, jnp.abs(problem.low), jnp.abs(problem.high))
    size = jnp.maximum(jnp.max(jnp.abs(state.x)), 1.0)  # of x, which is 1 where it is not far out
    # Before the first polish, rounding is that of the unconstrained minimiser.
    noise = jnp.where(state.rounds == 0, 10.0 * jnp.maximum(size, sizes.outside), 100.0 * size)
    own = settings.tolerance * (bound + jnp.abs(value)) + eps * noise
    violation = jnp.where(violation > own, violation, -jnp.inf)
    # Equations come first, and count even where they hold by chance.
    violation = jnp.where(problem.equal & inactive, jnp.inf, violation)
    chosen = jnp.argmax(violation).astype(jnp.int32)
    pending = (
        state.pending
        & (violation[chosen] > 0)
        & (state.iterations < settings.max_iterations)
        & ~state.infeasible
    )
    sign = jnp.where(below[chosen] >= above[chosen], 1.0, -1.0).astype(value.dtype)
    # What could not be made to hold is kept, for the proof.
    return state._replace(
        chosen=jnp.where(state.infeasible, state.chosen, chosen),
        sign=jnp.where(state.infeasible, state.sign, sign),
        y_chosen=jnp.zeros_like(state.y_chosen),
        pending=pending,
    )


class _Step(NamedTuple):
    """Outcome of the ratio test.

    Attributes:
      z: (n,) direction P a of x.
      r: (n,) direction U a of the slots' multipliers, downwards.
      curvature: a^T P a.
      depends: whether the row's normal depends on the active ones: x does not move.
      t: length of the step; 0 where nothing is done.
      dropped: slot of the row that is in the way.
      adds: whether the step ends at the chosen row, not at the one in the way.
      stuck: whether it ends nowhere.
      redundant: whether the row then holds already.
    """

    z: Array
    r: Array
    curvature: Array
    depends: Array
    t: Array
    dropped: Array
    adds: Array
    stuck: Array
    redundant: Array


def _advance(
    settings: _Settings, state: ActiveSet, problem: RowProblem, sizes: _Sizes
) -> ActiveSet:
    """Steps 3 and 4: add the chosen row, or drop the one that is in its way; then step 2."""
    step = _ratio_test(state, problem, sizes)
    next_state, drop = _exchange(state, problem, step)
    chosen = _choose(settings, next_state, problem, sizes)
    # A row that could not be added yet is tried again.
    again = drop & (next_state.iterations < settings.max_iterations)
    return chosen._replace(
        chosen=jnp.where(drop, state.chosen, chosen.chosen),
        sign=jnp.where(drop, state.sign, chosen.sign),
        y_chosen=jnp.where(drop, next_state.y_chosen, 0.0),
        pending=jnp.where(drop, again, chosen.pending),
    )


def _ratio_test(state: ActiveSet, problem: RowProblem, sizes: _Sizes) -> _Step:
    """Step 3."""
    n, dtype = problem.q.shape[0], problem.q.dtype
    eps = float(jnp.finfo(dtype).eps)
    normal = state.sign * problem.normal(state.chosen)
    moves = state.stack @ normal
    z, r = moves[:n], moves[n:]
    curvature = z @ normal
    wanted = jnp.where(state.sign > 0, problem.low[state.chosen], problem.high[state.chosen])
    violation = state.sign * (wanted - state.value[state.chosen])
    # Rows of equations are never dropped; their normals may push either way.
    held = state.slot_row < state.value.shape[0]
    may_drop = held & ~state.slot_equal & (r > eps)
    ratio = jnp.where(may_drop, state.y / jnp.where(may_drop, r, 1.0), jnp.inf)
    dropped = jnp.argmin(ratio).astype(jnp.int32)
    t_drop = ratio[dropped]
    # A row that depends on the active ones moves nothing: rounding alone is left of its curvature.
    depends = (curvature <= sizes.flat) | held.all()
    t_add = jnp.where(
        depends, jnp.inf, jnp.maximum(violation, 0.0) / jnp.where(depends, 1.0, curvature)
    )
    step = jnp.minimum(t_add, t_drop)
    # An equation that follows from others and holds already is in no one's way.
    stuck = ~jnp.isfinite(step)
    size = jnp.abs(wanted) + jnp.max(jnp.abs(state.x))
    return _Step(
        z=z,
        r=r,
        curvature=curvature,
        depends=depends,
        redundant=stuck & (violation <= 1e3 * eps * n * size),
        adds=t_add <= t_drop,
        t=jnp.where(state.pending & ~stuck, step, 0.0),
        dropped=dropped,
        stuck=stuck,
    )


def _exchange(state: ActiveSet, problem: RowProblem, step: _Step) -> tuple[ActiveSet, Array]:
    """Step 4: the state after the step; and whether a row was dropped."""
    n, M = problem.q.shape[0], state.value.shape[0]
    pending, U = state.pending, state.stack[n:]
    z, r, curvature, depends, t, dropped, adds, stuck, redundant = step
    add, drop = pending & ~stuck & adds, pending & ~stuck & ~adds
    slots = jnp.arange(n, dtype=jnp.int32)
    taken = add & (slots == jnp.argmax(state.slot_row == M))  # the first empty one
    left = drop & (slots == dropped)
    x = state.x + jnp.where(depends, 0.0, t) * z
    y = state.y - t * r
    y = jnp.where(state.slot_equal, y, jnp.maximum(y, 0.0))
    y_chosen = state.y_chosen + t
    y = jnp.where(taken, y_chosen, jnp.where(left, 0.0, y))
    u = U[dropped]
    Hu = problem.H @ u
    uHu = u @ Hu
    # Added: the new row is active and P loses z. Dropped: P gains u back.
    by_add = jnp.concatenate([z, r - taken]) / jnp.where(add, curvature, 1.0)
    by_drop = jnp.concatenate([-u, jnp.where(left, uHu, U @ Hu)]) / jnp.where(drop, uHu, 1.0)
    column = jnp.where(add, by_add, jnp.where(drop, by_drop, 0.0))
    stack = state.stack - column[:, None] * jnp.where(add, z, u)[None, :]
    rows = jnp.arange(M, dtype=jnp.int32)
    is_chosen = rows == state.chosen
    is_dropped = drop & (rows == state.slot_row[dropped])
    becomes_active = (add | (pending & redundant)) & is_chosen
    fails = pending & stuck & ~redundant
    next_state = state._replace(
        stack=stack,
        slot_row=jnp.where(taken, state.chosen, jnp.where(left, M, state.slot_row)),
        slot_equal=jnp.where(taken, problem.equal[state.chosen], state.slot_equal & ~left),
        x=x,
        value=problem.rows(x),  # not the old one's change: far out that would keep its rounding
        y=y,
        y_chosen=y_chosen,
        bound_status=jnp.where(
            becomes_active, state.sign, jnp.where(is_dropped, 0.0, state.bound_status)
        ),
        infeasible=state.infeasible | fails,
        iterations=state.iterations + pending,
    )
    return next_state, drop


def _polish(problem: RowProblem, state: ActiveSet) -> tuple[Float[Array, "n"], Float[Array, "M"]]:
    """Point and multipliers after a Newton step of the equations that the active rows make."""
    n, M = problem.q.shape[0], state.value.shape[0]
    P, U = state.stack[:n], state.stack[n:]
    push = problem.adjoint(state.bound_status * state.spread(state.y))
    r_dual = push - problem.H @ state.x - problem.q
    wanted = jnp.where(state.bound_status > 0, problem.low, problem.high)
    r_rows = state.bound_status * (wanted - problem.rows(state.x))
    held = state.slot_row < M
    r_primal = jnp.where(held, r_rows[jnp.minimum(state.slot_row, M - 1)], 0.0)
    dx = P @ r_dual + U.T @ r_primal
    return state.x + dx, state.y + U @ (problem.H @ dx - r_dual)
