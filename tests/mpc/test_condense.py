"""The condensed problem against a horizon simulated step by step and a cost written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.mpc.condense import condense, discounted_weights

N, K = 9, 5  # observables, steps
Q = np.array([3.0, 5.0, 2.0, 0.5, 0.7, 0.1])
R = np.array([0.2, 0.1, 0.3, 0.4])

condensed = jax.jit(condense, static_argnames="horizon")


@pytest.fixture(scope="module")
def system():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(N, N))
    return A * 0.95 / np.abs(np.linalg.eigvals(A)).max(), rng.normal(size=(N, 4))


@pytest.fixture(scope="module")
def problem(system):
    return jax.tree.map(np.asarray, condensed(*system, Q, R, horizon=K))


@pytest.fixture(scope="module")
def values():
    """Random lifted state, reference (K, 6), input reference (4,), plan (K, 4)."""
    rng = np.random.default_rng(1)
    return tuple(rng.normal(size=shape) for shape in (N, (K, 6), 4, (K, 4)))


def simulate(system, z, plan):
    """Predicted states of steps 1..K, one step at a time."""
    A, B = system
    states = []
    for u in plan:
        z = A @ z + B @ u
        states.append(z[1:7])
    return np.stack(states)


def test_the_stacked_prediction_is_the_simulated_horizon(system, problem, values):
    z, _, _, plan = values
    predicted = problem.A_qp @ z + problem.B_qp @ plan.ravel()
    # Sums of 9 + 20 terms of order one to ten, in double precision.
    np.testing.assert_allclose(predicted, simulate(system, z, plan).ravel(), rtol=0, atol=1e-12)


def test_a_force_moves_no_state_before_it_acts(problem):
    blocks = np.asarray(problem.B_qp).reshape(K, 6, K, 4)
    for row in range(K):
        np.testing.assert_array_equal(blocks[row, :, row + 1 :], 0.0)
        assert np.abs(blocks[row, :, row]).max() > 0.1


def cost(system, z, reference, u_ref, plan):
    """The sum of the module's docstring, written out for autodiff."""
    A, B = system
    total = 0.0
    for i in range(K):
        u = plan[4 * i : 4 * i + 4]
        z = A @ z + B @ u
        total += jnp.sum(Q * (z[1:7] - reference[i]) ** 2) + jnp.sum(R * (u - u_ref) ** 2)
    return total


def test_hessian_and_gradient_are_those_of_the_cost_written_out(system, problem, values):
    z, reference, u_ref, plan = map(jnp.asarray, values)
    derivatives = jax.jit(
        lambda plan: (
            jax.grad(cost, argnums=4)(system, z, reference, u_ref, plan),
            jax.hessian(cost, argnums=4)(system, z, reference, u_ref, plan),
        )
    )
    gradient, hessian = derivatives(plan.ravel())
    z, reference, u_ref, plan = values
    q = problem.F @ z - problem.G @ reference.ravel() - 2 * np.tile(R * u_ref, K)
    # Rounding of sums whose terms reach 1e3.
    np.testing.assert_allclose(problem.H, hessian, rtol=0, atol=1e-11)
    np.testing.assert_allclose(problem.H @ plan.ravel() + q, gradient, rtol=0, atol=1e-10)


def test_the_hessian_is_symmetric_and_holds_the_input_weights(problem):
    np.testing.assert_array_equal(problem.H, problem.H.T)
    # H - 2 R is the positive semidefinite part of the states; rounding of eigenvalues up to 1e3.
    rest = np.linalg.eigvalsh(problem.H - 2 * np.diag(np.tile(R, K)))
    assert rest.min() > -1e-11


def test_without_state_weights_only_the_input_weights_are_left(system):
    problem = condensed(*system, 0 * Q, R, horizon=2)
    np.testing.assert_array_equal(problem.H, 2 * np.diag(np.tile(R, 2)))
    np.testing.assert_array_equal(problem.F, 0.0)


def test_single_precision_agrees_and_stays_single(system, problem):
    single = condensed(*(np.asarray(a, np.float32) for a in (*system, Q, R)), horizon=K)
    for ours, exact in zip(single, problem, strict=True):
        assert ours.dtype == jnp.float32
        # Rounding 6e-8 through five products of sums of 9 to 30 terms, relative to the largest.
        np.testing.assert_allclose(ours, exact, rtol=0, atol=3e-6 * np.abs(exact).max())


def test_a_horizon_of_one_is_a_single_step(system):
    problem = condensed(*system, Q, R, horizon=1)
    np.testing.assert_array_equal(problem.A_qp, system[0][1:7])
    np.testing.assert_array_equal(problem.B_qp, system[1][1:7])


def test_no_horizon_is_refused_by_name(system):
    with pytest.raises(ValueError, match=r"horizon .*0"):
        condense(*map(jnp.asarray, (*system, Q, R)), horizon=0)


def test_caution_weighs_what_grows_uncertain_less():
    """A chain of two integrators: white noise on v makes p's variance grow like i^3 / 3."""
    A = np.eye(7)
    A[1, 4] = 0.1  # p_x from v_x
    weights = jnp.asarray([2.0, 1.0, 1.0, 3.0, 1.0, 1.0])
    spread = jnp.asarray([0.0, 0.0, 0.0, 0.5, 0.0, 0.0])
    got = discounted_weights(jnp.asarray(A), weights, spread, 0.5, 6)
    i = np.arange(1, 7)
    np.testing.assert_allclose(got[:, 3], 3.0 / (1 + 0.5 * i / i.mean()), rtol=1e-12)
    along = np.cumsum((i - 1) ** 2)  # of p after i steps, in units of (0.1 * 0.5)^2
    np.testing.assert_allclose(got[:, 0], 2.0 / (1 + 0.5 * along / along.mean()), rtol=1e-12)
    np.testing.assert_array_equal(got[:, 1], 1.0)  # nothing uncertain reaches p_z
    trusting = discounted_weights(jnp.asarray(A), weights, spread, 0.0, 6)
    np.testing.assert_array_equal(trusting, np.tile(weights, (6, 1)))


def test_weights_of_every_step_reach_the_hessian():
    rng = np.random.default_rng(0)
    A = jnp.asarray(np.eye(7) + 0.05 * rng.normal(size=(7, 7)))
    B = jnp.asarray(rng.normal(size=(7, 4)))
    weights = rng.uniform(1, 2, (3, 6))
    problem = condense(A, B, jnp.asarray(weights), jnp.full(4, 0.1), 3)
    wanted = 2 * problem.B_qp.T @ np.diag(weights.reshape(-1)) @ problem.B_qp + 0.2 * np.eye(12)
    np.testing.assert_allclose(problem.H, wanted, rtol=1e-12)
