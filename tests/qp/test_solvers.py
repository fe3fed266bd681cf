"""Both solvers on problems with a known answer, against the C solver daqp, and on faulty data."""

from functools import partial

import chex
import daqp
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kjax import qp
from kjax.qp import Status

N = 12
TOLERANCE = {"float32": 1e-5, "float64": 1e-10}  # reachable: rounding leaves 1e-6 and 1e-15


@partial(jax.jit, static_argnames=("method", "tolerance", "max_iterations"))
def solve(H, q, lower, upper, warm=None, **options):
    return qp.solve(qp.prepare(H), q, lower, upper, warm, **options)


@pytest.fixture(params=qp.METHODS)
def method(request):
    return request.param


def cast(arrays, dtype="float64"):
    return [jnp.asarray(a, dtype) for a in arrays]


def pick(tree, index):
    return jax.tree.map(lambda a: a[index], tree)


def independent_residual(H, q, lower, upper, x):
    """Relative KKT residual in numpy: a gradient that no bound holds, against its own terms."""
    H, q, lower, upper, x = (np.asarray(a, np.float64) for a in (H, q, lower, upper, x))
    d = np.diag(H) ** -0.5
    gradient, own = d * (H @ x + q), np.maximum(np.abs(x / d), np.abs(d * q))
    held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
    rounding = 4 * np.sqrt(len(q)) * np.finfo(float).eps
    noise = rounding * max(np.abs(d * q).max(), np.abs(x / d).max())
    excess = np.maximum(np.abs(gradient) - noise, 0.0)
    with np.errstate(over="ignore"):  # what is far off may be infinitely far off
        ratio = np.divide(excess, own, out=np.zeros_like(own), where=own > 0)
    return np.where(held, 0.0, ratio).max()


def error_bound(H, q, x, residual):
    """How far (per entry) a point with this relative residual can be from the minimiser.

    For a strongly convex QP, |x_hat - x_hat*| <= (1 + L) / mu |natural residual| (Pang 1987).
    """
    d = np.diag(H) ** -0.5
    spectrum = np.linalg.eigvalsh(H * np.outer(d, d))
    size = max(np.abs(d * q).max(), np.abs(x / d).max())
    return d * (1 + spectrum[-1]) / spectrum[0] * np.sqrt(len(q)) * residual * size


def assert_within(x, wanted, bound):
    assert (np.abs(np.asarray(x, np.float64) - wanted) <= bound).all()


def test_the_known_minimiser_is_found(random_qp, method, dtype):
    tolerance = TOLERANCE[dtype.name]
    for seed in range(5):
        H, q, lower, upper, x = random_qp(seed)
        data = cast((H, q, lower, upper), dtype)
        solution = solve(*data, method=method, tolerance=tolerance)
        assert solution.status == Status.SOLVED
        assert solution.residual <= tolerance
        assert solution.x.dtype == solution.residual.dtype == dtype
        assert_within(solution.x, x, error_bound(H, q, x, 2 * tolerance))
        active = np.arange(N) % 3 < 2
        bounds = np.where(np.arange(N) % 3 == 0, data[2], data[3])
        # Scaled to x_hat and back: an active bound may come back one rounding inside the box.
        rounding = 2 * np.finfo(dtype).eps
        np.testing.assert_allclose(solution.x[active], bounds[active], rtol=rounding)
        assert (data[2] <= solution.x).all()
        assert (solution.x <= data[3]).all()


def test_daqp_finds_the_same_minimiser(method):
    rng = np.random.default_rng(0)
    for _ in range(20):
        factor = rng.normal(size=(N, N))
        H = factor @ np.diag(np.geomspace(1.0, 100.0, N)) @ factor.T + 0.1 * np.eye(N)
        q = 30 * rng.normal(size=N)
        lower = rng.uniform(-1.0, 0.5, N)
        upper = lower + rng.uniform(0.0, 1.5, N)
        wanted, _, flag, _ = daqp.solve(H, q, np.zeros((0, N)), upper, lower, primal_tol=1e-10)
        assert flag == 1
        solution = solve(*cast((H, q, lower, upper)), method=method, tolerance=1e-10)
        assert solution.status == Status.SOLVED
        # Our own miss, and a hundred roundings of daqp's (condition up to 1e6).
        assert_within(solution.x, wanted, error_bound(H, q, wanted, 1e-10) + 1e-8)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    factor=st.lists(st.floats(-1, 1), min_size=16, max_size=16),
    q=st.lists(st.floats(-10, 10), min_size=4, max_size=4),
    low=st.lists(st.one_of(st.just(-np.inf), st.floats(-3, 3)), min_size=4, max_size=4),
    width=st.lists(
        st.one_of(st.just(0.0), st.just(np.inf), st.floats(0, 3)), min_size=4, max_size=4
    ),
    method=st.sampled_from(qp.METHODS),
)
def test_a_solution_is_within_bounds_and_stationary(factor, q, low, width, method):
    factor, q = np.reshape(factor, (4, 4)), np.array(q)
    H = factor @ factor.T + 0.05 * np.eye(4)
    lower, width = np.array(low), np.array(width)
    bounded = np.isfinite(lower)
    upper = np.where(bounded, np.where(bounded, lower, 0.0) + width, width)
    solution = solve(*cast((H, q, lower, upper)), method=method, tolerance=1e-8)
    assert solution.status == Status.SOLVED
    assert (lower <= solution.x).all()
    assert (solution.x <= upper).all()
    if np.abs(q).max() > 1e-100 or np.abs(solution.x).max() > 1e-100:  # else zero by zero
        # The tolerance, and rounding of x = d x_hat.
        assert independent_residual(H, q, lower, upper, solution.x) <= 1.001e-8


@pytest.mark.parametrize("exponent", [-13, -4, 4, 13])
def test_scaling_the_cost_by_a_power_of_four_changes_no_bit(random_qp, method, dtype, exponent):
    """Powers of four have exact roots, so even the iterates must be identical."""
    H, q, lower, upper, _ = cast(random_qp(2), dtype)
    options = {"method": method, "tolerance": TOLERANCE[dtype.name]}
    plain = solve(H, q, lower, upper, **options)
    assert plain.iterations > 2
    factor = 4.0**exponent  # 6.7e7 and back
    scaled = solve(factor * H, factor * q, lower, upper, **options)
    chex.assert_trees_all_equal(scaled.multipliers / factor, plain.multipliers)
    same = plain._replace(multipliers=None)
    chex.assert_trees_all_equal(scaled._replace(multipliers=None), same)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 1000),
    factor=st.one_of(st.sampled_from([1e-8, 1e8]), st.floats(1e-8, 1e8)),
    method=st.sampled_from(qp.METHODS),
)
def test_scaling_the_cost_changes_neither_minimiser_nor_residual(random_qp, seed, factor, method):
    H, q, lower, upper, x = random_qp(seed)
    plain = solve(*cast((H, q, lower, upper)), method=method, tolerance=1e-10)
    scaled = solve(*cast((factor * H, factor * q, lower, upper)), method=method, tolerance=1e-10)
    assert scaled.status == plain.status == Status.SOLVED
    # The iterates differ by rounding, 1e-16 to 1e-13, amplified by the condition; the count of
    # iterations may differ by one where the residual meets the tolerance to that precision.
    assert abs(int(scaled.iterations) - int(plain.iterations)) <= 1
    if scaled.iterations == plain.iterations:
        np.testing.assert_allclose(scaled.residual, plain.residual, rtol=0, atol=1e-13)
        np.testing.assert_allclose(scaled.x, plain.x, rtol=0, atol=1e-12)
    assert_within(scaled.x, x, error_bound(H, q, x, 2e-10))


def test_the_units_of_the_variables_change_no_bit(random_qp, method):
    H, q, lower, upper, _ = cast(random_qp(4))
    unit = jnp.asarray(2.0 ** np.arange(-18, 18, 3))
    plain = solve(H, q, lower, upper, method=method, tolerance=1e-10)
    other = solve(
        H * unit[:, None] * unit[None],
        q * unit,
        lower / unit,
        upper / unit,
        method=method,
        tolerance=1e-10,
    )
    np.testing.assert_array_equal(other.x * unit, plain.x)
    assert other.residual == plain.residual


def test_without_active_bounds_the_answer_is_direct(random_qp, method, dtype):
    H, q, _, _, _ = random_qp(5)
    unbounded = np.full(N, np.inf)
    solution = solve(*cast((H, q, -unbounded, unbounded), dtype), method=method, tolerance=1e-5)
    assert solution.status == Status.SOLVED
    assert solution.iterations == 0
    # Rounding times the condition of the scaled Hessian, about 100, and a few sums of 12 terms.
    wanted = np.linalg.solve(H, -q)
    tolerance = 1e4 * np.finfo(dtype).eps * np.abs(wanted).max()
    np.testing.assert_allclose(solution.x, wanted, rtol=0, atol=tolerance)


@pytest.mark.parametrize("fixed", [slice(0, 4), slice(0, N)])
def test_a_variable_with_equal_bounds_takes_exactly_that_value(random_qp, method, dtype, fixed):
    H, q, lower, upper, x = random_qp(6)
    lower[fixed] = upper[fixed] = np.linspace(-0.3, 0.4, N)[fixed]
    data = cast((H, q, lower, upper), dtype)
    solution = solve(*data, method=method, tolerance=TOLERANCE[dtype.name])
    assert solution.status == Status.SOLVED
    np.testing.assert_array_equal(solution.x[fixed], data[2][fixed])
    rest = np.setdiff1d(np.arange(N), np.arange(N)[fixed])
    if rest.size:
        # The same problem with the fixed variables substituted, by daqp.
        linear = q[rest] + H[np.ix_(rest, np.arange(N)[fixed])] @ lower[fixed]
        reduced = np.ascontiguousarray(H[np.ix_(rest, rest)])
        wanted, _, flag, _ = daqp.solve(
            reduced, linear, np.zeros((0, rest.size)), upper[rest], lower[rest], primal_tol=1e-10
        )
        assert flag == 1
        bound = error_bound(H, q, x, 2 * TOLERANCE[dtype.name])[rest]
        assert_within(solution.x[rest], wanted, bound + 1e-8)


def test_without_a_linear_term_the_answer_is_the_point_of_the_box_nearest_to_the_origin(
    method, dtype
):
    lower, upper = -np.ones(N), np.ones(N)
    lower[0], upper[1] = 0.5, -0.25
    solution = solve(*cast((np.eye(N), np.zeros(N), lower, upper), dtype), method=method)
    assert solution.status == Status.SOLVED
    wanted = np.zeros(N)
    wanted[:2] = 0.5, -0.25
    np.testing.assert_array_equal(solution.x, wanted)
    origin = solve(*cast((np.eye(N), np.zeros(N), -np.ones(N), np.ones(N)), dtype), method=method)
    assert origin.status == Status.SOLVED
    np.testing.assert_array_equal(origin.x, 0.0)
    assert origin.residual == 0.0


def singular(H):
    vector = np.random.default_rng(0).normal(size=N)
    vector /= np.linalg.norm(vector)
    projector = np.eye(N) - np.outer(vector, vector)
    return projector @ H @ projector


def at(index, value):
    def change(array):
        array = array.copy()
        array[index] = value
        return array

    return change


# Name -> which of (H, q, lower, upper) is changed, how, and the status it must bring.
FAULTS = {
    "NaN in q": ({"q": at(3, np.nan)}, Status.NON_FINITE),
    "infinity in q": ({"q": at(3, -np.inf)}, Status.NON_FINITE),
    "NaN in H": ({"H": at((2, 5), np.nan)}, Status.NON_FINITE),
    "NaN on the diagonal of H": ({"H": at((2, 2), np.nan)}, Status.NON_FINITE),
    "infinity in H": ({"H": at((2, 2), np.inf)}, Status.NON_FINITE),
    "NaN in lower": ({"lower": at(1, np.nan)}, Status.NON_FINITE),
    "NaN in upper": ({"upper": at(1, np.nan)}, Status.NON_FINITE),
    "lower above upper": ({"lower": at(7, 50.0)}, Status.INFEASIBLE_BOUNDS),
    "lower is +inf": ({"lower": at(7, np.inf)}, Status.INFEASIBLE_BOUNDS),
    "both are +inf": (
        {"lower": at(7, np.inf), "upper": at(7, np.inf)},
        Status.INFEASIBLE_BOUNDS,
    ),
    "upper is -inf": ({"upper": at(7, -np.inf)}, Status.INFEASIBLE_BOUNDS),
    "singular H": ({"H": singular}, Status.NOT_POSITIVE_DEFINITE),
    "zero H": ({"H": np.zeros_like}, Status.NOT_POSITIVE_DEFINITE),
    "zero on the diagonal of H": ({"H": at((4, 4), 0.0)}, Status.NOT_POSITIVE_DEFINITE),
    "indefinite H": ({"H": lambda H: H - 5 * np.eye(N)}, Status.NOT_POSITIVE_DEFINITE),
    "negative definite H": ({"H": np.negative}, Status.NOT_POSITIVE_DEFINITE),
    "NaN in q and lower above upper": (
        {"q": at(3, np.nan), "lower": at(7, 50.0)},
        Status.NON_FINITE,
    ),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faulty_data_gets_its_status_and_a_finite_point(random_qp, method, dtype, case):
    changes, status = FAULTS[case]
    data = dict(zip(("H", "q", "lower", "upper"), random_qp(0)[:4], strict=True))
    for name, change in changes.items():
        data[name] = change(data[name])
    options = {"method": method, "tolerance": TOLERANCE[dtype.name]}
    solution = solve(*cast(data.values(), dtype), np.full(N, 0.3, dtype), **options)
    assert solution.status == status
    assert solution.iterations == 0
    assert np.isinf(solution.residual)
    x = np.asarray(solution.x, np.float64)
    assert np.isfinite(x).all()
    lower, upper = (np.asarray(data[name].astype(dtype), np.float64) for name in ("lower", "upper"))
    sane = (lower <= upper) & (lower < np.inf) & (upper > -np.inf)
    assert (lower[sane] <= x[sane]).all()
    assert (x[sane] <= upper[sane]).all()


def test_a_bad_problem_in_a_batch_leaves_its_neighbours_alone(random_qp, method):
    problems = [random_qp(seed)[:4] for seed in range(4)]
    good = [jnp.stack([jnp.asarray(p[i]) for p in problems]) for i in range(4)]
    batched = jax.jit(jax.vmap(partial(solve, method=method, tolerance=1e-10)))
    healthy = batched(*good)
    np.testing.assert_array_equal(healthy.status, Status.SOLVED)
    for seed in range(4):
        single = solve(*cast(problems[seed]), method=method, tolerance=1e-10)
        # Batched sums round differently: 2e-16 on values of order one, times the condition of 100.
        np.testing.assert_allclose(healthy.x[seed], single.x, rtol=0, atol=1e-12)
    for bad, status in (
        ([good[0], good[1].at[1].set(jnp.nan), *good[2:]], Status.NON_FINITE),
        ([*good[:2], good[2].at[1, 0].set(99.0), good[3]], Status.INFEASIBLE_BOUNDS),
        ([good[0].at[1].set(-good[0][1]), *good[1:]], Status.NOT_POSITIVE_DEFINITE),
    ):
        spoilt = batched(*bad)
        assert spoilt.status[1] == status
        for seed in (0, 2, 3):
            chex.assert_trees_all_equal(pick(spoilt, seed), pick(healthy, seed))


@pytest.mark.parametrize("method", ["admm", "projected_gradient"])  # a tableau wants a tableau
def test_a_warm_start_at_the_solution_takes_no_iteration(random_qp, method, dtype):
    *data, x = cast(random_qp(1), dtype)
    options = {"method": method, "tolerance": TOLERANCE[dtype.name]}
    cold, warm = solve(*data, jnp.zeros_like(x), **options), solve(*data, x, **options)
    assert cold.iterations > 0
    assert warm.iterations == 0
    assert warm.status == Status.SOLVED
    # x goes to scaled units and back: two roundings.
    np.testing.assert_allclose(warm.x, x, rtol=4 * np.finfo(dtype).eps)


@pytest.mark.parametrize("value", [1e6, np.nan, np.inf])
def test_a_useless_warm_start_does_no_harm(random_qp, method, value):
    *data, x = cast(random_qp(1))
    options = {"method": method, "tolerance": 1e-10}
    solution = solve(*data, jnp.full(N, value), **options)
    assert solution.status == Status.SOLVED
    assert_within(solution.x, x, error_bound(data[0], data[1], x, 2e-10))


@pytest.mark.parametrize("limit", [1, 3])
def test_an_iteration_limit_is_reported_with_a_feasible_point(random_qp, method, limit):
    data = random_qp(0, condition=1e4)[:4]
    solution = solve(*cast(data), method=method, tolerance=1e-12, max_iterations=limit)
    assert solution.status == Status.ITERATION_LIMIT
    assert solution.iterations == limit
    assert (data[2] <= solution.x).all()
    assert (solution.x <= data[3]).all()
    # The residual is that of the point that came back; it is of order 0.01, rounding 1e-15.
    np.testing.assert_allclose(independent_residual(*data, solution.x), solution.residual, 1e-12)


def test_at_the_iteration_limit_the_point_is_the_best_so_far(random_qp, method):
    """As ``STATUS_TEXT`` says: with more iterations the residual never grows."""
    for seed in range(10):
        data = cast(random_qp(seed, condition=1e4)[:4])
        residuals = [
            float(solve(*data, method=method, tolerance=1e-12, max_iterations=limit).residual)
            for limit in (1, 3, 8)
        ]
        assert residuals == sorted(residuals, reverse=True)


def test_the_solver_traces_once_for_all_data_of_a_shape(random_qp, method):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def traced(H, q, lower, upper):
        return qp.solve(qp.prepare(H), q, lower, upper, method=method)

    for seed in range(3):
        traced(*cast(random_qp(seed)[:4]))


def test_a_solution_has_the_same_shapes_and_dtypes_whatever_its_status(random_qp, method, dtype):
    H, q, lower, upper, _ = cast(random_qp(0), dtype)
    options = {"method": method, "tolerance": TOLERANCE[dtype.name]}
    good, bad = solve(H, q, lower, upper, **options), solve(-H, q, lower, upper, **options)
    chex.assert_trees_all_equal_shapes_and_dtypes(good, bad)
    assert good.status.dtype == good.iterations.dtype == jnp.int32


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "simplex"}, r"method .*admm.*projected_gradient.*'simplex'"),
        ({"max_iterations": 0}, r"max_iterations .*0"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(random_qp, monkeypatch, options, message):
    # The type check of the tests would speak up first; users do not have it.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match=message):
        solve(*cast(random_qp(0)[:4]), **options)
