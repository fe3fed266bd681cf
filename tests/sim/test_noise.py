"""Random numbers of an episode's steps: one source for all engines, by NumPy and by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from kjax.sim.noise import FORCES, SENSORS, normal


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1, -3])
def test_numpy_and_jax_read_the_same_numbers(seed):
    steps = np.array([0, 1, 2, 35, 21_999, 2**31 - 1])
    rows = normal(seed, steps, SENSORS, 36, np)
    read = jax.jit(jax.vmap(lambda step: normal(jnp.asarray(seed), step, SENSORS, 36)))
    np.testing.assert_array_equal(read(jnp.asarray(steps, jnp.int32)), rows)
    assert rows.dtype == np.float32


def test_they_are_normal_and_independent_between_steps_sensors_seeds_and_streams():
    steps = np.arange(4000)
    rows = normal(1, steps, SENSORS, 36, np)
    others = [normal(2, steps, SENSORS, 36, np), normal(1, steps, FORCES, 36, np), rows[1:]]
    assert kstest(rows[:, 0], "norm").pvalue > 0.01
    assert abs(rows.mean()) < 0.01
    assert abs(rows.std() - 1.0) < 0.01
    # 5 standard errors, 1 / sqrt(4000), of 36 x 36 correlations.
    np.testing.assert_allclose(np.corrcoef(rows.T), np.eye(36), atol=0.08)
    for other in others:
        count = len(other)
        both = np.corrcoef(rows[:count].T, other.T)[:36, 36:]
        assert np.abs(both).max() < 0.08
