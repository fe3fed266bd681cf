"""Nothing is called solved that is not: immovable rows, all scales, linear and unbounded programs.

The judges are HiGHS, known KKT points, and plain numpy.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

from kjax import qp
from kjax.qp import MethodUsed, Status

INF = np.inf
N, M = 6, 8  # variables and rows that every problem is filled up to, so that few are compiled
compiled = jax.jit(qp.solve_rows, static_argnames=("method",))


def solve(H, q, C, low, high, lower, upper, warm=None, *, method="auto"):
    """``qp.solve_rows`` of the problem with variables fixed at 0 and rows without bounds added."""
    traced = any(isinstance(a, jax.core.Tracer) for a in (H, q))
    xp, (m, n) = jnp if traced else np, np.shape(C)
    H, q, C, low, high, lower, upper = map(xp.asarray, (H, q, C, low, high, lower, upper))
    rest = np.arange(N) >= n
    # As curved as the rest of H is: a linear program stays one.
    wide = xp.pad(H, (0, N - n)) + xp.trace(H) / n * np.diag(rest).astype(H.dtype)
    low, high = (xp.pad(a, (0, M - m), constant_values=s) for a, s in ((low, -INF), (high, INF)))
    q, lower, upper = (xp.pad(a, (0, N - n)) for a in (q, lower, upper))
    C = xp.pad(C, ((0, M - m), (0, N - n)))
    solution = compiled(wide, q, C, low, high, lower, upper, warm, method=method)
    x, y = (a if traced else np.asarray(a) for a in (solution.x, solution.multipliers))
    return solution._replace(x=x[:n], multipliers=xp.concatenate([y[:m], y[M : M + n]]))


@partial(jax.jit, static_argnames="method")
def slope_by_q(H, q, *rest, method):
    """Of the sum of the solution."""
    return jax.grad(lambda q: solve(H, q, *rest, method=method).x.sum())(q)


@partial(jax.jit, static_argnames="method")
def solve_box(H, q, lower, upper, method):
    return qp.solve(qp.prepare(H), q, lower, upper, method=method)


@pytest.fixture(params=qp.ROW_METHODS)
def method(request):
    return request.param


@pytest.fixture(params=["auto", "interior_point", "admm"])
def semidefinite_method(request):
    return request.param


IMMOVABLE = {
    "a zero row 0 >= 1": ([[0.0, 0.0]] * 2, [1.0, 0.0], [INF, 0.0], [-1.0, -1.0], [1.0, 1.0]),
    "x1 + x2 >= 5, both fixed at 0": (
        [[1.0, 1.0], [0.0, 0.0]], [5.0, 0.0], [INF, 0.0], [0.0, 0.0], [0.0, 0.0],
    ),
    "friction of a swing foot held at 9": (
        [[1.0, -0.6], [-1.0, -0.6]], [-INF] * 2, [0.0] * 2, [9.0, 0.0], [9.0, 0.0],
    ),
    "beside a row that moves": (
        [[1.0, 1.0], [0.0, 1.0]], [-9.0, 2.0], [9.0, 3.0], [-1.0, 1.0], [1.0, 1.0],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", IMMOVABLE)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_row_that_nothing_can_move_is_infeasible_where_it_breaks_its_bound(case, method, dtype):
    data = [np.asarray(a, dtype) for a in IMMOVABLE[case]]
    solution = solve(np.eye(2, dtype=dtype), np.ones(2, dtype), *data, method=method)
    assert solution.status == Status.INFEASIBLE
    assert solution.primal > 0.1
    assert jnp.isfinite(solution.x).all()


def test_a_row_that_nothing_can_move_has_no_effect_where_it_holds(method):
    C = np.array([[0.0, 0.0], [0.0, 1.0]])
    low, high = np.array([-1.0, 0.25]), np.array([0.0, 0.25])
    lower, upper = np.array([-1.0, 0.25]), np.array([1.0, 0.25])
    solution = solve(np.eye(2), np.array([3.0, 0.0]), C, low, high, lower, upper, method=method)
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, [-1.0, 0.25], rtol=0, atol=1e-12)


def linear_program(seed, n=6, m=8):
    rng = np.random.default_rng(seed)
    C, q = rng.normal(size=(m, n)), rng.normal(size=n)
    middle = C @ rng.uniform(-1, 1, n)
    return q, C, middle - rng.uniform(0, 2, m), middle + rng.uniform(0, 2, m), -5.0, 5.0


def highs(q, C, low, high, lower, upper):
    found = linprog(
        q, A_ub=np.vstack([C, -C]), b_ub=np.r_[high, -low], bounds=[(lower, upper)] * len(q)
    )
    assert found.status == 0
    return found.fun


def assert_feasible(C, low, high, lower, upper, x, tolerance=1.1e-9):
    value, terms = C @ x, np.abs(C) @ np.abs(x)
    assert (value - high <= tolerance * (np.abs(high) + terms)).all()
    assert (low - value <= tolerance * (np.abs(low) + terms)).all()
    assert ((lower <= x) & (x <= upper)).all()


@pytest.mark.parametrize("seed", range(20))
def test_linear_programs_are_solved(seed, semidefinite_method):
    q, C, low, high, lower, upper = linear_program(seed)
    n = len(q)
    box = np.full(n, lower), np.full(n, upper)
    solution = solve(np.zeros((n, n)), q, C, low, high, *box, method=semidefinite_method)
    assert solution.status == Status.SOLVED
    x = np.asarray(solution.x)
    assert_feasible(C, low, high, lower, upper, x)
    best = highs(q, C, low, high, lower, upper)
    np.testing.assert_allclose(q @ x, best, rtol=0, atol=1e-8 * np.abs(q) @ np.abs(x))


@pytest.mark.parametrize("exponent", [-14, -12, -10, -9, -7, -3, 3, 7, 14])
def test_whatever_the_size_of_h_beside_q_and_the_box(exponent, method):
    """With a small H the problem is a linear program but for that, and HiGHS knows its cost."""
    for seed in range(4):
        q, C, low, high, lower, upper = linear_program(seed)
        n = len(q)
        rng = np.random.default_rng(seed)
        factor = rng.normal(size=(n, n))
        H = 10.0**exponent * (factor @ factor.T + np.eye(n))
        box = np.full(n, lower), np.full(n, upper)
        solution = solve(H, q, C, low, high, *box, method=method)
        assert solution.status == Status.SOLVED
        x = np.asarray(solution.x)
        assert_feasible(C, low, high, lower, upper, x)
        # Lower bound of the cost: the multipliers', H positive definite.
        y = np.asarray(solution.multipliers)
        sides = np.where(y > 0, np.r_[high, box[1]], np.r_[low, box[0]])
        slope = q + C.T @ y[: len(C)] + y[len(C) :]
        bound = -0.5 * slope @ np.linalg.solve(H, slope) - y @ sides
        cost = 0.5 * x @ H @ x + q @ x
        assert cost - bound <= 1e-7 * (x @ H @ x + np.abs(q) @ np.abs(x))
        if exponent <= -9:
            best = highs(q, C, low, high, lower, upper)
            np.testing.assert_allclose(q @ x, best, rtol=1e-6)


@pytest.mark.parametrize("exponent", [-14, -10, -7, 7, 14])
@pytest.mark.parametrize("method", qp.METHODS)
def test_a_box_is_solved_whatever_the_size_of_h(exponent, method):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        factor = rng.normal(size=(5, 5))
        H = 10.0**exponent * (factor @ factor.T + np.eye(5))
        q = rng.normal(size=5) * 10.0 ** rng.uniform(-8, 0, 5)
        solution = solve_box(H, q, np.full(5, -5.0), np.full(5, 5.0), method)
        assert solution.status == Status.SOLVED
        x = np.asarray(solution.x)
        gradient = H @ x + q
        held = ((x == -5.0) & (gradient > 0)) | ((x == 5.0) & (gradient < 0))
        terms = np.abs(H) @ np.abs(x) + np.abs(q)
        assert (np.abs(gradient[~held]) <= 1e-9 * terms[~held] + 1e-14 * np.abs(q).max()).all()


UNBOUNDED = {
    "no box": (np.zeros((2, 2)), [1.0, 1.0], np.full(2, -INF), np.full(2, INF)),
    "open to one side": (np.zeros((2, 2)), [1.0, 1.0], np.full(2, -INF), np.zeros(2)),
    "along what H does not see": (
        np.array([[1.0, -1.0], [-1.0, 1.0]]), [1.0, 1.0], np.full(2, -INF), np.full(2, INF),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", UNBOUNDED)
@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_an_unbounded_cost_has_its_status_a_finite_point_and_no_derivative(
    case, scale, semidefinite_method
):
    H, q, lower, upper = UNBOUNDED[case]
    C = np.array([[1.0, -1.0]])
    row = np.array([-1.0]), np.array([1.0])
    data = (H, scale * np.array(q), C, *row, lower, upper)
    solution = solve(*data, method=semidefinite_method)
    assert solution.status == Status.UNBOUNDED
    assert jnp.isfinite(solution.x).all()
    assert_feasible(C, *row, lower, upper, np.asarray(solution.x))
    np.testing.assert_array_equal(slope_by_q(*data, method=semidefinite_method), 0.0)


def test_the_same_problem_with_a_floor_is_solved(semidefinite_method):
    data = (np.zeros((2, 2)), np.ones(2), np.array([[1.0, -1.0]]), np.array([-1.0]), np.ones(1))
    solution = solve(*data, np.array([-2.0, -INF]), np.full(2, INF), method=semidefinite_method)
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, [-2.0, -3.0], rtol=0, atol=1e-8)


def test_auto_says_which_method_it_took_for_each_member_of_a_batch():
    q, C, low, high, lower, upper = linear_program(0)
    n = len(q)
    H = np.stack([np.eye(n), np.zeros((n, n)), np.diag([1.0] * (n - 1) + [0.0])])
    box = np.full(n, lower), np.full(n, upper)
    batch = jax.jit(jax.vmap(lambda H: solve(H, q, C, low, high, *box)))(H)
    assert (np.asarray(batch.status) == Status.SOLVED).all()
    wanted = [MethodUsed.ACTIVE_SET, MethodUsed.INTERIOR_POINT, MethodUsed.INTERIOR_POINT]
    np.testing.assert_array_equal(batch.method, wanted)


def test_neither_units_nor_the_size_of_the_cost_change_the_verdict(method):
    rng = np.random.default_rng(0)
    q, C, low, high, lower, upper = linear_program(1)
    n = len(q)
    factor = rng.normal(size=(n, n))
    H = factor @ factor.T + 0.1 * np.eye(n)
    box = np.full(n, lower), np.full(n, upper)
    plain = solve(H, q, C, low, high, *box, method=method)
    unit, row, cost = 2.0 ** rng.integers(-8, 9, n), 2.0 ** rng.integers(-8, 9, len(C)), 2.0**20
    other = solve(
        cost * H * unit[:, None] * unit,
        cost * q * unit,
        C * unit * row[:, None],
        low * row,
        high * row,
        *(b / unit for b in box),
        method=method,
    )
    assert plain.status == other.status == Status.SOLVED
    np.testing.assert_allclose(other.x * unit, plain.x, rtol=0, atol=1e-7)


def test_admm_starts_from_a_point():
    q, C, low, high, lower, upper = linear_program(2)
    n = len(q)
    data = (np.eye(n), q, C, low, high, np.full(n, lower), np.full(n, upper))
    cold = solve(*data, method="admm")
    warm = solve(*data, cold.x, method="admm")
    assert warm.status == cold.status == Status.SOLVED
    assert warm.iterations <= cold.iterations
    np.testing.assert_allclose(warm.x, cold.x, rtol=0, atol=1e-8)
    useless = solve(*data, np.full(n, np.nan), method="admm")
    assert useless.status == Status.SOLVED


def test_a_useless_tolerance_of_rows_is_none_in_float32(method):
    q, C, low, high, lower, upper = (np.asarray(a, np.float32) for a in linear_program(3))
    n = len(q)
    solve32 = partial(solve, method=method)
    box = np.full(n, lower), np.full(n, upper)
    solution = solve32(np.eye(n, dtype=np.float32), q, C, low, high, *box)
    assert solution.status == Status.SOLVED
    assert_feasible(C, low, high, lower, upper, np.asarray(solution.x), tolerance=1e-5)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_at_the_tip_of_all_friction_cones_the_answer_is_no_force(dtype, method):
    """Every term of every row vanishes there: what rounding leaves of 0 must not be judged."""
    n = 6
    C = np.kron(np.eye(n // 2), [[1.0, -0.6], [-1.0, -0.6]]).astype(dtype)
    q = np.tile([3.0, 40.0], n // 2).astype(dtype)
    factor = np.random.default_rng(0).normal(size=(n, n))
    H = (factor @ factor.T + np.eye(n)).astype(dtype)
    rows = np.full(n, -INF, dtype), np.zeros(n, dtype)
    box = np.tile([-60.0, 0.0], n // 2).astype(dtype), np.tile([60.0, 160.0], n // 2).astype(dtype)
    solution = solve(H, q, C, *rows, *box, method=method)
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, 0.0, atol=1e-4 if dtype == "float32" else 1e-10)


@pytest.mark.parametrize("unit", [1e-21, 1e20, 1e-165, 1e160])
def test_the_unit_of_a_row_changes_nothing_however_small_or_large(unit, method):
    """Squares of its entries are 0 or infinite."""
    dtype = "float32" if 1e-30 < unit < 1e30 else "float64"
    C, bound = np.full((1, 2), unit, dtype), np.array([unit], dtype)
    box = np.full(2, -5.0, dtype), np.full(2, 5.0, dtype)
    solution = solve(
        np.eye(2, dtype=dtype), np.zeros(2, dtype), C, bound, np.array([INF], dtype), *box,
        method=method,
    )  # fmt: skip
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, 0.5, atol=1e-4 if dtype == "float32" else 1e-8)


# Drawn by the benchmark's count (seed 0): tiny curvature lets the point go 1e8 to 1e12 units out,
# where rounding of a row's terms is larger than the gap that no point can close.
FAR_OUT = {
    "two rows, 16 (x + y) >= -43.84 and -0.5 (x + y) >= 1.37": (
        [[1.9367797832215135e-16, -7.903028851346405e-17],
         [-7.903028851346405e-17, 3.2280532500320025e-17]],
        [2.3500162132473736e-06, 2.121842276426989e-06],
        [[16.0, 16.0], [-0.5, -0.5], [-0.6958901335311157, 1.173704779870729]],
        [-43.83697582168227, 1.371117618958628, -INF], [-18.01453742130406, INF, INF],
        [-INF, -1.1259085888315035], [1.3463596309232722, INF],
    ),
    "y >= 0.6355 and y <= 0.6314": (
        [[4.907156460623877e-19, -1.2929016645859098e-18],
         [-1.2929016645859098e-18, 3.4098921619866742e-18]],
        [-4.4764733980653745e-06, -1.9444513427045178e-05],
        [[0.0, 0.14283469156314038], [0.0, 0.42850407468942114], [0.0, -1.142677532505123]],
        [0.09077373293688046, 0.2723211988106414, -0.7214949485224169],
        [0.24965273485070077, INF, INF],
        [0.304637544981851, -INF], [INF, 0.6355160076552813],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FAR_OUT)
def test_a_point_far_out_does_not_hide_a_contradiction_in_its_rounding(case, semidefinite_method):
    found = solve(*map(np.array, FAR_OUT[case]), method=semidefinite_method)
    assert Status(int(found.status)) == Status.INFEASIBLE


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e12])
def test_a_variable_that_nothing_meets_does_not_loosen_the_rows_of_others(
    unit, semidefinite_method
):
    """The judge forgives what rounding leaves of the largest terms: not those of others."""
    C, q = np.array([[-95.954426622771, 0.0]]), np.array([-4.502643100293e9, 0.0])
    low, high = np.array([0.098066975892]), np.array([2.095546898996])
    lower, upper = np.array([-1.02e-3, -unit]), np.array([6.675e-2, 5.0 * unit])
    problem = np.zeros((2, 2)), q, C, low, high, lower, upper
    found = solve(*problem, method=semidefinite_method)
    assert Status(int(found.status)) == Status.INFEASIBLE  # it needs x <= -1.022e-3
    lower[0] = -1.022016173130e-03
    found = solve(*problem, method=semidefinite_method)
    assert Status(int(found.status)) == Status.SOLVED
    x = float(found.x[0])
    assert C[0, 0] * x >= low[0] * (1 - 2.2e-9)
