"""Rows of blocks: the same points as with the whole matrix, whether rows are active or not."""

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag

from kjax import qp
from kjax.qp import BlockRows, Status

F, R, B = 4, 5, 3  # blocks, rows and variables of each
N, M = F * B, F * R
solve = jax.jit(qp.solve_block_rows, static_argnames=("tolerance", "max_iterations"))
dense = jax.jit(qp.solve_rows, static_argnames="method")


def problem(seed, *, tight):
    """Data of a random QP, its rows and box around 0; ``tight`` is the part of q that is left out.

    With tight = 0 the unconstrained minimiser is 0, well within all of them.
    """
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(N, N))
    H = factor @ factor.T + np.eye(N)
    q = 30.0 * tight * rng.normal(size=N)
    matrix = rng.normal(size=(F, R, B))
    low, high = -rng.uniform(0.1, 1.0, (F, R)), rng.uniform(0.1, 1.0, (F, R))
    low[rng.random((F, R)) < 0.3] = -np.inf
    high[rng.random((F, R)) < 0.3] = np.inf
    return H, q, BlockRows(matrix, low, high), -rng.uniform(0.5, 2, N), rng.uniform(0.5, 2, N)


def by_daqp(H, q, rows, lower, upper):
    C = block_diag(*rows.matrix)
    high, low = (np.clip(np.r_[a, b.ravel()], -1e30, 1e30)
                 for a, b in ((upper, rows.high), (lower, rows.low)))  # fmt: skip
    x, _, flag, info = daqp.solve(H, q, C, high, low, np.zeros(M + N, np.int32))
    assert flag == 1
    lam = np.asarray(info["lam"])
    return x, np.r_[lam[N:], lam[:N]]


@pytest.mark.parametrize("tight", [0.003, 1.0])
@pytest.mark.parametrize("seed", range(6))
def test_it_agrees_with_daqp_whether_rows_are_active_or_not(seed, tight):
    data = problem(seed, tight=tight)
    solution = solve(*data)
    x, multipliers = by_daqp(*data)
    assert solution.status == Status.SOLVED
    assert (solution.iterations > 0) == (np.abs(multipliers).max() > 0)
    np.testing.assert_allclose(solution.x, x, atol=1e-7)
    np.testing.assert_allclose(solution.multipliers, multipliers, atol=1e-6)
    H, q, rows, *box = data
    C = block_diag(*rows.matrix)
    whole = dense(H, q, C, rows.low.ravel(), rows.high.ravel(), *box, method="active_set")
    np.testing.assert_allclose(solution.margin, whole.margin, rtol=1e-6)


def test_a_batch_in_which_some_need_rows_equals_single_calls():
    problems = [problem(seed, tight=(0.003, 1.0)[seed % 3 == 0]) for seed in range(20)]
    batch = jax.vmap(solve)(*jax.tree.map(lambda *a: jnp.stack(a), *problems))
    assert {int(i) > 0 for i in batch.iterations} == {True, False}
    for i, data in enumerate(problems):
        np.testing.assert_allclose(batch.x[i], solve(*data).x, rtol=0, atol=1e-10)


@pytest.mark.parametrize("tight", [0.003, 1.0])
def test_its_derivative_agrees_with_finite_differences(tight):
    data = problem(1, tight=tight)
    rng = np.random.default_rng(9)
    change = jax.tree.map(lambda a: np.where(np.isfinite(a), rng.normal(size=np.shape(a)), 0), data)

    def moved(t):
        return solve(*jax.tree.map(lambda a, d: jnp.asarray(a) + t * d, data, change))

    point, slope = jax.jvp(jax.jit(lambda t: moved(t)._replace(status=0, iterations=0, method=0)),
                           (0.0,), (1.0,))  # fmt: skip
    h = 1e-5
    for name in ("x", "multipliers"):
        below, above = [np.asarray(getattr(moved(t), name)) for t in (-h, h)]
        np.testing.assert_allclose(
            getattr(slope, name), (above - below) / (2 * h), rtol=1e-4, atol=1e-5
        )
    assert np.abs(slope.x).max() > 1e-3
    assert point.primal <= 1e-9


def test_a_fixed_variable_and_a_row_that_nothing_can_move():
    H, q, rows, lower, upper = problem(2, tight=0.003)
    lower[0] = upper[0] = 0.25
    x, _ = by_daqp(H, q, rows, lower, upper)
    np.testing.assert_allclose(solve(H, q, rows, lower, upper).x, x, atol=1e-7)
    rows.matrix[1, 0], rows.low[1, 0], rows.high[1, 0] = 0.0, 1.0, np.inf
    assert solve(H, q, rows, lower, upper).status == Status.INFEASIBLE


@pytest.mark.parametrize(
    ("place", "value", "status"),
    [
        ("H", np.nan, Status.NON_FINITE),
        ("q", np.inf, Status.NON_FINITE),
        ("matrix", np.nan, Status.NON_FINITE),
        ("low", np.nan, Status.NON_FINITE),
        ("upper", -1e9, Status.INFEASIBLE_BOUNDS),
        ("H", -50.0, Status.NOT_POSITIVE_DEFINITE),
    ],
)
def test_faulty_data_has_its_status_and_a_finite_point(place, value, status):
    H, q, rows, lower, upper = problem(0, tight=0.003)
    array = {"H": H, "q": q, "matrix": rows.matrix, "low": rows.low, "upper": upper}[place]
    array[(0,) * array.ndim] = value
    solution = solve(H, q, rows, lower, upper)
    assert solution.status == status
    assert np.isfinite(solution.x).all()


@pytest.mark.parametrize("factor", [1e-10, 1e10])
def test_neither_the_size_of_the_cost_nor_units_matter(factor):
    H, q, rows, lower, upper = problem(3, tight=0.003)
    x = np.asarray(solve(H, q, rows, lower, upper).x)
    units = np.geomspace(1e-3, 1e3, N)
    scaled = solve(
        factor * H * units[:, None] * units, factor * q * units,
        rows._replace(matrix=rows.matrix * units.reshape(F, 1, B)), lower / units, upper / units,
    )  # fmt: skip
    assert scaled.status == Status.SOLVED
    assert scaled.iterations == 0
    np.testing.assert_allclose(scaled.x * units, x, rtol=0, atol=1e-9)


def test_in_float32_it_is_as_good_as_float32_lets_it_be():
    data = problem(4, tight=1.0)
    x, _ = by_daqp(*data)
    small = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), data)
    solution = solve(*small, tolerance=1e-4)
    assert solution.x.dtype == jnp.float32
    assert solution.status == Status.SOLVED
    np.testing.assert_allclose(solution.x, x, atol=1e-3)


def test_what_makes_no_sense_is_refused():
    H, q, rows, lower, upper = problem(0, tight=0.003)
    short = BlockRows(*(a[1:] for a in rows))
    with pytest.raises(ValueError, match="rows: wanted blocks of all 12 variables, got 3 of 3"):
        solve(H, q, short, lower, upper)
    with pytest.raises(ValueError, match="tolerance must be above 0"):
        solve(H, q, rows, lower, upper, tolerance=0.0)
    with pytest.raises(ValueError, match="max_iterations must be at least 1"):
        solve(H, q, rows, lower, upper, max_iterations=0)
