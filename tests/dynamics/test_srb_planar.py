"""The planar rigid body against closed forms, against scipy and against complex arithmetic."""

import itertools
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kjax.dynamics import srb_planar
from kjax.types import MODE_ALPHA, Mode, contact_mode

G = 9.81  # m/s^2
MASS, INERTIA = 12.7, 0.39
# A few roundings per step over 100 steps, on values of order one.
ROUNDING = {"float32": 1e-5, "float64": 1e-13}

rollout = jax.jit(srb_planar.rollout, static_argnames="dt")
dynamics = jax.jit(srb_planar.dynamics)


def make(dtype, feet=((0.2, -0.25), (-0.2, -0.25))):
    return srb_planar.SrbParams(
        mass=jnp.asarray(MASS, dtype),
        inertia=jnp.asarray(INERTIA, dtype),
        feet=jnp.asarray(feet, dtype),
    )


def run(dtype, mode, x0, u, steps=100, dt=0.005, feet=((0.2, -0.25), (-0.2, -0.25))):
    inputs = jnp.broadcast_to(jnp.asarray(u, dtype), (steps, 4))
    alpha = jnp.asarray(MODE_ALPHA[mode], dtype)
    states = rollout(make(dtype, feet), alpha, jnp.asarray(x0, dtype), inputs, dt)
    assert states.dtype == dtype
    return np.asarray(states), dt * np.arange(steps + 1)


def complex_derivative(mass, inertia, feet, alpha, x, u):
    """Eqs. 1-2 written with complex numbers p = x + i z, independent of the matrix form."""
    force = alpha * (u[0::2] + 1j * u[1::2])
    arm = feet[:, 0] + 1j * feet[:, 1]
    accel = np.exp(1j * x[2]) * force.sum() / mass - 1j * G
    moment = np.imag(np.conj(arm) * force).sum()
    return np.array([*x[3:], accel.real, accel.imag, moment / inertia])


def test_free_flight_is_a_parabola_with_constant_pitch_rate(dtype):
    x0 = [0.3, 0.5, 0.2, 1.0, 2.0, -3.0]
    states, t = run(dtype, Mode.FLIGHT, x0, [50.0, 90.0, -20.0, 70.0])
    expected = np.stack(
        [0.3 + t, 0.5 + 2 * t - G / 2 * t**2, 0.2 - 3 * t, 0 * t + 1, 2 - G * t, 0 * t - 3], axis=-1
    )
    # Runge-Kutta of order 4 is exact on parabolas: rounding only.
    np.testing.assert_allclose(states, expected, rtol=0, atol=ROUNDING[dtype.name])


@pytest.mark.parametrize(("mode", "share"), [(Mode.TROT, 0.5), (Mode.STAND, 0.25)])
def test_half_the_weight_at_each_end_hovers_at_rest(dtype, mode, share):
    x0 = [0.1, 0.27, 0.0, 0.0, 0.0, 0.0]
    force = share * MASS * G
    states, _ = run(dtype, mode, x0, [0.0, force, 0.0, force])
    # m g - m g leaves one rounding of 9.81 per step, which then acts as an acceleration for 0.5 s.
    np.testing.assert_allclose(states - x0, 0.0, rtol=0, atol=10 * np.finfo(dtype).eps)


def test_a_pure_couple_turns_the_body_in_place_at_constant_acceleration(dtype):
    # Front up, rear down: no net force, nose-up moment 2 * 0.2 m * 5 N.
    states, t = run(dtype, Mode.TROT, [0.0] * 6, [0.0, 5.0, 0.0, -5.0])
    accel = 2 * 0.2 * 5.0 / INERTIA
    np.testing.assert_allclose(states[:, 5], accel * t, rtol=0, atol=ROUNDING[dtype.name])
    np.testing.assert_allclose(states[:, 2], accel * t**2 / 2, rtol=0, atol=ROUNDING[dtype.name])
    np.testing.assert_allclose(states[:, 0], 0.0, rtol=0, atol=ROUNDING[dtype.name])
    np.testing.assert_allclose(states[:, 1], -G / 2 * t**2, rtol=0, atol=ROUNDING[dtype.name])


@pytest.mark.parametrize(
    ("u", "nose_up"),
    [
        ([0.0, 1.0, 0.0, 0.0], True),  # the ground lifts the front
        ([0.0, 0.0, 0.0, 1.0], False),  # the ground lifts the rear
        ([1.0, 0.0, 0.0, 0.0], True),  # a push forward below the centre of mass
        ([0.0, 0.0, -1.0, 0.0], False),  # a push back below the centre of mass
    ],
)
def test_moment_of_a_foot_force_has_the_sign_of_nose_up_pitch(u, nose_up):
    x = jnp.zeros(6)
    rate = dynamics(make(jnp.float64), jnp.ones(2), x, jnp.array(u))[5]
    assert (rate > 0) == nose_up


def test_forces_turn_with_the_body():
    # Pitched nose-up by 90 degrees, the body's up axis points backward in the world.
    x = jnp.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])
    accel = dynamics(make(jnp.float64), jnp.ones(2), x, jnp.array([0.0, MASS, 0.0, 0.0]))[3:5]
    # cos(pi/2) is 6e-17 in double precision.
    np.testing.assert_allclose(accel, [-1.0, -G], rtol=0, atol=1e-15)


@pytest.mark.parametrize("mode", list(Mode))
def test_derivative_equals_the_complex_form_of_the_paper_in_every_mode(dtype, mode):
    rng = np.random.default_rng(int(mode))
    x, u = rng.normal(size=6), 100 * rng.normal(size=4)
    feet = rng.normal(size=(2, 2))
    x, u, feet = (np.asarray(a, dtype).astype(float) for a in (x, u, feet))
    ours = dynamics(
        make(dtype, feet),
        jnp.asarray(MODE_ALPHA[mode], dtype),
        jnp.asarray(x, dtype),
        jnp.asarray(u, dtype),
    )
    wanted = complex_derivative(MASS, INERTIA, feet, MODE_ALPHA[mode], x, u)
    # A dozen roundings on sums whose terms reach a few hundred (moment over inertia).
    np.testing.assert_allclose(ours, wanted, rtol=0, atol=1e4 * np.finfo(dtype).eps)


def test_modes_count_the_stance_legs_at_each_end():
    expected = {"FLIGHT": (0, 0), "FRONT": (2, 0), "REAR": (0, 2), "TROT": (1, 1), "STAND": (2, 2)}
    expected |= {"ONE_FRONT": (1, 0), "ONE_REAR": (0, 1)}
    expected |= {"TWO_FRONT_ONE_REAR": (2, 1), "ONE_FRONT_TWO_REAR": (1, 2)}
    assert {mode.name: tuple(MODE_ALPHA[mode]) for mode in Mode} == expected
    for stance in itertools.product((False, True), repeat=4):
        alpha = (sum(stance[:2]), sum(stance[2:]))
        assert expected[contact_mode(stance).name] == alpha


@pytest.fixture(scope="module")
def spinning():
    """A hard case over 0.1 s, and scipy's answer to 1e-12."""
    x0 = np.array([0.0, 0.3, 0.2, 0.5, -0.4, 3.0])
    u = np.array([20.0, 90.0, -35.0, 60.0])
    feet = np.array([[0.2, -0.25], [-0.15, -0.3]])

    def derivative(_, x):
        return complex_derivative(MASS, INERTIA, feet, np.array([1, 1]), x, u)

    reference = solve_ivp(derivative, (0.0, 0.1), x0, method="RK45", rtol=1e-12, atol=1e-13)
    return x0, u, feet, reference.y[:, -1]


def test_rk4_follows_scipy_over_a_tenth_of_a_second(dtype, spinning):
    x0, u, feet, wanted = spinning
    states, _ = run(dtype, Mode.TROT, x0, u, steps=100, dt=0.001, feet=feet)
    # float64: scipy's own 1e-12 relative on values up to 5; Runge-Kutta's error is 3e-14 there.
    # float32: 100 steps of half a rounding of 6e-8 on values up to 5.
    tolerance = {"float32": 2e-5, "float64": 1e-11}[dtype.name]
    np.testing.assert_allclose(states[-1], wanted, rtol=0, atol=tolerance)


def test_rk4_error_falls_with_the_fourth_power_of_the_step(spinning):
    x0, u, feet, wanted = spinning
    errors = []
    for steps in (2, 4):
        states, _ = run(np.dtype("float64"), Mode.TROT, x0, u, steps, 0.1 / steps, feet)
        errors.append(np.linalg.norm(states[-1] - wanted))
    order = np.log2(errors[0] / errors[1])
    # 4 in the limit; the next term of the series shifts it by a few per cent at 25-50 ms steps.
    assert 3.8 < order < 4.3


def test_rollout_starts_at_the_initial_state_and_applies_one_input_per_step():
    rng = np.random.default_rng(0)
    x0, inputs = rng.normal(size=6), 50 * rng.normal(size=(3, 4))
    params, alpha = make(jnp.float64), jnp.ones(2)
    states = rollout(params, alpha, jnp.asarray(x0), jnp.asarray(inputs), 0.01)
    step = jax.jit(partial(srb_planar.rk4_step, dt=0.01))
    expected = [jnp.asarray(x0)]
    for u in inputs:
        expected.append(step(params, alpha, expected[-1], jnp.asarray(u)))
    # The same operations, fused differently.
    np.testing.assert_allclose(states, np.stack(expected), rtol=1e-13)


def test_rollout_traces_once_per_shape_and_keeps_the_dtype(dtype):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def traced(params, alpha, x0, inputs):
        return srb_planar.rollout(params, alpha, x0, inputs, 0.01)

    params, alpha = make(dtype), jnp.ones(2, dtype)
    for value in (0.0, 1.0):
        states = traced(params, alpha, jnp.full(6, value, dtype), jnp.full((4, 4), value, dtype))
        chex.assert_shape(states, (5, 6))
        assert states.dtype == dtype
    step = partial(srb_planar.rk4_step, dt=0.01)
    x = jnp.zeros(6, dtype)
    chex.assert_trees_all_equal_shapes_and_dtypes(
        jax.eval_shape(step, params, alpha, x, jnp.zeros(4, dtype)), jax.eval_shape(lambda: x)
    )


def test_batched_rollouts_equal_single_ones():
    rng = np.random.default_rng(3)
    x0, inputs = jnp.asarray(rng.normal(size=(3, 6))), jnp.asarray(40 * rng.normal(size=(3, 5, 4)))
    params, alpha = make(jnp.float64), jnp.array([2.0, 0.0])
    batched = jax.jit(jax.vmap(partial(srb_planar.rollout, params, alpha, dt=0.01)))(x0, inputs)
    for i in range(3):
        single = rollout(params, alpha, x0[i], inputs[i], 0.01)
        np.testing.assert_allclose(batched[i], single, rtol=1e-13)  # rounding of fused sums


def test_trajectory_derivative_by_the_force_matches_finite_differences():
    x0 = jnp.array([0.0, 0.27, 0.3, 0.5, 0.0, 2.0])
    params, alpha = make(jnp.float64), jnp.ones(2)

    @jax.jit
    def final(u):
        return srb_planar.rollout(params, alpha, x0, jnp.broadcast_to(u, (10, 4)), 0.01)[-1]

    u = jnp.array([5.0, 60.0, -5.0, 60.0])
    jacobian = jax.jit(jax.jacfwd(final))(u)
    h = 1e-2
    numeric = np.stack([(final(u + h * e) - final(u - h * e)) / (2 * h) for e in np.eye(4)], -1)
    # Central differences of 1e-2 N: truncation about (h u'''/6) below 1e-9, rounding 1e-14.
    np.testing.assert_allclose(jacobian, numeric, rtol=0, atol=1e-9)
