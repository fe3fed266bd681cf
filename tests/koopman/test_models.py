"""Linear predictors against plain numpy recursions."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.koopman import models

N = 9

input_map, step = jax.jit(models.input_map), jax.jit(models.step)
rollout = jax.jit(models.rollout)
aggregate = jax.jit(models.aggregate, static_argnames="steps")


@pytest.fixture
def model(dtype):
    """A random stable model whose input map depends on the contact points."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(N, N))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    B, B_feet = rng.normal(size=(N, 4)), rng.normal(size=(4, N, 4))
    return models.LinearModel(*(jnp.asarray(a, dtype) for a in (A, B, B_feet)))


@pytest.fixture
def feet(dtype):
    return jnp.asarray([[0.2, -0.25], [-0.15, -0.3]], dtype)


def double(tree):
    return jax.tree.map(lambda a: np.asarray(a, np.float64), tree)


def predict_by_hand(model, z, inputs, feet):
    """The recursion in numpy and double precision, every lifted state."""
    A, B, B_feet = double(model)
    B = B + sum(r * B_r for r, B_r in zip(np.asarray(feet, float).ravel(), B_feet, strict=True))
    trajectory = [np.asarray(z, np.float64)]
    for u in np.asarray(inputs, np.float64):
        trajectory.append(A @ trajectory[-1] + B @ u)
    return np.stack(trajectory)


def tolerance(dtype):
    # 20 steps of sums over 13 terms of order one, growing to order ten.
    return 20 * 13 * 10 * np.finfo(dtype).eps


def test_the_input_map_is_affine_in_the_contact_points(model, feet, dtype):
    B, B_feet = double(model)[1:]
    expected = B + 0.2 * B_feet[0] - 0.25 * B_feet[1] - 0.15 * B_feet[2] - 0.3 * B_feet[3]
    np.testing.assert_allclose(input_map(model, feet), expected, rtol=0, atol=tolerance(dtype))
    np.testing.assert_array_equal(input_map(model, jnp.zeros((2, 2), dtype)), model.B)


def test_rollout_is_the_linear_recursion_without_relifting(model, feet, dtype):
    rng = np.random.default_rng(1)
    z0 = jnp.asarray(rng.normal(size=N), dtype)
    inputs = jnp.asarray(rng.normal(size=(20, 4)), dtype)
    states = rollout(model, z0, inputs, feet)
    expected = predict_by_hand(model, z0, inputs, feet)[:, 1:7]
    np.testing.assert_allclose(states, expected, rtol=0, atol=tolerance(dtype))
    np.testing.assert_array_equal(states[0], np.asarray(z0)[1:7])


def test_one_step_equals_the_first_of_a_rollout(model, feet, dtype):
    rng = np.random.default_rng(2)
    z, u = (jnp.asarray(rng.normal(size=n), dtype) for n in (N, 4))
    expected = predict_by_hand(model, z, u[None], feet)[1]
    np.testing.assert_allclose(step(model, z, u, feet), expected, rtol=0, atol=tolerance(dtype))


def test_a_model_over_twenty_steps_equals_twenty_steps_under_a_held_input(model, feet, dtype):
    rng = np.random.default_rng(3)
    z, u = (jnp.asarray(rng.normal(size=n), dtype) for n in (N, 4))
    long = aggregate(model, steps=20)
    expected = predict_by_hand(model, z, np.tile(u, (20, 1)), feet)[-1]
    np.testing.assert_allclose(step(long, z, u, feet), expected, rtol=0, atol=tolerance(dtype))


def test_a_model_over_one_step_is_itself(model):
    chex.assert_trees_all_equal(aggregate(model, steps=1), model)


def test_aggregating_no_step_is_refused_by_name(model):
    with pytest.raises(ValueError, match=r"steps .*0"):
        models.aggregate(model, 0)


def test_rollout_traces_once_and_keeps_the_dtype(model, feet, dtype):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def traced(model, z0, inputs):
        return models.rollout(model, z0, inputs, feet)

    for value in (0.0, 1.0):
        states = traced(model, np.full(N, value, dtype), np.full((3, 4), value, dtype))
        chex.assert_shape(states, (4, 6))
        assert states.dtype == dtype
    z = jnp.zeros(N, dtype)
    chex.assert_trees_all_equal_shapes_and_dtypes(step(model, z, jnp.zeros(4, dtype), feet), z)
    chex.assert_trees_all_equal_shapes_and_dtypes(aggregate(model, steps=20), model)
