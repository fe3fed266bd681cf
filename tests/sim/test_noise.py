"""Random numbers of an episode's steps: one source for all engines, by NumPy and by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from kjax.sim.noise import FORCES, SENSORS, normal_row, normal_rows, table_place


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1, -3])
def test_numpy_and_jax_read_the_same_numbers(seed):
    steps = np.array([0, 1, 2, 35, 21_999, 2**31 - 1])
    rows = normal_rows(seed, steps, SENSORS, 36)
    read = jax.jit(jax.vmap(lambda step: normal_row(jnp.asarray(seed), step, SENSORS, 36)))
    np.testing.assert_array_equal(read(jnp.asarray(steps, jnp.int32)), rows)
    np.testing.assert_array_equal(normal_rows(seed, steps, SENSORS, 30), rows[:, :30])


def test_they_are_normal_and_independent_between_steps_sensors_seeds_and_streams():
    steps = np.arange(4000)
    rows = normal_rows(1, steps, SENSORS, 36)
    others = [normal_rows(2, steps, SENSORS, 36), normal_rows(1, steps, FORCES, 36), rows[1:]]
    # One in 1,800 rows of a step overlaps another's, so that 4,000 of them count as fewer.
    assert kstest(rows[:, 0], "norm").pvalue > 0.01
    assert abs(rows.mean()) < 0.01
    assert abs(rows.std() - 1.0) < 0.01
    # 5 standard errors, 1 / sqrt(4000), of 36 x 36 correlations.
    np.testing.assert_allclose(np.corrcoef(rows.T), np.eye(36), atol=0.08)
    for other in others:
        count = len(other)
        both = np.corrcoef(rows[:count].T, other.T)[:36, 36:]
        assert np.abs(both).max() < 0.08


def test_places_in_the_table_are_spread_evenly_for_neighbouring_seeds_and_steps():
    seeds, steps = np.meshgrid(np.arange(64), np.arange(2048))
    places = table_place(seeds, steps, SENSORS, np).reshape(-1)
    counts = np.bincount(places // 256, minlength=256)  # 131,072 draws in 256 bins of 512
    # Chi square with 255 degrees of freedom: mean 255, standard deviation 22.6; 5 of them.
    assert ((counts - 512.0) ** 2 / 512.0).sum() < 255 + 5 * 22.6
