"""The regulator and the distribution of its wrench over the stance feet."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.legs import lateral

ALL = np.ones(4, bool)
TROT = np.array([True, False, False, True])
ARMS = np.array(
    [[0.19, -0.13, -0.27], [0.20, 0.12, -0.27], [-0.18, -0.12, -0.27], [-0.17, 0.13, -0.27]]
)

distribute = jax.jit(lateral.distribute)


def settings(dtype="float64", **changes):
    values = {
        "roll": [60.0, 4.0],
        "yaw": [20.0, 3.0],
        "damping": 30.0,
        "weights": [1.0, 0.3, 1.0, 20.0, 20.0, 10.0],
        "ridge": 1e-3,
        "friction": 0.7,
        "torque_fraction": 0.95,
        "foothold_gain": 0.05,
    }
    return lateral.LateralParams(
        **{name: jnp.asarray(value, dtype) for name, value in (values | changes).items()}
    )


def wrench_of(force):
    """Sum of forces and of moments about the centre of mass, leg by leg."""
    force = np.asarray(force, float)
    return np.r_[force.sum(axis=0), np.cross(ARMS, force).sum(axis=0)]


def shared(stance, planned, wrench, **changes):
    return np.asarray(
        distribute(
            settings(**changes),
            jnp.asarray(ARMS),
            jnp.asarray(stance),
            jnp.asarray(planned, float),
            jnp.asarray(wrench, float),
        )
    )


PLANNED = np.tile([3.0, 0.0, 32.0], (4, 1))


def test_four_feet_give_any_wrench_within_their_limits():
    wanted = wrench_of(PLANNED) + np.array([1.0, 8.0, 4.0, 3.0, -2.0, 1.5])
    force = shared(ALL, PLANNED, wanted, ridge=1e-9)
    # The ridge's share: 1e-9 over the least eigenvalue of G^T W G, about 1.
    np.testing.assert_allclose(wrench_of(force), wanted, rtol=0, atol=1e-6)
    # With the default ridge it falls short by 1e-3 of what is missing, at most 8.
    np.testing.assert_allclose(wrench_of(shared(ALL, PLANNED, wanted)), wanted, atol=0.01)


def test_the_plan_s_own_wrench_changes_nothing():
    force = shared(ALL, PLANNED, wrench_of(PLANNED))
    np.testing.assert_allclose(force, PLANNED, rtol=0, atol=1e-9)


def test_two_feet_give_the_weighted_least_squares_and_the_others_nothing():
    """By numpy's own least squares on the stacked system."""
    planned = PLANNED * TROT[:, None] * 2.0
    wanted = wrench_of(planned) + np.array([0.0, 5.0, 0.0, 2.0, 0.0, -1.0])
    force = shared(TROT, planned, wanted, friction=100.0)
    np.testing.assert_array_equal(force[~TROT], 0.0)
    blocks = [np.r_[f, np.cross(ARMS[leg], f)] for leg in np.flatnonzero(TROT) for f in np.eye(3)]
    root = np.sqrt([1.0, 0.3, 1.0, 20.0, 20.0, 10.0])
    A = np.r_[root[:, None] * np.array(blocks).T, np.sqrt(1e-3) * np.eye(6)]
    b = np.r_[root * (wanted - wrench_of(planned)), np.zeros(6)]
    change = np.linalg.lstsq(A, b)[0].reshape(2, 3)
    np.testing.assert_allclose(force[TROT], planned[TROT] + change, rtol=0, atol=1e-9)


def test_feet_do_not_pull_and_stay_within_the_friction_limit():
    force = shared(ALL, PLANNED, wrench_of(PLANNED) + np.array([0.0, 500.0, 0.0, 60.0, 0.0, 0.0]))
    limit, level = 0.7 * force[:, 2], np.hypot(force[:, 0], force[:, 1])
    assert (force[:, 2] >= 0.0).all()
    assert (force[:, 2] == 0.0).any()
    assert (level <= limit + 1e-12).all()  # rounding of a product and a root
    assert (np.abs(level - limit)[limit > 0] < 1e-12).any()


def test_derivatives_are_finite_with_feet_that_press_nothing_and_agree_with_differences():
    wrench = wrench_of(PLANNED) + np.array([1.0, 8.0, 4.0, 3.0, -2.0, 1.5])
    planned = PLANNED * TROT[:, None]

    @jax.jit
    def total(wrench, planned):
        force = lateral.distribute(
            settings(), jnp.asarray(ARMS), jnp.asarray(TROT), planned, wrench
        )
        return jnp.sum(force**2)

    for argument, values in enumerate((wrench, planned)):
        slope = np.asarray(jax.jit(jax.grad(total, argument))(wrench, planned))
        assert np.isfinite(slope).all()
        for index in ((1,), (4,)) if argument == 0 else ((0, 0), (3, 2)):
            step = np.zeros(values.shape)
            step[index] = 1e-5
            totals = [
                total(wrench + s * step, planned)
                if argument == 0
                else total(wrench, planned + s * step)
                for s in (1, -1)
            ]
            wanted = float(totals[0] - totals[1]) / 2e-5
            np.testing.assert_allclose(slope[index], wanted, rtol=1e-6, atol=1e-6)


def test_no_foot_on_the_ground_gives_no_force(dtype):
    force = distribute(
        settings(dtype),
        jnp.asarray(ARMS, dtype),
        jnp.zeros(4, bool),
        jnp.asarray(PLANNED, dtype),
        jnp.ones(6, dtype),
    )
    assert force.dtype == dtype
    np.testing.assert_array_equal(force, 0.0)


@pytest.mark.parametrize("stance", [ALL, TROT, np.array([True, True, False, False])])
def test_single_precision_agrees_with_double(stance):
    """Also where the feet on a line cannot give every moment, and the ridge alone decides."""
    planned = PLANNED * stance[:, None]
    wanted = wrench_of(planned) + np.array([0.0, 5.0, 0.0, 4.0, 1.0, -2.0])
    double, single = (
        distribute(
            settings(name),
            jnp.asarray(ARMS, name),
            jnp.asarray(stance),
            jnp.asarray(planned, name),
            jnp.asarray(wanted, name),
        )
        for name in ("float64", "float32")
    )
    assert single.dtype == np.float32
    # Rounding 6e-8 of weights up to 40, over the ridge 1e-3, on changes of up to 20 N: 0.05 N.
    np.testing.assert_allclose(single, double, rtol=0, atol=0.05)
