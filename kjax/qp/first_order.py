"""First-order solvers of the box QP: accelerated projected gradient, and ADMM.

Both work on the scaled problem of ``qp.problem``, start from any point and stop at a relative KKT
residual. They are there for comparison, and for what a tableau is too large for.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax.qp.problem import Prepared, ScaledBox


class _Iteration(NamedTuple):
    """A method: where it starts from a point, and its step; states have the point as ``x``."""

    init: Callable[[Array], Any]
    step: Callable[[Any], Any]


class _PgState(NamedTuple):
    x: Array
    momentum_point: Array
    t: Array


def _projected_gradient(prepared: Prepared, box: ScaledBox) -> _Iteration:
    """Nesterov's momentum with gradient restart (O'Donoghue and Candes 2015)."""

    def init(x: Array) -> _PgState:
        return _PgState(x=x, momentum_point=x, t=jnp.ones((), x.dtype))

    def step(state: _PgState) -> _PgState:
        gradient = prepared.H @ state.momentum_point + box.q
        x = box.clip(state.momentum_point - gradient / prepared.eig_max)
        restart = jnp.vdot(state.momentum_point - x, x - state.x) > 0
        t_old = jnp.where(restart, 1.0, state.t)
        t = 0.5 * (1.0 + jnp.sqrt(1.0 + 4.0 * t_old**2))
        # With the condition known, momentum beyond its optimum only brings oscillation.
        root = jnp.sqrt(prepared.eig_min / prepared.eig_max)
        beta = jnp.minimum((t_old - 1.0) / t, (1.0 - root) / (1.0 + root))
        return _PgState(x=x, momentum_point=x + beta * (x - state.x), t=t)

    return _Iteration(init=init, step=step)


class _AdmmState(NamedTuple):
    x: Array
    dual: Array


def _admm(prepared: Prepared, box: ScaledBox) -> _Iteration:
    """Over-relaxed ADMM with the penalty sqrt(eig_min eig_max) (Ghadimi et al. 2015)."""
    relax = 1.6

    def init(x: Array) -> _AdmmState:
        return _AdmmState(x=x, dual=-(prepared.H @ x + box.q) / prepared.rho)

    def step(state: _AdmmState) -> _AdmmState:
        free = prepared.resolvent @ (prepared.rho * (state.x - state.dual) - box.q)
        mixed = relax * free + (1.0 - relax) * state.x + state.dual
        x = box.clip(mixed)
        return _AdmmState(x=x, dual=mixed - x)

    return _Iteration(init=init, step=step)


FIRST_ORDER = {"admm": _admm, "projected_gradient": _projected_gradient}


def descend(
    method: Callable[[Prepared, ScaledBox], _Iteration],
    prepared: Prepared,
    box: ScaledBox,
    x: Float[Array, "n"],
    *,
    tolerance: float,
    max_iterations: int,
) -> tuple[Float[Array, "n"], Float[Array, ""], Int[Array, ""]]:
    """Best point, its residual and the iterations spent; all in scaled coordinates."""
    iteration = method(prepared, box)

    def unfinished(carry: Any) -> Array:
        _, _, error, count = carry
        return (error > tolerance) & (count < max_iterations)

    def advance(carry: Any) -> Any:
        state, best, best_error, count = carry
        state = iteration.step(state)
        error = box.residual(state.x)
        better = error < best_error
        best = jnp.where(better, state.x, best)
        return state, best, jnp.where(better, error, best_error), count + 1

    # Start from the better of the warm start and the clipped unconstrained minimiser. Where no
    # bound is active, the common case of a walking robot, the latter is the solution.
    warm_start, free_minimiser = box.clip(x), box.clip(-(prepared.inverse @ box.q))
    warm_error, free_error = box.residual(warm_start), box.residual(free_minimiser)
    x0 = jnp.where(free_error < warm_error, free_minimiser, warm_start)
    _, best, error, count = jax.lax.while_loop(
        unfinished,
        advance,
        (iteration.init(x0), x0, jnp.minimum(free_error, warm_error), jnp.zeros((), jnp.int32)),
    )
    return best, error, count
