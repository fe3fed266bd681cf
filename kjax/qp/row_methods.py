"""The methods of ``solve_rows``: each solves the scaled problem and has its point judged.

A method hands back a ``Found``: the point as it is returned, clipped and in the caller's units,
with ``kkt_errors`` of just that point.
"""

from enum import IntEnum
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from kjax.qp.active_set import ActiveSet, farkas, solve_active_set
from kjax.qp.batching import where_needed
from kjax.qp.certificates import Verdict, classify, proves_infeasible
from kjax.qp.interior import descend_central_path
from kjax.qp.polish import polish
from kjax.qp.row_problem import (
    RowProblem,
    RowScaling,
    contradicts,
    kkt_errors,
    scale_rows,
    snapped,
)
from kjax.qp.splitting import solve_splitting

RowMethod = Literal["auto", "active_set", "interior_point", "admm"]
ROW_METHODS: tuple[RowMethod, ...] = ("auto", "active_set", "interior_point", "admm")


class MethodUsed(IntEnum):
    """Which method a ``RowSolution`` comes from."""

    ACTIVE_SET = 0
    INTERIOR_POINT = 1
    ADMM = 2


class RowSettings(NamedTuple):
    """Static settings of ``solve_rows``.

    Attributes:
      method: asked for.
      tolerance: on primal, dual and gap [-].
      max_iterations: of the method.
    """

    method: RowMethod
    tolerance: float
    max_iterations: int


class RowData(NamedTuple):
    """The caller's problem, faulty data replaced; H symmetric, the box's bounds last."""

    H: Array
    q: Array
    C: Array
    low: Array
    high: Array
    good: Array


class Found(NamedTuple):
    """What a method hands back: the point in the caller's units, and what is known of it.

    Attributes:
      x: (n,) point, clipped.
      y: (m + n,) multipliers.
      error: (3,) ``kkt_errors``.
      margin: see ``RowSolution``.
      usable: whether H is such that the method can be used.
      infeasible: whether that is proven.
      iterations: spent.
      method: a ``MethodUsed``.
    """

    x: Array
    y: Array
    error: Array
    margin: Array
    usable: Array
    infeasible: Array
    iterations: Array
    method: Array

    def solved(self, tolerance: float) -> Array:
        """Whether all residuals of the point are within ``tolerance``."""
        return jnp.max(self.error) <= tolerance


class Evidence(NamedTuple):
    """What the active set leaves behind, for the proof that nothing keeps all rows."""

    state: ActiveSet
    problem: RowProblem
    scaling: RowScaling


def by_active_set(
    settings: RowSettings, problem: RowProblem, scaling: RowScaling, data: RowData
) -> tuple[Found, Evidence]:
    """Dual active set; H must be positive definite. ``infeasible`` is claimed, not yet proven."""
    state, definite = solve_active_set(
        problem, data.good, 0.1 * settings.tolerance, settings.max_iterations
    )
    found = _judge(
        problem, scaling, data, state.x, state.multipliers,
        state.bound_status > 0, state.bound_status < 0, usable=definite | ~data.good,
        infeasible=state.infeasible, iterations=state.iterations, method=MethodUsed.ACTIVE_SET,
    )  # fmt: skip
    return found, Evidence(state, problem, scaling)


def proven_by_active_set(
    settings: RowSettings, found: Found, evidence: Evidence, data: RowData
) -> Array:
    """Whether what the active set claims of an unsolved problem is proven."""
    state, problem, scaling = evidence
    claimed = state.infeasible & proves_infeasible(problem, farkas(problem, state))
    contradicted = contradicts(scaling, data.C, data.low, data.high, settings.tolerance)
    return found.usable & (claimed | contradicted)


def by_interior_point(
    settings: RowSettings, problem: RowProblem, scaling: RowScaling, data: RowData
) -> Found:
    """Primal-dual interior point; H may be singular."""
    usable = _semidefinite(problem) | ~data.good
    x, y, count = descend_central_path(
        problem,
        data.good & usable,
        tolerance=0.5 * settings.tolerance,
        max_iterations=settings.max_iterations,
    )
    return _judge_or_polish(
        settings, problem, scaling, data, x, y, usable=usable, infeasible=jnp.zeros((), bool),
        iterations=count, method=MethodUsed.INTERIOR_POINT,
    )  # fmt: skip


def by_splitting(
    settings: RowSettings,
    problem: RowProblem,
    scaling: RowScaling,
    data: RowData,
    warm: Array | None,
) -> Found:
    """ADMM on the rows (the splitting of OSQP); H may be singular."""
    usable = _semidefinite(problem) | ~data.good
    if warm is not None:
        warm = jnp.where(jnp.isfinite(warm), warm - scaling.at, 0.0) / scaling.x
        warm = jnp.where(scaling.fixed, 0.0, warm)
    result = solve_splitting(
        problem,
        data.good & usable,
        warm,
        tolerance=0.5 * settings.tolerance,
        max_iterations=settings.max_iterations,
    )
    return _judge_or_polish(
        settings, problem, scaling, data, result.x, result.multipliers, usable=usable,
        infeasible=result.infeasible, iterations=result.iterations, method=MethodUsed.ADMM,
    )  # fmt: skip


def better_by_interior_point(settings: RowSettings, old: Found, data: RowData) -> Found:
    """The old point, or the interior point's where that is better or the old has no use."""
    problem, scaling = scale_rows(*data[:5])
    new = by_interior_point(settings, problem, scaling, data)
    new = new._replace(iterations=old.iterations + new.iterations)
    keep = old.usable & (jnp.max(old.error) <= jnp.max(new.error))
    return jax.tree.map(lambda a, b: jnp.where(keep, a, b), old, new)


def classified(tolerance: float, old: Verdict, data: RowData) -> Verdict:
    """Step 4: whether the problem is proven infeasible or unbounded, with a finite point."""
    del old
    problem, scaling = scale_rows(*data[:5])
    verdict = classify(problem, data.good)
    m = data.C.shape[0]
    x = jnp.clip(verdict.x * scaling.x + scaling.at, data.low[m:], data.high[m:])
    contradicted = contradicts(scaling, data.C, data.low, data.high, tolerance)
    return Verdict(verdict.infeasible | contradicted, verdict.unbounded & ~contradicted, x)


def _semidefinite(problem: RowProblem) -> Array:
    """Whether H is positive semidefinite to working precision."""
    n, eps = problem.q.shape[0], float(jnp.finfo(problem.q.dtype).eps)
    size = jnp.max(jnp.abs(problem.H), initial=0.0)
    H = problem.H / jnp.where(size > 0, size, 1.0)
    ridge = 10.0 * n * eps * jnp.eye(n, dtype=H.dtype)
    return jnp.isfinite(jnp.linalg.cholesky(H + ridge)).all()


def _judge_or_polish(
    settings: RowSettings,
    problem: RowProblem,
    scaling: RowScaling,
    data: RowData,
    x: Array,
    y: Array,
    *,
    usable: Array,
    infeasible: Array,
    iterations: Array,
    method: MethodUsed,
) -> Found:
    """The judged point; polished on its active rows where it is not good enough as it is."""
    never = jnp.zeros_like(problem.has_low)
    found = _judge(
        problem, scaling, data, x, y, never, never,
        usable=usable, infeasible=infeasible, iterations=iterations, method=method,
    )  # fmt: skip

    def polished(old: Found, problem: Any, scaling: Any, data: Any, x: Array, y: Array) -> Found:
        fine = _judge(
            problem, scaling, data, *polish(problem, x, y), usable=old.usable,
            infeasible=old.infeasible, iterations=old.iterations, method=method,
        )  # fmt: skip
        better = jnp.max(fine.error) < jnp.max(old.error)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), fine, old)

    needed = data.good & usable & ~found.solved(settings.tolerance)
    return where_needed(needed, polished, found, problem, scaling, data, x, y)


def _judge(
    problem: RowProblem,
    scaling: RowScaling,
    data: RowData,
    x_hat: Array,
    y_hat: Array,
    at_low: Array,
    at_high: Array,
    *,
    usable: Array,
    infeasible: Array,
    iterations: Array,
    method: MethodUsed,
) -> Found:
    """Step 3. A bound that is active (``at_low``, ``at_high``) is kept to the last bit."""
    m = data.C.shape[0]
    lower, upper = data.low[m:], data.high[m:]
    x = jnp.clip(snapped(x_hat) * scaling.x + scaling.at, lower, upper)
    x = jnp.where(at_low[m:], lower, jnp.where(at_high[m:], upper, x))
    y = y_hat * scaling.multipliers
    y = jnp.where(jnp.concatenate([scaling.immovable, jnp.zeros_like(scaling.fixed)]), 0.0, y)
    d = jnp.where(scaling.fixed, 0.0, scaling.x)
    error, y, value = kkt_errors(
        data.H, data.q, data.C, data.low, data.high, d, scaling.values, x, y
    )
    force = y / scaling.multipliers
    slack_low, slack_high = (
        (value - data.low) / scaling.values,
        (data.high - value) / scaling.values,
    )
    below = jnp.where(problem.has_low, jnp.maximum(slack_low, -force), jnp.inf)
    above = jnp.where(problem.has_high, jnp.maximum(slack_high, force), jnp.inf)
    return Found(
        x=x,
        y=y,
        error=error,
        margin=jnp.min(jnp.minimum(below, above), initial=jnp.inf),
        usable=usable,
        infeasible=infeasible,
        iterations=iterations,
        method=jnp.asarray(method, jnp.int32),
    )
