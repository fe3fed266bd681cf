"""Rows that are seldom active: the box first, the whole problem only where a row is violated."""

from functools import partial

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import qp
from kjax.qp import Status, batching

N, M = 8, 6
OPTIONS = ("box_method", "row_method", "tolerance", "max_iterations")


@partial(jax.jit, static_argnames=OPTIONS)
def solve(H, q, C, row_lower, row_upper, lower, upper, **options):
    return qp.solve_rows_from_box(
        qp.prepare(H), q, C, row_lower, row_upper, lower, upper, **options
    )


def problem(seed, reach):
    """Random H, q, C, rows of that reach about the origin, box."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(N, N))
    H = factor @ factor.T + 0.5 * np.eye(N)
    q, C = 3.0 * rng.normal(size=N), rng.normal(size=(M, N))
    rows = reach * rng.uniform(0.5, 1.0, (2, M))
    box = rng.uniform(0.2, 1.0, (2, N))
    return H, q, C, -rows[0], rows[1], -box[0], box[1]


def by_daqp(H, q, C, row_lower, row_upper, lower, upper):
    high, low = np.r_[upper, row_upper], np.r_[lower, row_lower]
    exact = {"primal_tol": 1e-12, "dual_tol": 1e-12}
    return daqp.solve(H, q, C, high, low, np.zeros(N + M, np.int32), **exact)[0]


@pytest.mark.parametrize(("reach", "violated"), [(50.0, False), (0.3, True)])
@pytest.mark.parametrize("row_method", ["active_set", "admm"])
def test_it_is_the_minimiser_whether_rows_are_active_or_not(reach, violated, row_method):
    for seed in range(3):
        data = problem(seed, reach)
        solution = solve(*data, row_method=row_method)
        assert solution.status == Status.SOLVED
        assert solution.violated == violated
        assert solution.residual <= 1e-9
        # Tolerance times the condition of about 100.
        np.testing.assert_allclose(solution.x, by_daqp(*data), atol=1e-7)


def test_in_float32_too():
    for reach in (50.0, 0.3):
        data = problem(0, reach)
        solution = solve(*(jnp.asarray(a, jnp.float32) for a in data), tolerance=1e-5)
        assert solution.status == Status.SOLVED
        assert solution.x.dtype == jnp.float32
        np.testing.assert_allclose(solution.x, by_daqp(*data), atol=1e-3)


@pytest.mark.parametrize("count", [5, 40])  # at once, and in pieces
def test_a_batch_of_both_kinds_gives_what_single_calls_give(count):
    problems = [problem(seed, 0.3 if seed % 3 == 0 else 50.0) for seed in range(count)]
    batch = jax.jit(jax.vmap(solve))(*(jnp.stack(part) for part in zip(*problems, strict=True)))
    np.testing.assert_array_equal(batch.violated, np.arange(count) % 3 == 0)
    assert (batch.status == Status.SOLVED).all()
    for x, data in zip(batch.x, problems, strict=True):
        np.testing.assert_allclose(x, by_daqp(*data), atol=1e-7)


def test_a_batch_without_violations_spends_nothing_on_rows():
    """The pieces that are computed hold the members that need it, and no others."""
    pieces = []

    def costly(value, mark):
        jax.debug.callback(lambda mark: pieces.append(int(mark)), mark)
        return value + 1.0

    run = jax.jit(jax.vmap(lambda needed, v, m: batching.where_needed(needed, costly, v, m)))
    needed = np.isin(np.arange(100), [3, 50, 99])
    value = run(needed, np.zeros(100), np.arange(100))
    jax.effects_barrier()
    np.testing.assert_array_equal(value, needed)
    assert len(pieces) == batching.CHUNK
    assert {3, 50, 99} <= set(pieces)
    pieces.clear()
    run(np.zeros(100, bool), np.zeros(100), np.arange(100))
    jax.effects_barrier()
    assert not pieces


@pytest.mark.parametrize("reach", [50.0, 0.3])
def test_derivatives_agree_with_finite_differences_in_both_cases(reach):
    data = problem(1, reach)
    weight = jnp.linspace(1.0, 2.0, N)
    rng = np.random.default_rng(1)
    directions = tuple(rng.normal(size=a.shape) for a in data)

    def value(*data):
        return weight @ solve(*data).x

    step = 1e-6
    ahead, behind = (
        value(*(a + sign * step * d for a, d in zip(data, directions, strict=True)))
        for sign in (1.0, -1.0)
    )
    wanted = (ahead - behind) / (2.0 * step)
    slopes = jax.jit(jax.grad(value, argnums=range(7)))(*data)
    backward = sum(jnp.vdot(s, d) for s, d in zip(slopes, directions, strict=True))
    forward = jax.jit(lambda d, t: jax.jvp(value, d, t)[1])(data, directions)
    # Central differences of an exact solver: step^2 of curvature and 1e-13 / step of rounding.
    np.testing.assert_allclose(backward, wanted, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(forward, wanted, rtol=1e-6, atol=1e-6)


def test_a_batch_of_both_kinds_has_the_derivatives_of_single_calls():
    problems = [problem(seed, 0.3 if seed % 3 == 0 else 50.0) for seed in range(20)]
    stacked = [jnp.stack(part) for part in zip(*problems, strict=True)]

    def value(q, *rest):
        H, *others = rest
        return solve(H, q, *others).x.sum()

    H, q, *others = stacked
    slopes = jax.jit(jax.vmap(jax.grad(value)))(q, H, *others)
    single = jax.jit(jax.grad(value))
    for i in (0, 1, 3, 19):
        wanted = single(q[i], H[i], *(a[i] for a in others))
        np.testing.assert_allclose(slopes[i], wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("place", "value", "status"),
    [
        (1, np.nan, Status.NON_FINITE),
        (2, np.nan, Status.NON_FINITE),
        (3, np.nan, Status.NON_FINITE),
        (3, 1e9, Status.INFEASIBLE_BOUNDS),
        (5, 1e9, Status.INFEASIBLE_BOUNDS),
        (0, -1e4, Status.NOT_POSITIVE_DEFINITE),
    ],
)
def test_faulty_data_has_its_status_and_a_finite_point(place, value, status):
    data = [a.copy() for a in problem(0, 50.0)]
    data[place][(0,) * data[place].ndim] = value
    solution = solve(*data)
    assert solution.status == status
    assert jnp.isfinite(solution.x).all()


def test_rows_that_cannot_hold_are_infeasible():
    H, q, C, row_lower, row_upper, lower, upper = problem(0, 50.0)
    solution = solve(H, q, C, row_lower, np.r_[-1e3, row_upper[1:]], lower, upper)
    assert solution.status in (Status.INFEASIBLE, Status.INFEASIBLE_BOUNDS)
    low = np.r_[90.0, row_lower[1:]]
    assert solve(H, q, C, low, np.r_[99.0, row_upper[1:]], lower, upper).status == Status.INFEASIBLE
