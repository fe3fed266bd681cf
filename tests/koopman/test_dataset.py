"""Random rollouts: reproducible, inside their ranges, and obeying the dynamics."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kjax.koopman import dataset
from kjax.koopman.dataset import DatasetSpec
from kjax.types import MODE_ALPHA, Mode

DT = 1e-3  # s, the step of the shared snapshots


@pytest.fixture(scope="module")
def sampler(body):
    """Compiled (key, ranges) -> snapshots of the trot mode, 6 rollouts of 7 steps, hold 3."""
    alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    options = {"rollouts": 6, "steps": 7, "dt": 0.002, "hold": 3}
    return jax.jit(lambda key, ranges: dataset.sample(key, body, alpha, ranges, **options))


@pytest.fixture(scope="module")
def ranges():
    return dataset.sample_ranges(DatasetSpec(), vary_feet=True)


def derivative(body, alpha, feet, u, x):
    """Eqs. 1-2 in complex numbers."""
    force = alpha * (u[0::2] + 1j * u[1::2])
    accel = np.exp(1j * x[2]) * force.sum() / body.mass - 9.81j
    moment = np.imag(np.conj(feet[:, 0] + 1j * feet[:, 1]) * force).sum()
    return np.array([*x[3:], accel.real, accel.imag, moment / body.inertia])


@pytest.mark.parametrize("mode", [Mode.FRONT, Mode.TROT])
def test_each_rollout_obeys_the_dynamics_with_its_own_contact_points(
    mode, body, snapshots_moving_feet
):
    states, inputs, feet = (np.asarray(a[mode, 5]) for a in snapshots_moving_feet)
    assert not np.allclose(feet, body.feet)
    x = states[0]
    for u, recorded in zip(inputs, states[1:], strict=True):
        f = partial(derivative, body, MODE_ALPHA[mode], feet, u)
        x = solve_ivp(lambda _, x, f=f: f(x), (0, DT), x, rtol=1e-12, atol=1e-13).y[:, -1]
        # scipy's 1e-12 over at most 25 steps; Runge-Kutta's error is 1e-16 per 1 ms step.
        np.testing.assert_allclose(recorded, x, rtol=0, atol=1e-10)


def test_samples_fill_their_ranges_and_stay_inside(snapshots, snapshots_moving_feet, body):
    start, inputs = snapshots.states[:, :, 0], snapshots.inputs
    half = np.array([0.5, 0.1, 0.3, 1.0, 0.5, 2.0])
    middle = np.array([0.0, 0.27, 0.0, 0.0, 0.0, 0.0])
    spread = (np.asarray(start).reshape(-1, 6) - middle) / half
    forces = np.asarray(inputs).reshape(-1, 4)
    low, high = np.array([-60.0, 0.0, -60.0, 0.0]), np.array([60.0, 150.0, 60.0, 150.0])
    shift = (np.asarray(snapshots_moving_feet.feet) - np.asarray(body.feet)) / [0.12, 0.05]
    for unit in (spread, (forces - (low + high) / 2) / ((high - low) / 2), shift.reshape(-1, 4)):
        assert np.abs(unit).max() <= 1.0
        # 200 uniform draws all miss the outermost 5 % with probability 0.95^200 = 3.5e-5.
        assert (unit.max(axis=0) > 0.9).all()
        assert (unit.min(axis=0) < -0.9).all()


def test_contact_points_stay_put_unless_asked_to_vary(snapshots, body):
    np.testing.assert_array_equal(snapshots.feet, np.broadcast_to(body.feet, (len(Mode), 40, 2, 2)))
    still = dataset.sample_ranges(DatasetSpec())
    np.testing.assert_array_equal(still.feet_half, 0.0)


def test_the_key_decides_the_data(sampler, ranges):
    first, again, other = (sampler(jax.random.key(seed), ranges) for seed in (0, 0, 1))
    chex.assert_trees_all_equal(first, again)
    assert not np.isin(first.inputs, other.inputs).any()
    assert not np.isin(first.states[:, 0], other.states[:, 0]).any()


def test_states_forces_and_contact_points_are_drawn_independently(sampler, ranges):
    data, ranges = jax.device_get((sampler(jax.random.key(0), ranges), ranges))
    unit = [
        (data.states[:, 0] - ranges.state_centre) / ranges.state_half,
        (data.inputs[:, 0, 0::2] - ranges.input_low[0]) / 120.0 * 2 - 1,
        (data.feet - np.array([[0.19, -0.25], [-0.18, -0.26]])) / ranges.feet_half,
    ]
    flat = np.concatenate([np.asarray(a).ravel() for a in unit])
    # No draw is used twice: a shared key would repeat values to rounding.
    assert np.diff(np.sort(flat)).min() > 1e-9


def test_each_force_is_held_and_a_last_incomplete_piece_is_cut(sampler, ranges):
    inputs = np.asarray(sampler(jax.random.key(0), ranges).inputs)
    assert inputs.shape == (6, 7, 4)
    changes = (np.diff(inputs, axis=1) != 0).all(axis=(0, 2))
    np.testing.assert_array_equal(changes, [False, False, True, False, False, True])


def test_ranges_come_from_the_spec_in_the_order_of_state_and_input():
    spec = DatasetSpec(
        height=0.3,
        state_range=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        force_x=7.0,
        force_z=(8.0, 9.0),
        feet_range=(0.1, 0.2),
    )
    ranges = dataset.sample_ranges(spec, vary_feet=True)
    np.testing.assert_array_equal(ranges.state_centre, [0, 0.3, 0, 0, 0, 0])
    np.testing.assert_array_equal(ranges.state_half, [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(ranges.input_low, [-7, 8, -7, 8])
    np.testing.assert_array_equal(ranges.input_high, [7, 9, 7, 9])
    np.testing.assert_array_equal(ranges.feet_half, [0.1, 0.2])


def test_shrinking_keeps_the_centres_and_scales_the_widths(ranges):
    half = dataset.shrink(ranges, jnp.asarray(0.5))
    np.testing.assert_array_equal(half.state_centre, ranges.state_centre)
    # Rounding of the scaled bounds, at most 150 N.
    np.testing.assert_allclose(half.state_half, 0.5 * ranges.state_half, rtol=1e-15)
    np.testing.assert_allclose(half.input_low, [-30.0, 37.5, -30.0, 37.5], rtol=0, atol=1e-13)
    np.testing.assert_allclose(half.input_high, [30.0, 112.5, 30.0, 112.5], rtol=0, atol=1e-13)
    point = dataset.shrink(ranges, jnp.asarray(0.0))
    np.testing.assert_array_equal(point.input_low, point.input_high)
    np.testing.assert_array_equal(point.state_half, 0.0)


def test_a_scan_over_ranges_is_a_vmap(sampler, ranges):
    scales = jnp.array([1.0, 0.1])
    key = jax.random.key(4)
    batch = jax.vmap(lambda s: sampler(key, dataset.shrink(ranges, s)))(scales)
    single = sampler(key, dataset.shrink(ranges, scales[1]))
    # The same operations, fused differently; forces reach 150 N.
    chex.assert_trees_all_close(jax.tree.map(lambda a: a[1], batch), single, rtol=0, atol=1e-11)


def test_the_old_name_of_sample_ranges_says_the_new_one():
    with pytest.raises(ImportError, match="has gone: use sample_ranges"):
        from kjax.koopman.dataset import ranges_from_config  # noqa: F401
