"""``solve``: the box QP by any of the methods, with its derivatives.

The derivative is that of the active set (implicit function theorem): with F free and B at their
bounds, dx_F and dg_B are the same tableau times (-(dq + dH x)_F, db_B) that gave x from q and b, so
one matrix-vector product more. Forward and reverse mode alike; a batch and a scan as well. At a
weakly active bound it is the derivative of one side; ``Solution.margin`` tells how near that is.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax.precision import full_precision
from kjax.qp.batching import in_chunks, where_needed
from kjax.qp.first_order import FIRST_ORDER, descend
from kjax.qp.problem import (
    Prepared,
    ScaledBox,
    Solution,
    Status,
    Warm,
    no_tangent,
    start,
    swept,
)
from kjax.qp.tableau import Pivoted, pivot

Method = Literal["tableau", "admm", "projected_gradient"]
METHODS: tuple[Method, ...] = ("tableau", "admm", "projected_gradient")


@full_precision
def solve(
    prepared: Prepared,
    q: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    warm: Warm | Float[Array, "n"] | None = None,
    *,
    index: Int[Array, ""] | None = None,
    method: Method = "tableau",
    tolerance: float = 1e-9,
    max_iterations: int = 2000,
) -> Solution:
    """Minimiser of 1/2 x^T H x + q^T x on lower <= x <= upper.

    Nine arguments: the problem as in any QP library, and options by keyword.

    Args:
      prepared: from ``prepare(H)``.
      q: (n,) linear term.
      lower: (n,) lower bounds; ``-inf`` for none, equal to ``upper`` to fix a variable.
      upper: (n,) upper bounds; ``inf`` for none.
      warm: ``warm`` of the last solution with the same ``prepared``, or a point (n,) for the
        first-order methods; it need not be feasible, and a wrong one costs time only.
      index: which one, if ``prepared`` is a stack of them. A batch of problems that share a few
        Hessians is faster this way than with a Hessian each.
      method: ``"tableau"`` (exact), ``"admm"`` or ``"projected_gradient"``.
      tolerance: relative KKT residual at which the problem counts as solved; in effect not below
        20 times the rounding of q's type [-].
      max_iterations: bound on the iterations.

    Returns:
      A ``Solution``; faulty data gives its status and a finite point, never a hang. Derivatives of
      ``x`` and ``multipliers`` by ``H`` (through ``prepare``), q and the bounds are exact for the
      active set found; ``warm`` has none. With faulty data they are zero.
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {sorted(METHODS)}, got {method!r}")
    if max_iterations < 1:
        raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be above 0, got {tolerance}")
    settings = _Settings(method, tolerance, max_iterations)
    if method == "tableau":  # a batch need not gather what is not used
        unused = ("inverse", "resolvent", "eig_min", "eig_max", "rho")
        prepared = prepared._replace(**dict.fromkeys(unused))  # type: ignore[arg-type]
    return _differentiable(settings, prepared, index, q, lower, upper, jax.lax.stop_gradient(warm))


class _Settings(NamedTuple):
    method: Method
    tolerance: float
    max_iterations: int


class _Found(NamedTuple):
    """What a method hands back, scaled.

    Attributes:
      x: point.
      residual: its residual.
      iterations: spent.
      table: to go on from.
      bound_status: sides that ``table`` is swept on.
      current: whether these are the sides that ``x`` was found with.
    """

    x: Array
    residual: Array
    iterations: Array
    table: Array
    bound_status: Array
    current: Array


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(
    settings: _Settings,
    prepared: Prepared,
    index: Array | None,
    q: Array,
    lower: Array,
    upper: Array,
    warm: Warm | Array | None,
) -> Solution:
    return in_chunks(partial(_solve, settings))(prepared, index, q, lower, upper, warm)[0]


@_differentiable.defjvp
@full_precision
def _derivative(settings: _Settings, primals: Any, tangents: Any) -> tuple[Solution, Solution]:
    prepared, index, q, lower, upper, _ = primals
    d_prepared, _, dq, d_lower, d_upper, _ = tangents
    if index is not None:
        prepared, d_H = _pick(prepared, index), d_prepared.H[index]
    else:
        d_H = d_prepared.H
    solution, current = in_chunks(partial(_solve, settings))(*primals)
    d, H = prepared.scale, prepared.H
    x = solution.x / d
    gradient = H @ x + q * d
    bound_status = _active_set(solution, current, lower, upper, gradient)
    table = where_needed(
        ~current,
        lambda _, H, bound_status: swept(H, bound_status == 0),
        solution.warm.table,
        jax.lax.stop_gradient(H),
        bound_status,
    )
    push = dq * d + d_H @ x
    move = jnp.where(bound_status < 0, d_lower, d_upper) / d
    out = table @ jnp.where(bound_status == 0, -push, move)
    good = solution.status <= Status.ITERATION_LIMIT
    dx = jnp.where(good, jnp.where(bound_status == 0, out, move) * d, 0.0)
    dy = jnp.where(good & (bound_status != 0), -(out + push) / d, 0.0)
    still = jax.tree.map(no_tangent, solution)
    return solution, still._replace(x=dx, multipliers=dy)


def _active_set(
    solution: Solution, current: Array, lower: Array, upper: Array, gradient: Array
) -> Array:
    """Sides (n,) for the derivative: a fixed variable is at the bound that it presses against."""
    at_lower = (solution.x <= lower) & (gradient > 0)
    at_upper = (solution.x >= upper) & (gradient < 0)
    by_point = jnp.where(at_lower, -1, jnp.where(at_upper, 1, 0))
    bound_status = jnp.where(current, solution.warm.bound_status, by_point)
    return jnp.where(lower == upper, jnp.where(gradient < 0, 1, -1), bound_status)


def _pick(stack: Any, index: Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], stack)


def _solve(
    settings: _Settings,
    prepared: Prepared,
    index: Array | None,
    q: Array,
    lower: Array,
    upper: Array,
    warm: Warm | Array | None,
) -> tuple[Solution, Array]:
    """The solution, and whether its tableau is that of its active set."""
    if index is not None:
        prepared = _pick(prepared, index)
    if not isinstance(warm, Warm):
        warm = start(prepared) if warm is None else start(prepared)._replace(x=warm)
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
    q_hat = jnp.where(good, q * d, 0.0)
    low, high = jnp.where(good, lower / d, -jnp.inf), jnp.where(good, upper / d, jnp.inf)
    box = ScaledBox(prepared.H, q_hat, low, high)
    tolerance = max(settings.tolerance, 20.0 * float(jnp.finfo(q.dtype).eps))
    guess = jnp.where(jnp.isfinite(warm.x), warm.x, 0.0)
    method: Callable[..., _Found] = _by_pivoting if settings.method == "tableau" else _by_descent
    found = method(settings, prepared, box, warm._replace(x=guess / d), tolerance)

    gradient = prepared.H @ found.x + q_hat
    size = jnp.maximum(jnp.max(jnp.abs(q_hat)), jnp.max(jnp.abs(found.x)))
    size = jnp.where(size > 0, size, 1.0)
    presses = ((found.x <= low) & (gradient > 0)) | ((found.x >= high) & (gradient < 0))
    y = jnp.where(presses, -gradient, 0.0)
    slack = jnp.where(presses, jnp.abs(gradient), jnp.minimum(found.x - low, high - found.x))
    slack = jnp.where(low == high, jnp.inf, slack)

    status = jnp.where(good & ~(found.residual <= tolerance), Status.ITERATION_LIMIT, fault)
    # Where the data is faulty the point is the start, inside whatever bounds make sense.
    inner, outer = (
        jnp.where(jnp.isnan(bound) | (bound == absurd), 0.0, bound)
        for bound, absurd in ((lower, jnp.inf), (upper, -jnp.inf))
    )
    # At a bound it is the bound to the last bit, whatever the scaling rounds.
    x = jnp.clip(found.x * d, lower, upper)
    x = jnp.where(found.x <= low, lower, jnp.where(found.x >= high, upper, x))
    x = jnp.where(good, x, jnp.clip(guess, inner, outer))
    unusable = jnp.where(good, 0.0, jnp.inf).astype(q.dtype)
    solution = Solution(
        x=x,
        multipliers=jnp.where(good, y / d, 0.0),
        status=status.astype(jnp.int32),
        residual=found.residual + unusable,
        primal=unusable,
        dual=found.residual + unusable,
        gap=unusable,
        margin=jnp.where(good, jnp.min(slack) / size, 0.0),
        iterations=found.iterations,
        warm=Warm(x=x, table=found.table, bound_status=found.bound_status),
    )
    return solution, found.current


def _by_descent(
    settings: _Settings, prepared: Prepared, box: ScaledBox, warm: Warm, tolerance: float
) -> _Found:
    x, residual, count = descend(
        FIRST_ORDER[settings.method], prepared, box, warm.x,
        tolerance=tolerance, max_iterations=settings.max_iterations,
    )  # fmt: skip
    never = jnp.zeros((), bool)
    return _Found(x, residual, count, prepared.table, prepared.bound_status, current=never)


class _Limits(NamedTuple):
    """Residual that is good enough, and how many exchanges may be made."""

    tolerance: float
    exchanges: int


class _Tried(NamedTuple):
    """Where pivoting has led; ``corrupted`` if its tableau was of no use."""

    x: Array
    residual: Array
    iterations: Array
    corrupted: Array


def _by_pivoting(
    settings: _Settings, prepared: Prepared, box: ScaledBox, warm: Warm, tolerance: float
) -> _Found:
    """Pivot from the warm start; where rounding has spoilt its tableau, once more from the cold."""
    _, q, lower, upper = box
    # The point's size is not known yet; bounds that keep it from 0 are a part of it, and a box
    # around it limits it.
    least = jnp.max(jnp.maximum(jnp.maximum(lower, -upper), 0.0))
    widest = jnp.maximum(jnp.abs(lower), jnp.abs(upper))
    size = jnp.maximum(jnp.max(jnp.abs(q)), least)
    size = jnp.where(jnp.isfinite(size), size, 0.0)
    # Far below the tolerance, which the condition multiplies on its way to x.
    eps = float(jnp.finfo(q.dtype).eps)
    relative = max(10.0 * eps, 1e-3 * tolerance)
    limits = _Limits(tolerance, min(settings.max_iterations, 10 * q.shape[0]))
    threshold = relative * jnp.minimum(size, widest), relative * size

    first = pivot(
        warm.table, warm.bound_status, q, lower, upper, threshold=threshold, limit=limits.exchanges
    )
    attempt = _try(box, first)
    tried = where_needed(
        ~(attempt.residual <= tolerance),
        partial(_refactorise, limits),
        attempt,
        box,
        first,
        prepared.table,
        prepared.bound_status,
        threshold,
    )
    return _Found(
        x=tried.x,
        residual=tried.residual,
        iterations=tried.iterations,
        table=jnp.where(tried.corrupted, prepared.table, first.table),
        bound_status=jnp.where(tried.corrupted, prepared.bound_status, first.bound_status),
        current=~tried.corrupted,
    )


def _try(box: ScaledBox, done: Pivoted) -> _Tried:
    x = done.point(box.lower, box.upper)
    return _Tried(x, box.residual(x), done.exchanges, corrupted=jnp.zeros((), bool))


def _polish(box: ScaledBox, tried: _Tried, done: Pivoted) -> _Tried:
    """A Newton step on the free variables, the tableau an inverse near enough."""
    free = done.bound_status == 0
    move = done.table @ jnp.where(free, -(box.H @ tried.x + box.q), 0.0)
    x = jnp.clip(tried.x + jnp.where(free, move, 0.0), box.lower, box.upper)
    residual = box.residual(x)
    better = residual < tried.residual
    x, residual = jnp.where(better, x, tried.x), jnp.where(better, residual, tried.residual)
    return tried._replace(x=x, residual=residual)


def _refactorise(
    limits: _Limits,
    tried: _Tried,
    box: ScaledBox,
    first: Pivoted,
    table: Array,
    bound_status: Array,
    threshold: tuple[Array, Array],
) -> _Tried:
    """Polish; if that does not do, pivot from the cold start, and take the better point.

    Then with thresholds of every variable's own, as q and the bounds may spread over many decades.
    """
    old = _polish(box, _polish(box, tried, first), first)
    corrupted = ~(old.residual <= limits.tolerance)
    widest = jnp.maximum(jnp.abs(box.lower), jnp.abs(box.upper))
    eps = float(jnp.finfo(box.q.dtype).eps)
    relative = max(10.0 * eps, 1e-3 * limits.tolerance)
    own = tuple(
        jnp.clip(relative * part, eps / relative * whole, whole)
        for part, whole in zip((widest, jnp.abs(box.q)), threshold, strict=True)
    )
    # Where nothing is corrupted no exchange is worth it, which saves a batch the waiting.
    own = jnp.where(corrupted, own[0], jnp.inf), jnp.where(corrupted, own[1], jnp.inf)
    left = limits.exchanges - first.exchanges
    again = pivot(table, bound_status, box.q, box.lower, box.upper, threshold=own, limit=left)
    new = _polish(box, _try(box, again), again)
    better = corrupted & ~(old.residual <= new.residual)
    return _Tried(
        x=jnp.where(better, new.x, old.x),
        residual=jnp.where(better, new.residual, old.residual),
        iterations=old.iterations + new.iterations,
        corrupted=corrupted,
    )
