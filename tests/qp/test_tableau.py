"""The tableau: exact, carried from tick to tick, repaired where rounding spoils it, batched."""

from functools import partial

import chex
import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import qp
from kjax.qp import Status
from kjax.qp.problem import swept

N = 12
# Outside jit each operation is a program of its own.
prepare, solve_once = jax.jit(qp.prepare), jax.jit(qp.solve)
start, tableau = jax.jit(qp.start), jax.jit(swept)


@jax.jit
def solve_alone(H, q, lower, upper, fixed=None):
    return qp.solve(qp.prepare(H, fixed), q, lower, upper)


def chain(seed, ticks, *, condition=1e3, size=N):
    """A Hessian, bounds that a third of the variables reach, and linear terms that drift."""
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(size, size)))
    H = basis @ np.diag(np.geomspace(1.0, condition, size)) @ basis.T
    H = 0.5 * (H + H.T)
    angle = np.linspace(0.0, 4.0 * np.pi, ticks)[:, None]
    q = np.cos(angle) * rng.normal(size=size) + np.sin(angle) * rng.normal(size=size)
    q += 0.02 * rng.normal(size=(ticks, size))
    x = np.linalg.solve(H, -q.T).T
    half = 0.7 * np.abs(x).mean(axis=0)
    return H, q, -half, half


@partial(jax.jit, static_argnames="tolerance")
def solve_chain(prepared, q, lower, upper, tolerance=1e-9):
    """Solutions of all ticks, each from the last one's tableau."""

    def tick(warm, q):
        solution = qp.solve(prepared, q, lower, upper, warm, tolerance=tolerance)
        return solution.warm, solution._replace(warm=None)

    return jax.lax.scan(tick, qp.start(prepared), q)[1]


@jax.jit
def residuals(H, q, lower, upper, x):
    """By tick."""
    return jax.vmap(partial(qp.kkt_residual, H), (0, None, None, 0))(q, lower, upper, x)


def by_daqp(H, q, lower, upper):
    n = len(lower)
    H, q, lower, upper = (np.array(a) for a in (H, q, lower, upper))
    none, sense = np.zeros((0, n)), np.zeros(n, np.int32)
    exact = {"primal_tol": 1e-12, "dual_tol": 1e-12}  # its defaults leave 1e-6
    return np.stack(
        [daqp.solve(H, np.array(row), none, upper, lower, sense, **exact)[0] for row in q]
    )


def test_carried_through_two_thousand_ticks_it_stays_exact():
    H, q, lower, upper = chain(0, 2000)
    solutions = jax.tree.map(np.asarray, solve_chain(prepare(H), q, lower, upper))
    assert (solutions.status == Status.SOLVED).all()
    np.testing.assert_allclose(solutions.x, by_daqp(H, q, lower, upper), atol=1e-8)
    active = ((solutions.x == lower[None]) | (solutions.x == upper[None])).sum(axis=1)
    assert 1.0 < active.mean() < N - 1  # else there was nothing to find
    assert solutions.iterations.mean() < 1.0  # two sides change in a few ticks, none in most


def test_in_float32_drift_is_repaired_before_it_shows():
    H, q, lower, upper = chain(1, 2000, condition=1e3)
    data = [a.astype(np.float32) for a in (q, lower, upper)]
    narrow = jax.tree.map(
        lambda a: np.asarray(a, np.float32 if a.dtype == jnp.float64 else None), prepare(H)
    )
    solutions = jax.tree.map(np.asarray, solve_chain(narrow, *data, tolerance=1e-5))
    assert solutions.x.dtype == np.float32
    assert (solutions.status == Status.SOLVED).mean() > 0.99
    # Nothing is called solved that is not, by a residual in float64.
    residual = np.asarray(residuals(H, q, lower, upper, solutions.x.astype(np.float64)))
    assert residual[solutions.status == Status.SOLVED].max() < 3e-5  # 1e-5, rounding of q in it


@pytest.mark.parametrize("ill", ["nan", "another problem's", "wrong sides"])
def test_a_spoilt_warm_start_costs_time_only(ill):
    H, q, lower, upper = chain(2, 2)
    prepared = prepare(H)
    warm = solve_once(prepared, q[0], lower, upper).warm
    if ill == "nan":
        warm = warm._replace(table=np.asarray(warm.table) * np.nan)
    elif ill == "another problem's":
        warm = start(prepare(chain(3, 1)[0]))
    else:
        side = np.asarray(warm.bound_status)
        warm = warm._replace(bound_status=-side + (side == 0))
    solution = solve_once(prepared, q[1], lower, upper, warm)
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, by_daqp(H, q[1:], lower, upper)[0], atol=1e-9)
    # And what it hands on is sound again.
    again = solve_once(prepared, q[1], lower, upper, solution.warm)
    np.testing.assert_allclose(again.x, solution.x, atol=1e-12)


def test_a_tableau_from_scratch_solves_for_free_points_and_bound_gradients():
    H, *_ = chain(4, 1)
    rng = np.random.default_rng(4)
    free = rng.random(N) < 0.5
    x = rng.normal(size=N)
    q = np.where(free, -(H @ x), rng.normal(size=N))  # so that the free gradient is zero
    out = np.asarray(tableau(H, free)) @ np.where(free, -q, x)
    np.testing.assert_allclose(out[free], x[free], atol=1e-10)
    np.testing.assert_allclose(out[~free], (H @ x)[~free], atol=1e-10)


def test_known_fixed_variables_save_their_exchanges():
    H, q, lower, upper = chain(5, 1)
    fixed = np.arange(N) < N // 2
    lower, upper = (np.where(fixed, 0.1, b) for b in (lower, upper))
    plain = solve_alone(H, q[0], lower, upper)
    hinted = solve_alone(H, q[0], lower, upper, fixed)
    assert hinted.iterations <= plain.iterations - N // 2
    np.testing.assert_allclose(hinted.x, plain.x, atol=1e-10)
    # A hint that is wrong does no harm.
    wrong = solve_alone(H, q[0], lower, upper, ~fixed)
    np.testing.assert_allclose(wrong.x, plain.x, atol=1e-10)


prepare_stack = jax.jit(jax.vmap(qp.prepare))


@jax.jit
def solve_indexed(prepared, index, q, lower, upper):
    return qp.solve(prepared, q, lower, upper, index=index)


solve_many = jax.jit(jax.vmap(solve_indexed, (None, 0, 0, None, None)))


@pytest.mark.parametrize("count", [3, 40])  # within one chunk, and in several with a rest
def test_a_batch_over_stacked_hessians_gives_what_single_calls_give(count):
    problems = [chain(seed, count) for seed in range(2)]
    prepared = prepare_stack(np.stack([p[0] for p in problems]))
    which = np.arange(count) % 2
    q = np.stack([problems[i % 2][1][i] for i in range(count)])
    lower, upper = problems[0][2:]
    batch = solve_many(prepared, which, q, lower, upper)
    for k in range(count):
        single = solve_indexed(prepared, which[k], q[k], lower, upper)
        np.testing.assert_allclose(np.asarray(batch.x)[k], single.x, rtol=1e-6, atol=1e-10)
    assert (np.asarray(batch.status) == Status.SOLVED).all()


def test_a_faulty_member_of_a_batch_leaves_the_others_alone():
    H, q, lower, upper = chain(6, 20)
    prepared = prepare(H)
    bad = q.copy()
    bad[7] = np.nan
    solve = jax.jit(jax.vmap(qp.solve, (None, 0, None, None)))
    good, mixed = (jax.tree.map(np.asarray, solve(prepared, q, lower, upper)) for q in (q, bad))
    assert mixed.status[7] == Status.NON_FINITE
    keep = np.arange(20) != 7
    np.testing.assert_array_equal(mixed.x[keep], good.x[keep])
    assert (mixed.status[keep] == Status.SOLVED).all()


@pytest.fixture(scope="module")
def box_gradients():
    """value(method) and its compiled gradient by H, q and both bounds."""
    weight = jnp.linspace(1.0, 2.0, N)

    def value(method, H, q, lower, upper):
        solution = qp.solve(
            qp.prepare(H), q, lower, upper, method=method, tolerance=1e-10, max_iterations=20_000
        )
        return weight @ solution.x + weight[::-1] @ solution.multipliers

    return jax.jit(value, static_argnums=0), {
        method: jax.jit(jax.grad(partial(value, method), argnums=range(4))) for method in qp.METHODS
    }


@pytest.mark.parametrize("method", qp.METHODS)
def test_derivatives_of_the_box_qp_agree_with_finite_differences(box_gradients, method):
    value, gradients = box_gradients
    errors = []
    for seed in range(12):
        H, q, lower, upper = chain(seed, 1, condition=100.0)
        # A fixed variable, whose bounds move together.
        lower[0] = upper[0] = 0.05
        problem = [H, q[0], lower, upper]
        if solve_once(prepare(H), *problem[1:]).margin < 1e-3:
            continue
        slopes = gradients[method](*problem)
        rng = np.random.default_rng(seed)
        directions = [rng.normal(size=a.shape) for a in problem]
        directions[0] = directions[0] + directions[0].T
        directions[3][0] = directions[2][0]
        step = 1e-6
        ahead, behind = (
            value(
                "tableau", *(a + sign * step * d for a, d in zip(problem, directions, strict=True))
            )
            for sign in (1.0, -1.0)
        )
        wanted = float(ahead - behind) / (2.0 * step)
        got = float(sum(np.vdot(s, d) for s, d in zip(slopes, directions, strict=True)))
        errors.append(abs(got - wanted) / max(abs(wanted), 1.0))
    assert len(errors) >= 6
    # Differences of an exact solver leave 1e-13 / step and step^2; the first-order methods stop at
    # a residual of 1e-10, times the condition.
    assert np.median(errors) < 1e-8
    assert max(errors) < 1e-6


def test_forward_and_reverse_mode_agree_through_scan_and_vmap():
    H, q, lower, upper = jax.device_put(chain(8, 30))

    def total(q):
        return (solve_chain(qp.prepare(1.3 * H), q, lower, upper).x ** 2).sum()

    direction = np.sin(np.arange(q.size)).reshape(q.shape)

    @jax.jit
    def both(batch):
        reverse = jax.vmap(jax.grad(total))(batch)
        return reverse, jax.vmap(lambda q: jax.jvp(total, (q,), (direction,))[1])(batch)

    reverse, forward = map(np.asarray, both(np.array([1.0, 1.1])[:, None, None] * np.asarray(q)))
    np.testing.assert_allclose((reverse * direction[None]).sum(axis=(1, 2)), forward, rtol=1e-9)
    # The warm start carries no derivative: the ticks are independent problems.
    alone = jax.jit(
        jax.vmap(jax.grad(lambda q: (solve_alone(1.3 * H, q, lower, upper).x ** 2).sum()))
    )(q)
    np.testing.assert_allclose(reverse[0], alone, atol=1e-10)


def test_a_weakly_active_bound_shows_in_the_margin_and_takes_one_side():
    solve = partial(solve_alone, np.eye(2), lower=np.zeros(2), upper=np.ones(2))
    at_edge = solve(np.array([0.0, -0.5]))  # the unconstrained minimiser lies on the bound
    assert at_edge.margin == 0.0
    assert solve(np.array([0.2, -0.5])).margin > 0.1
    slope = jax.jit(jax.grad(lambda q: solve(q).x[0]))(np.array([0.0, -0.5]))
    assert slope[0] in (0.0, -1.0)


def test_with_faulty_data_derivatives_are_zero_and_finite():
    H, q, lower, upper = chain(9, 1)
    slope = jax.jit(jax.grad(lambda q: solve_alone(H, q, lower, upper).x.sum()))
    q[0, 0] = np.nan
    np.testing.assert_array_equal(slope(q[0]), 0.0)


def test_one_trace_serves_every_tick():
    H, q, lower, upper = jax.device_put(chain(10, 3))
    prepared = prepare(H)

    @jax.jit
    @chex.assert_max_traces(n=1)
    def tick(warm, q):
        solution = qp.solve(prepared, q, lower, upper, warm)
        return solution.warm

    warm = start(prepared)
    for row in q:
        new = tick(warm, row)
        chex.assert_trees_all_equal_shapes_and_dtypes(warm, new)
        warm = new


def test_methods_and_limits_that_do_not_exist_are_refused():
    prepared = prepare(jnp.eye(2))
    for options, match in (
        ({"max_iterations": 0}, "max_iterations"),
        ({"tolerance": -1.0}, "tolerance"),
    ):
        with pytest.raises(ValueError, match=match):
            qp.solve(prepared, jnp.zeros(2), -jnp.ones(2), jnp.ones(2), **options)
