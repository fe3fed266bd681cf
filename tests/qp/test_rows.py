"""General rows on problems with a known answer, against the C solver daqp, on faulty data."""

from functools import partial

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import qp
from kjax.qp import Status

N, M = 10, 14
OPTIONS = ("method", "tolerance", "max_iterations")
solve = jax.jit(qp.solve_rows, static_argnames=OPTIONS)


@pytest.fixture(params=qp.ROW_METHODS)
def method(request):
    return request.param


def known(seed, *, equations=0, fixed=0, rank=N):
    """QP with general rows built from a KKT point: its data, x and the multipliers (m + n,).

    A third of the rows and variables rest at their lower bound, a third at the upper one, each
    pushed by a multiplier; the first ``equations`` rows and ``fixed`` variables have equal bounds.
    """
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(N, N)))
    spectrum = np.where(np.arange(N) < rank, np.geomspace(1.0, 100.0, N), 0.0)
    H = basis @ np.diag(spectrum) @ basis.T
    H = 0.5 * (H + H.T)
    C = rng.normal(size=(M, N))
    x = rng.normal(size=N)
    value = np.r_[C @ x, x]
    kind = rng.permutation(np.arange(M + N) % 3)
    tight = np.arange(M + N)
    equal = (tight < equations) | ((tight >= M) & (tight < M + fixed))
    # No more active rows than variables, so that the multipliers are unique.
    active = np.zeros(M + N, bool)
    active[rng.permutation(np.flatnonzero(~equal))[: N // 2 - 1]] = True
    kind = np.where(active, kind % 2, 2)
    low = np.where(equal | (kind == 0), value, value - rng.uniform(0.1, 2.0, M + N))
    high = np.where(equal | (kind == 1), value, value + rng.uniform(0.1, 2.0, M + N))
    push = rng.uniform(0.1, 2.0, M + N)
    y = np.select([equal, kind == 0, kind == 1], [rng.normal(size=M + N), -push, push], 0.0)
    q = -(H @ x + C.T @ y[:M] + y[M:])
    return (H, q, C, low[:M], high[:M], low[M:], high[M:]), x, y


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("equations", "fixed"), [(0, 0), (2, 0), (0, 2), (2, 1)])
def test_it_finds_the_point_and_the_multipliers_of_a_known_kkt_point(
    seed, equations, fixed, method
):
    problem, x, y = known(seed, equations=equations, fixed=fixed)
    solution = solve(*problem, method=method)
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, x, atol=1e-6)
    np.testing.assert_allclose(solution.multipliers, y, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_it_agrees_with_daqp_where_sides_are_infinite(seed, method):
    rng = np.random.default_rng(100 + seed)
    (H, _, C, *_), _, _ = known(seed)
    q = 10.0 * rng.normal(size=N)
    low, high = -rng.uniform(0.1, 1.0, M + N), rng.uniform(0.1, 1.0, M + N)
    low[rng.random(M + N) < 0.3] = -np.inf
    high[rng.random(M + N) < 0.3] = np.inf
    solution = solve(H, q, C, low[:M], high[:M], low[M:], high[M:], method=method)
    order = np.r_[M : M + N, 0:M]  # daqp wants the box first
    bounds = [np.clip(b[order], -1e30, 1e30) for b in (high, low)]
    wanted, _, flag, _ = daqp.solve(H, q, C, *bounds, np.zeros(M + N, np.int32))
    assert flag == 1
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, wanted, atol=1e-5)


def test_without_rows_it_solves_the_box_qp(random_qp, method):
    H, q, lower, upper, x = random_qp(3)
    empty = jnp.zeros((0, len(q)))
    solution = solve(H, q, empty, jnp.zeros(0), jnp.zeros(0), lower, upper, method=method)
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, x, atol=1e-6)


def test_a_singular_hessian_is_solved_where_rows_and_box_hold_the_minimiser():
    problem, _, _ = known(5, rank=N - 4)
    H, q, C, *bounds = problem
    solution = solve(*problem)
    assert solution.status == Status.SOLVED
    order = np.r_[M : M + N, 0:M]
    low, high = np.r_[bounds[0], bounds[2]], np.r_[bounds[1], bounds[3]]
    # The minimiser need not be unique, its value is: daqp with a vanishing ridge.
    best, _, flag, _ = daqp.solve(
        H + 1e-9 * np.eye(N), q, C, high[order], low[order], np.zeros(M + N, np.int32)
    )
    assert flag == 1
    value = [0.5 * p @ H @ p + q @ p for p in (np.asarray(solution.x), best)]
    np.testing.assert_allclose(value[0], value[1], atol=1e-6)


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_a_common_factor_of_the_cost_changes_nothing(factor, method):
    (H, q, *rest), x, y = known(0)
    solution = solve(factor * H, factor * q, *rest, method=method)
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, x, atol=1e-6)
    np.testing.assert_allclose(solution.multipliers / factor, y, atol=1e-5)


def test_a_batch_gives_what_single_calls_give(method):
    problems = [known(seed)[0] for seed in range(5)]
    batch = jax.vmap(partial(solve, method=method))(
        *(jnp.stack(parts) for parts in zip(*problems, strict=True))
    )
    for i, problem in enumerate(problems):
        np.testing.assert_allclose(batch.x[i], solve(*problem, method=method).x, atol=1e-7)


def test_in_float32_it_is_as_good_as_float32_lets_it_be(method):
    problem, x, _ = known(2)
    solution = solve(*(jnp.asarray(a, jnp.float32) for a in problem), tolerance=1e-4, method=method)
    assert solution.x.dtype == jnp.float32
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, x, atol=2e-2)


def test_an_infeasible_problem_is_not_called_solved(method):
    (H, q, C, low, high, lower, upper), _, _ = known(1)
    C, low, high = C.copy(), low.copy(), high.copy()
    C[1], low[0], high[0], low[1], high[1] = C[0], 1.0, 2.0, -2.0, -1.0
    solution = solve(H, q, C, low, high, lower, upper, method=method)
    assert solution.status == Status.INFEASIBLE
    assert solution.primal > 1e-3
    assert jnp.isfinite(solution.x).all()


@pytest.mark.parametrize(
    ("place", "value", "status"),
    [
        ("H", np.nan, Status.NON_FINITE),
        ("q", np.inf, Status.NON_FINITE),
        ("C", np.nan, Status.NON_FINITE),
        ("row_lower", np.nan, Status.NON_FINITE),
        ("row_lower", 1e9, Status.INFEASIBLE_BOUNDS),
        ("upper", -1e9, Status.INFEASIBLE_BOUNDS),
        ("lower", np.inf, Status.INFEASIBLE_BOUNDS),
        ("H", -50.0, Status.NOT_POSITIVE_DEFINITE),
    ],
)
def test_faulty_data_has_its_status_and_a_finite_point(place, value, status, method):
    names = ("H", "q", "C", "row_lower", "row_upper", "lower", "upper")
    data = {name: a.copy() for name, a in zip(names, known(0)[0], strict=True)}
    index = (0,) * data[place].ndim
    data[place][index] = value
    solution = solve(*data.values(), method=method)
    assert solution.status == status
    assert jnp.isfinite(solution.x).all()


def test_an_iteration_limit_is_reported(method):
    solution = solve(*known(0)[0], max_iterations=2, method=method)
    assert solution.status == Status.ITERATION_LIMIT
    assert solution.iterations == 2


def test_a_senseless_iteration_limit_is_refused():
    with pytest.raises(ValueError, match="max_iterations"):
        solve(*known(0)[0], max_iterations=0)


def test_a_senseless_tolerance_is_refused():
    with pytest.raises(ValueError, match="tolerance"):
        solve(*known(0)[0], tolerance=0.0)


@pytest.mark.parametrize("seed", range(30))
def test_the_active_set_method_is_exact_where_rows_depend_on_one_another(seed):
    """Twice the same row, at another scale: at the solution the normals are dependent."""
    (H, q, C, low, high, lower, upper), _, _ = known(seed, equations=seed % 3, fixed=seed % 2)
    C, low, high = C.copy(), low.copy(), high.copy()
    C[5], low[5], high[5] = 3.0 * C[0], 3.0 * low[0], 3.0 * high[0]
    solution = solve(H, 5.0 * q, C, low, high, lower, upper, method="active_set")
    order = np.r_[M : M + N, 0:M]
    sides = [np.r_[a, b][order] for a, b in ((high, upper), (low, lower))]
    sense = np.where(sides[0] == sides[1], 5, 0).astype(np.int32)
    wanted, _, flag, _ = daqp.solve(H, 5.0 * q, C, *sides, sense)
    assert (solution.status == Status.SOLVED) == (flag >= 1)
    if flag >= 1:
        np.testing.assert_allclose(solution.x, wanted, atol=1e-8)
    else:
        assert solution.status == Status.INFEASIBLE


@pytest.fixture(scope="module")
def row_gradients():
    """Gradient of a number that all of x enters, by all seven arguments; compiled per method."""
    weight = jnp.linspace(1.0, 2.0, N)

    def value(method, *problem):
        solution = qp.solve_rows(*problem, method=method)
        return weight @ solution.x

    return jax.jit(value, static_argnums=0), {
        method: jax.jit(jax.grad(partial(value, method), argnums=range(7)))
        for method in qp.ROW_METHODS
    }


@pytest.mark.parametrize("seed", range(6))
def test_derivatives_of_rows_agree_with_finite_differences(row_gradients, method, seed):
    problem = known(seed, equations=1, fixed=1)[0]
    value, gradients = row_gradients
    assert solve(*problem, method="active_set").margin > 1e-3
    slopes = gradients[method](*problem)
    rng = np.random.default_rng(seed)
    directions = [rng.normal(size=a.shape) for a in problem]
    # Equal bounds move together, or nothing feasible is left.
    directions[4] = np.where(problem[3] == problem[4], directions[3], directions[4])
    directions[6] = np.where(problem[5] == problem[6], directions[5], directions[6])
    step = 1e-6
    ahead, behind = (
        value(
            "active_set", *(a + sign * step * d for a, d in zip(problem, directions, strict=True))
        )
        for sign in (1.0, -1.0)
    )
    wanted = (ahead - behind) / (2.0 * step)
    got = sum(jnp.vdot(s, d) for s, d in zip(slopes, directions, strict=True))
    # Central differences of an exact solver: step^2 of curvature and 1e-13 / step of rounding; the
    # interior point finds its multipliers to its tolerance, times the condition of 100.
    tolerance = 1e-6 if method == "active_set" else 1e-5
    np.testing.assert_allclose(got, wanted, rtol=tolerance, atol=tolerance)
