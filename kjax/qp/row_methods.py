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
from kjax.qp.factor import Factor, factorise, unconstrained
from kjax.qp.interior import solve_interior_point
from kjax.qp.lapack import cholesky
from kjax.qp.polish import polish
from kjax.qp.row_problem import (
    RowData,
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

    def checked(self) -> "RowSettings":
        """These, if they make sense."""
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations must be at least 1, got {self.max_iterations}")
        if not self.tolerance > 0:
            raise ValueError(f"tolerance must be above 0, got {self.tolerance}")
        return self

    def reachable(self, dtype: Any) -> "RowSettings":
        """These with a tolerance that the type's rounding allows."""
        return self._replace(tolerance=max(self.tolerance, 20.0 * float(jnp.finfo(dtype).eps)))


class Posed(NamedTuple):
    """A problem as the methods take it.

    Attributes:
      problem: scaled.
      scaling: back to the caller's units.
      data: the caller's problem, faulty data replaced.
      good: whether nothing had to be replaced; else nothing is done.
    """

    problem: RowProblem
    scaling: RowScaling
    data: RowData
    good: Array


class Judged(NamedTuple):
    """A point in the caller's units, and how good it is; see ``Found``."""

    x: Array
    y: Array
    error: Array
    margin: Array


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


def pose(data: RowData, good: Array, *, equilibrate: bool = True) -> Posed:
    """Step 1: the problem scaled, see ``scale_rows``."""
    problem, scaling = scale_rows(data, equilibrate=equilibrate)
    return Posed(problem, scaling, data, good)


def without_rows(posed: Posed) -> tuple[Found, Factor]:
    """The unconstrained minimiser, often the solution; and the factor of H."""
    factor = factorise(posed.problem.H)
    x = unconstrained(factor, posed.problem.q)
    found = Found(
        *_judge_inside(posed, x, jnp.zeros_like(posed.problem.low)),
        usable=factor.definite | ~posed.good,
        infeasible=jnp.zeros((), bool),
        iterations=jnp.zeros((), jnp.int32),
        method=_used(MethodUsed.ACTIVE_SET),
    )
    return found, factor


def by_active_set(settings: RowSettings, posed: Posed, factor: Factor) -> tuple[Found, Evidence]:
    """Dual active set; H must be positive definite. ``infeasible`` is claimed, not yet proven."""
    state = solve_active_set(
        posed.problem, factor, posed.good, 0.1 * settings.tolerance, settings.max_iterations
    )
    usable = factor.definite | ~posed.good
    at_low, at_high = state.bound_status > 0, state.bound_status < 0
    found = Found(
        *_judge(posed, state.x, state.multipliers, at_low, at_high),
        usable=usable,
        infeasible=state.infeasible,
        iterations=state.iterations,
        method=_used(MethodUsed.ACTIVE_SET),
    )
    return found, Evidence(state, posed.problem, posed.scaling)


def proven_by_active_set(
    settings: RowSettings, found: Found, evidence: Evidence, data: RowData
) -> Array:
    """Whether what the active set claims of an unsolved problem is proven."""
    state, problem, scaling = evidence
    claimed = state.infeasible & proves_infeasible(problem, farkas(problem, state))
    contradicted = contradicts(scaling, data, settings.tolerance)
    return found.usable & (claimed | contradicted)


def by_interior_point(settings: RowSettings, posed: Posed) -> Found:
    """Primal-dual interior point; H may be singular."""
    usable = _semidefinite(posed.problem) | ~posed.good
    x, y, count = solve_interior_point(
        posed.problem,
        posed.good & usable,
        tolerance=0.5 * settings.tolerance,
        max_iterations=settings.max_iterations,
    )
    found = Found(
        *_judge_inside(posed, x, y),
        usable=usable,
        infeasible=jnp.zeros((), bool),
        iterations=count,
        method=_used(MethodUsed.INTERIOR_POINT),
    )
    return _polish_where_needed(settings, posed, found, x, y)


def by_splitting(settings: RowSettings, posed: Posed, warm: Array | None) -> Found:
    """ADMM on the rows (the splitting of OSQP); H may be singular."""
    problem, scaling = posed.problem, posed.scaling
    usable = _semidefinite(problem) | ~posed.good
    if warm is not None:
        warm = jnp.where(jnp.isfinite(warm), warm - scaling.at, 0.0) / scaling.x
        warm = jnp.where(scaling.fixed, 0.0, warm)
    result = solve_splitting(
        problem,
        posed.good & usable,
        warm,
        tolerance=0.5 * settings.tolerance,
        max_iterations=settings.max_iterations,
    )
    found = Found(
        *_judge_inside(posed, result.x, result.multipliers),
        usable=usable,
        infeasible=result.infeasible,
        iterations=result.iterations,
        method=_used(MethodUsed.ADMM),
    )
    return _polish_where_needed(settings, posed, found, result.x, result.multipliers)


def better_by_interior_point(
    settings: RowSettings, old: Found, data: RowData, good: Array
) -> Found:
    """The old point, or the interior point's where that is better or the old has no use."""
    new = by_interior_point(settings, pose(data, good))
    new = new._replace(iterations=old.iterations + new.iterations)
    keep = old.usable & (jnp.max(old.error) <= jnp.max(new.error))
    return jax.tree.map(lambda a, b: jnp.where(keep, a, b), old, new)


def classified(tolerance: float, old: Verdict, data: RowData, good: Array) -> Verdict:
    """Step 4: whether the problem is proven infeasible or unbounded, with a finite point."""
    del old
    problem, scaling = scale_rows(data)
    verdict = classify(problem, good)
    m = data.C.shape[0]
    x = jnp.clip(verdict.x * scaling.x + scaling.at, data.low[m:], data.high[m:])
    contradicted = contradicts(scaling, data, tolerance)
    return Verdict(verdict.infeasible | contradicted, verdict.unbounded & ~contradicted, x)


def _semidefinite(problem: RowProblem) -> Array:
    """Whether H is positive semidefinite to working precision."""
    n, eps = problem.q.shape[0], float(jnp.finfo(problem.q.dtype).eps)
    size = jnp.max(jnp.abs(problem.H), initial=0.0)
    H = problem.H / jnp.where(size > 0, size, 1.0)
    ridge = 10.0 * n * eps * jnp.eye(n, dtype=H.dtype)
    return jnp.isfinite(cholesky(H + ridge)).all()


def _used(method: MethodUsed) -> Array:
    return jnp.asarray(method, jnp.int32)


def _polish_where_needed(
    settings: RowSettings, posed: Posed, found: Found, x: Array, y: Array
) -> Found:
    """The point polished on its active rows where it is not good enough as it is; x, y scaled."""

    def polished(old: Found, posed: Posed, x: Array, y: Array) -> Found:
        fine = old._replace(**_judge(posed, *polish(posed.problem, x, y))._asdict())
        better = jnp.max(fine.error) < jnp.max(old.error)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), fine, old)

    needed = posed.good & found.usable & ~found.solved(settings.tolerance)
    return where_needed(needed, polished, found, posed, x, y)


def _judge_inside(posed: Posed, x_hat: Array, y_hat: Array) -> Judged:
    """Step 3 for a point whose active rows are not known."""
    never = jnp.zeros_like(posed.problem.has_low)
    return _judge(posed, x_hat, y_hat, never, never)


def _judge(posed: Posed, x_hat: Array, y_hat: Array, at_low: Array, at_high: Array) -> Judged:
    """Step 3. A bound that is active (``at_low``, ``at_high``) is kept to the last bit."""
    problem, scaling, data, _ = posed
    m = data.C.shape[0]
    lower, upper = data.low[m:], data.high[m:]
    x = jnp.clip(snapped(x_hat) * scaling.x + scaling.at, lower, upper)
    x = jnp.where(at_low[m:], lower, jnp.where(at_high[m:], upper, x))
    y = y_hat * scaling.multipliers
    y = jnp.where(jnp.concatenate([scaling.immovable, jnp.zeros_like(scaling.fixed)]), 0.0, y)
    d = jnp.where(scaling.fixed, 0.0, scaling.x)
    error, y, value = kkt_errors(data, d, scaling.values, x, y)
    force = y / scaling.multipliers
    slack_low, slack_high = (
        (value - data.low) / scaling.values,
        (data.high - value) / scaling.values,
    )
    below = jnp.where(problem.has_low, jnp.maximum(slack_low, -force), jnp.inf)
    above = jnp.where(problem.has_high, jnp.maximum(slack_high, force), jnp.inf)
    margin = jnp.min(jnp.minimum(below, above), initial=jnp.inf)
    return Judged(x=x, y=y, error=error, margin=margin)
