"""First-order solvers of the box QP: accelerated projected gradient, and ADMM.

Both work on the scaled problem of ``qp.problem``, start from any point, stop at a relative KKT
residual and run under ``jit`` and ``vmap`` (a batch runs as long as its slowest member; the ones
that are done stand still).
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.qp.problem import Prepared, Solution, Status, natural_residual

Method = Literal["admm", "projected_gradient"]


class _Box(NamedTuple):
    """Scaled problem data that is not in ``Prepared``."""

    q: Float[Array, "n"]
    lower: Float[Array, "n"]
    upper: Float[Array, "n"]

    def clip(self, x: Array) -> Array:
        return jnp.clip(x, self.lower, self.upper)


class _Iteration(NamedTuple):
    """A method: where it starts from a point, and its step; states have the point as ``x``."""

    init: Callable[[Array], Any]
    step: Callable[[Any], Any]


class _PgState(NamedTuple):
    x: Array
    momentum_point: Array
    t: Array


def _projected_gradient(prepared: Prepared, box: _Box) -> _Iteration:
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


def _admm(prepared: Prepared, box: _Box) -> _Iteration:
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


_METHODS = {"admm": _admm, "projected_gradient": _projected_gradient}


def solve(
    prepared: Prepared,
    q: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    warm: Float[Array, "n"] | None = None,
    *,
    method: Method = "admm",
    tolerance: float = 1e-6,
    max_iterations: int = 2000,
) -> Solution:
    """Minimiser of 1/2 x^T H x + q^T x on lower <= x <= upper.

    Args:
      prepared: from ``prepare(H)``.
      q: (n,) linear term.
      lower: (n,) lower bounds; ``-inf`` for none, equal to ``upper`` to fix a variable.
      upper: (n,) upper bounds; ``inf`` for none.
      warm: (n,) starting point, the origin by default; it need not be feasible.
      method: ``"admm"`` or ``"projected_gradient"``.
      tolerance: relative KKT residual at which the problem counts as solved [-].
      max_iterations: bound on the iterations.

    Returns:
      A ``Solution``; faulty data gives its status and a finite point, never a hang.
    """
    if method not in _METHODS:
        raise ValueError(f"method must be one of {sorted(_METHODS)}, got {method!r}")
    if max_iterations < 1:
        raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")

    feasible = ((lower <= upper) & (lower < jnp.inf) & (upper > -jnp.inf)).all()
    nan_bound = jnp.isnan(lower).any() | jnp.isnan(upper).any()
    finite = prepared.finite & jnp.isfinite(q).all() & ~nan_bound
    fault = jnp.select(
        [~finite, ~feasible, ~prepared.definite],
        [Status.NON_FINITE, Status.INFEASIBLE_BOUNDS, Status.NOT_POSITIVE_DEFINITE],
        Status.SOLVED,
    ).astype(jnp.int32)
    good = fault == Status.SOLVED

    d = prepared.scale
    box = _Box(
        q=jnp.where(good, q * d, 0.0),
        lower=jnp.where(good, lower / d, -jnp.inf),
        upper=jnp.where(good, upper / d, jnp.inf),
    )
    start = jnp.zeros_like(q) if warm is None else jnp.where(jnp.isfinite(warm), warm, 0.0)
    iteration = _METHODS[method](prepared, box)

    def residual(x: Array) -> Array:
        return natural_residual(prepared.H, box.q, box.lower, box.upper, x)

    def unfinished(carry: Any) -> Array:
        _, _, error, count = carry
        return (error > tolerance) & (count < max_iterations)

    def advance(carry: Any) -> Any:
        state, best, best_error, count = carry
        state = iteration.step(state)
        error = residual(state.x)
        better = error < best_error
        best = jnp.where(better, state.x, best)
        return state, best, jnp.where(better, error, best_error), count + 1

    # Start from the better of the warm start and the clipped unconstrained minimiser. Where no
    # bound is active, the common case of a walking robot, the latter is the solution.
    warm_start = box.clip(start / d)
    free_minimiser = box.clip(-(prepared.inverse @ box.q))
    warm_error, free_error = residual(warm_start), residual(free_minimiser)
    x0 = jnp.where(free_error < warm_error, free_minimiser, warm_start)
    error0 = jnp.where(good, jnp.minimum(free_error, warm_error), 0.0)
    _, best, error, count = jax.lax.while_loop(
        unfinished, advance, (iteration.init(x0), x0, error0, jnp.zeros((), jnp.int32))
    )
    status = jnp.where(good & ~(error <= tolerance), Status.ITERATION_LIMIT, fault)
    # Where the data is faulty the point is the start, inside whatever bounds make sense.
    low, high = (
        jnp.where(jnp.isnan(bound) | (bound == absurd), 0.0, bound)
        for bound, absurd in ((lower, jnp.inf), (upper, -jnp.inf))
    )
    fallback = jnp.clip(start, low, high)
    x = jnp.where(good, jnp.clip(best * d, lower, upper), fallback)
    return Solution(
        x=x,
        status=status.astype(jnp.int32),
        residual=jnp.where(good, error, jnp.inf),
        iterations=count,
    )
