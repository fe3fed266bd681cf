"""Scaling, spectrum and the residual that defines what a solution is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kjax import qp

prepare = jax.jit(qp.prepare)
kkt_residual = jax.jit(qp.kkt_residual)


def cast(arrays, dtype):
    return [jnp.asarray(a, dtype) for a in arrays]


def test_prepare_scales_to_a_unit_diagonal_and_inverts(random_qp, dtype):
    H = random_qp(0)[0]
    H = H * np.outer(*[np.geomspace(1e-3, 1e3, 12)] * 2)  # badly scaled units
    prepared = prepare(jnp.asarray(H, dtype))
    d = np.diag(H) ** -0.5
    scaled = H * np.outer(d, d)
    spectrum = np.linalg.eigvalsh(scaled)
    rho = np.sqrt(spectrum[0] * spectrum[-1])
    # Rounding times the size of what is computed: eigenvalues to eps * L, inverses to eps * cond.
    eps, condition = np.finfo(dtype).eps, spectrum[-1] / spectrum[0]
    np.testing.assert_allclose(prepared.scale, d, rtol=4 * eps)
    np.testing.assert_allclose(np.diag(prepared.H), 1.0, rtol=8 * eps)
    np.testing.assert_allclose(prepared.H, scaled, rtol=0, atol=8 * eps)
    np.testing.assert_allclose(prepared.eig_min, spectrum[0], rtol=0, atol=20 * eps * spectrum[-1])
    np.testing.assert_allclose(prepared.eig_max, spectrum[-1], rtol=0, atol=20 * eps * spectrum[-1])
    np.testing.assert_allclose(prepared.rho, rho, rtol=20 * eps * condition)
    np.testing.assert_allclose(
        prepared.inverse @ jnp.asarray(scaled, dtype), np.eye(12), rtol=0, atol=20 * eps * condition
    )
    np.testing.assert_allclose(
        prepared.resolvent,
        np.linalg.inv(scaled + rho * np.eye(12)),
        rtol=0,
        atol=20 * eps * condition / rho,
    )
    assert prepared.finite
    assert prepared.definite
    assert prepared.H.dtype == prepared.inverse.dtype == dtype


def test_prepare_uses_the_symmetric_part(random_qp):
    H = random_qp(1)[0]
    skew = np.triu(np.ones_like(H), 1)
    lopsided = prepare(jnp.asarray(H + skew - skew.T))
    # Adding and taking away 1 rounds entries of H at 1e-16 times their size, up to 100.
    np.testing.assert_allclose(lopsided.H, prepare(jnp.asarray(H)).H, rtol=0, atol=1e-14)


def rank_deficient(n=12):
    factor = np.random.default_rng(0).normal(size=(n, n - 1))
    return factor @ factor.T


HESSIANS = {
    "positive definite": (np.eye(12), True, True),
    "singular": (rank_deficient(), True, False),
    "zero": (np.zeros((12, 12)), True, False),
    "one zero row": (np.diag(np.arange(12.0)), True, False),
    "indefinite with positive diagonal": (np.eye(12) + 0.5 * (1 - np.eye(12)) * -1, True, False),
    "negative definite": (-np.eye(12), True, False),
    "NaN": (np.full((12, 12), np.nan), False, None),
    "one NaN off the diagonal": (np.eye(12) + np.diag([np.nan] + [0.0] * 10, 1), False, None),
    "infinite": (np.diag([np.inf] + [1.0] * 11), False, None),
}


@pytest.mark.parametrize("name", HESSIANS)
def test_a_faulty_hessian_is_told_apart_and_nothing_else_turns_nan(name, dtype):
    H, finite, definite = HESSIANS[name]
    prepared = prepare(jnp.asarray(H, dtype))
    assert prepared.finite == finite
    if definite is not None:
        assert prepared.definite == definite
    for leaf in jax.tree.leaves(prepared):
        assert np.isfinite(np.asarray(leaf)).all()


def test_the_residual_vanishes_at_a_known_solution(random_qp, dtype):
    for seed in range(5):
        H, q, lower, upper, x = random_qp(seed)
        residual = kkt_residual(*cast((H, q, lower, upper, x), dtype))
        # Twelve-term sums of H x (entries to 100) and q cancel, relative to |q|: a few roundings.
        assert residual < 50 * np.finfo(dtype).eps


def test_the_residual_sees_every_way_of_missing_the_solution(random_qp):
    H, q, lower, upper, x = random_qp(0)
    free, at_lower, at_upper = 2, 0, 1
    shifted = x.copy()
    shifted[free] += 0.01
    inside_from_lower = x.copy()
    inside_from_lower[at_lower] += 0.01
    inside_from_upper = x.copy()
    inside_from_upper[at_upper] -= 0.01
    outside = x.copy()
    outside[at_lower] -= 0.01
    for wrong in (shifted, inside_from_lower, inside_from_upper, outside):
        # A miss of 0.01 in one coordinate moves its own scaled gradient by 0.01 |x_hat| / |q_hat|,
        # over a hundred times less than that is rounding.
        assert kkt_residual(*map(jnp.asarray, (H, q, lower, upper, wrong))) > 1e-5


def test_the_residual_of_a_free_problem_is_the_relative_gradient(random_qp):
    H, q, _, _, x = random_qp(3)
    x = x + 0.1
    unbounded = np.full(12, np.inf)
    d = np.diag(H) ** -0.5
    gradient = d * (H @ x + q)
    own = d * np.maximum(np.abs(H) @ np.abs(x), np.abs(q))
    ours = kkt_residual(*map(jnp.asarray, (H, q, -unbounded, unbounded, x)))
    # A few roundings, and what the judge leaves for rounding.
    np.testing.assert_allclose(ours, (np.abs(gradient) / own).max(), rtol=1e-11)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 1000),
    exponent=st.floats(-8.0, 8.0),
    units=st.lists(st.floats(-3.0, 3.0), min_size=12, max_size=12),
)
def test_neither_the_size_of_the_cost_nor_the_units_change_the_residual(
    random_qp, seed, exponent, units
):
    H, q, lower, upper, x = random_qp(seed)
    x = np.clip(x + 0.1, lower, upper)
    factor, unit = 10.0**exponent, 10.0 ** np.array(units)
    plain = kkt_residual(*map(jnp.asarray, (H, q, lower, upper, x)))
    other = kkt_residual(
        jnp.asarray(factor * H * np.outer(unit, unit)),
        jnp.asarray(factor * q * unit),
        *map(jnp.asarray, (lower / unit, upper / unit, x / unit)),
    )
    # The size of the cost multiplies x_hat, gradient and q_hat alike. Rounding only; the residual
    # itself is about 0.1.
    np.testing.assert_allclose(other, plain, rtol=1e-12)


def test_the_residual_of_all_zeros_is_zero():
    zero = jnp.zeros(12)
    assert kkt_residual(jnp.eye(12), zero, zero - 1, zero + 1, zero) == 0.0


def test_every_status_has_its_sentence():
    assert set(qp.STATUS_TEXT) == set(qp.Status)
