"""The QR factor of least squares against numpy.linalg.lstsq, however the rows come in."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.koopman import regression

C, T = 7, 3


@pytest.fixture
def rows():
    rng = np.random.default_rng(0)
    Z = rng.normal(size=(400, C)) * 10.0 ** np.arange(-3, 4)  # columns of very different size
    W = rng.normal(size=(C, T))
    return Z, Z @ W + 0.1 * rng.normal(size=(400, T))


def lstsq(Z, Y):
    scale = np.linalg.norm(Z, axis=0)
    return np.linalg.lstsq(Z / scale, Y, rcond=None)[0] / scale[:, None]


def solve(factor, **options):
    return jax.jit(lambda t: regression.solve(t, C, **options))(factor)


def test_all_rows_at_once(rows):
    weights = solve(regression.of_rows(*rows))
    # Rounding of targets of 1e3, seen through a column of 1e-3.
    np.testing.assert_allclose(weights.W, lstsq(*rows), rtol=1e-8)
    assert weights.rank == C
    factor = regression.of_rows(*rows)
    wanted = np.sqrt(np.mean((rows[1] - rows[0] @ np.asarray(weights.W)) ** 2, axis=0))
    # The residual, 0.1, is what is left of targets of 1e3: rounding of these.
    np.testing.assert_allclose(regression.rms(factor, weights.W), wanted, rtol=1e-9)


def test_rows_in_blocks_or_from_two_machines_or_one_by_one(rows):
    Z, Y = rows
    wanted = lstsq(Z, Y)
    blocks = regression.block_rows(
        regression.empty(C, T), jnp.asarray(Z.reshape(8, 50, C)), jnp.asarray(Y.reshape(8, 50, T))
    )
    merged = regression.merge(regression.of_rows(Z[:5], Y[:5]), regression.of_rows(Z[5:], Y[5:]))
    single = regression.block_rows(
        regression.empty(C, T), jnp.asarray(Z[:, None]), jnp.asarray(Y[:, None])
    )
    for factor in (blocks, merged, single):
        assert factor.rows == 400
        np.testing.assert_allclose(solve(factor).W, wanted, rtol=1e-9)


def test_forgetting_follows_a_change(rows):
    """Recursive least squares: row i weighs forget^(age)."""
    Z, Y = rows
    forget = 0.95
    factor = regression.empty(C, T)
    step = jax.jit(lambda t, z, y: regression.accumulate(t, z[None], y[None], forget=forget))
    for z, y in zip(Z[:120], Y[:120], strict=True):
        factor = step(factor, z, y)
    weight = np.sqrt(forget ** np.arange(119, -1, -1))[:, None]
    np.testing.assert_allclose(
        solve(factor).W, lstsq(weight * Z[:120], weight * Y[:120]), rtol=1e-8
    )
    np.testing.assert_allclose(factor.rows, (1 - forget**120) / (1 - forget), rtol=1e-12)


def test_a_cut_of_the_columns_is_the_smaller_problem(rows):
    Z, Y = rows
    use = np.array([1, 0, 1, 1, 0, 1, 1], bool)
    weights = solve(regression.of_rows(Z, Y), use=jnp.asarray(use))
    assert weights.rank == use.sum()
    np.testing.assert_array_equal(weights.W[~use], 0.0)
    np.testing.assert_allclose(weights.W[use], lstsq(Z[:, use], Y), rtol=1e-9)


def test_ridge_is_that_of_the_scaled_columns(rows):
    Z, Y = rows
    scale = np.linalg.norm(Z, axis=0)
    S = Z / scale
    wanted = np.linalg.solve(S.T @ S + 0.3 * np.eye(C), S.T @ Y) / scale[:, None]
    np.testing.assert_allclose(solve(regression.of_rows(Z, Y), ridge=0.3).W, wanted, rtol=1e-10)


def test_repeated_columns_share_and_the_rank_tells(rows):
    Z, Y = rows
    twice = np.concatenate([Z, Z[:, :1]], axis=1)
    weights = jax.jit(lambda t: regression.solve(t, C + 1))(regression.of_rows(twice, Y))
    assert weights.rank == C
    np.testing.assert_allclose(weights.W[0], weights.W[-1], rtol=1e-6)
    np.testing.assert_allclose(twice @ weights.W, Z @ lstsq(Z, Y), rtol=0, atol=1e-7)


def test_fewer_rows_than_columns_give_the_shortest_solution(rows):
    Z, Y = (a[:3] for a in rows)
    scale = np.linalg.norm(Z, axis=0)
    weights = solve(regression.of_rows(Z, Y))
    assert weights.rank == 3
    wanted = np.linalg.pinv(Z / scale) @ Y / scale[:, None]
    np.testing.assert_allclose(weights.W, wanted, rtol=1e-7)


def test_held_out_rows_are_judged_without_keeping_them(rows):
    Z, Y = rows
    W = solve(regression.of_rows(Z[:300], Y[:300])).W
    held = regression.of_rows(Z[300:], Y[300:])
    wanted = np.sqrt(np.mean((Y[300:] - Z[300:] @ np.asarray(W)) ** 2, axis=0))
    np.testing.assert_allclose(regression.rms(held, W), wanted, rtol=1e-9)


def test_single_precision_stays_near_double(rows):
    Z, Y = rows
    weights = solve(regression.of_rows(*(jnp.asarray(a, jnp.float32) for a in rows)))
    assert weights.W.dtype == jnp.float32
    scale = np.linalg.norm(Z, axis=0)[:, None]
    # In scaled columns: rounding 6e-8 times the condition of a Gaussian matrix, below 2.
    error = (np.asarray(weights.W) - lstsq(Z, Y)) * scale
    assert np.abs(error).max() < 1e-5 * np.linalg.norm(Y)
