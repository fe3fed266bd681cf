"""The periodic reference of a bound, against an integration of the rigid body by scipy."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kjax.gait.reference import REFERENCE_NAMES, periodic_reference
from kjax.types import Mode

MASS, INERTIA, G = 12.7, 0.39, 9.81
FRONT, REAR = 0.075, 0.148  # m, horizontal levers
PAPER = (np.array([0.10, 0.10, 0.05, 0.10]), [Mode.FRONT, Mode.FLIGHT, Mode.REAR, Mode.FLIGHT])
CYCLES = {
    "paper": PAPER,
    "rear first": (np.array([0.06, 0.03, 0.12, 0.05]), PAPER[1][2:] + PAPER[1][:2]),
    "no flight": (np.array([0.15, 0.11]), [Mode.FRONT, Mode.REAR]),
    "begins in flight": (np.array([0.02, 0.08, 0.09]), [Mode.FLIGHT, Mode.REAR, Mode.FRONT]),
}
SECOND_FLIGHT, FIRST_FLIGHT = 3, 1  # of the paper's cycle


def make(name="paper"):
    durations, modes = CYCLES[name]
    made = periodic_reference(durations, modes, FRONT, REAR, MASS, INERTIA)
    return durations, modes, type(made)(*map(np.asarray, made))


def times(duration, count):
    return np.linspace(0.0, duration, count)


def integrate(x0, duration, impulse, lever, at):
    """States (p_z, theta, v_z, omega) at times ``at`` under a trapezoid of a given impulse.

    The force rises over the first quarter of the stance and falls over the last: its mean is
    three quarters of its height. Solved piece by piece between the corners.
    """
    height = impulse / (0.75 * duration)
    corners = duration * np.array([0.0, 0.25, 0.75, 1.0])

    def rate(t, x):
        force = np.interp(t, corners, [0.0, height, height, 0.0])
        return [x[2], x[3], force / MASS - G, lever * force / INERTIA]

    states = np.empty((len(at), 4))
    for begin, end in itertools.pairwise(corners):
        inside = (at >= begin - 1e-12) & (at <= end + 1e-12)
        grid = np.clip(at[inside], begin, end)
        run = solve_ivp(rate, (begin, end), x0, "DOP853", dense_output=True, rtol=1e-12, atol=1e-14)
        states[inside], x0 = run.sol(grid).T, run.y[:, -1]
    return states


@pytest.mark.parametrize("name", CYCLES)
def test_the_rows_are_the_motion_of_the_rigid_body_under_trapezoidal_forces(name):
    durations, modes, reference = make(name)
    x, total = reference.rows[0, 0], MASS * G * durations.sum()
    for phase, (duration, mode) in enumerate(zip(durations, modes, strict=True)):
        impulse = {Mode.FRONT: REAR, Mode.REAR: FRONT}.get(mode, 0.0) / (FRONT + REAR) * total
        lever = {Mode.FRONT: FRONT, Mode.REAR: -REAR}.get(mode, 0.0)
        at = times(duration, reference.rows.shape[1])
        x = integrate(x, duration, impulse, lever, at)
        # The reference holds the force over cells of 0.1 ms: jerk times cell^3 times cells, 1e-8,
        # in positions; exact in velocities. Motions are of 0.01 m, 0.1 rad, 1 m/s and 3 rad/s.
        np.testing.assert_allclose(reference.rows[phase, :, :2], x[:, :2], rtol=0, atol=2e-7)
        np.testing.assert_allclose(reference.rows[phase, :, 2:], x[:, 2:], rtol=0, atol=1e-9)
        x = x[-1]


@pytest.mark.parametrize("name", CYCLES)
def test_the_motion_has_no_jump_and_returns_to_its_start(name):
    _, _, reference = make(name)
    following = np.roll(reference.rows[:, 0], -1, axis=0)
    # Sums of 4000 terms, rounded.
    np.testing.assert_allclose(reference.rows[:, -1], following, rtol=0, atol=1e-12)
    assert np.ptp(reference.rows[..., 0]) > 1e-3
    assert np.ptp(reference.rows[..., 1]) > 1e-2


@pytest.mark.parametrize("name", CYCLES)
def test_the_impulses_carry_the_weight_and_leave_no_turn(name):
    durations, modes, reference = make(name)
    front, rear = reference.impulses
    # Rounding of four operations on 40 N s.
    assert front + rear == pytest.approx(MASS * G * durations.sum(), rel=1e-14)
    assert front * FRONT == pytest.approx(rear * REAR, rel=1e-14)
    # They are the impulses that the motion itself has had: m (dv + g T), l J / I.
    for mode, impulse, lever in ((Mode.FRONT, front, FRONT), (Mode.REAR, rear, -REAR)):
        i = modes.index(mode)
        gained = reference.rows[i, -1] - reference.rows[i, 0]
        # Sums of 1000 terms, rounded.
        assert MASS * (gained[2] + G * durations[i]) == pytest.approx(impulse, rel=1e-11)
        assert INERTIA * gained[3] == pytest.approx(lever * impulse, rel=1e-11)


@pytest.mark.parametrize("phase", [FIRST_FLIGHT, SECOND_FLIGHT])
def test_in_flight_the_body_falls_freely_and_turns_steadily(phase):
    durations, _, reference = make()
    z, theta, v_z, omega = reference.rows[phase].T
    t = times(durations[phase], len(z))
    # Sums of 4000 terms, rounded.
    np.testing.assert_allclose(z, z[0] + v_z[0] * t - G * t**2 / 2, rtol=0, atol=1e-13)
    np.testing.assert_allclose(v_z, v_z[0] - G * t, rtol=0, atol=1e-12)
    np.testing.assert_allclose(theta, theta[0] + omega[0] * t, rtol=0, atol=1e-13)
    np.testing.assert_allclose(omega, omega[0], rtol=0, atol=1e-12)


def test_front_feet_turn_the_nose_up_and_rear_feet_down():
    _, modes, reference = make()
    omega = reference.rows[..., 3]
    assert (np.diff(omega[modes.index(Mode.FRONT)]) > 0).all()
    assert (np.diff(omega[modes.index(Mode.REAR)]) < 0).all()
    assert omega[FIRST_FLIGHT, 0] > 0 > omega[SECOND_FLIGHT, 0]


@pytest.mark.parametrize("name", CYCLES)
def test_height_and_pitch_have_no_mean_over_the_two_stances(name):
    _, modes, reference = make(name)
    standing = [i for i, mode in enumerate(modes) if mode != Mode.FLIGHT]
    # Rounding of the mean of 102 values.
    np.testing.assert_allclose(reference.rows[standing, :, :2].mean(axis=(0, 1)), 0, atol=1e-15)


@pytest.mark.parametrize("name", CYCLES)
def test_rates_are_the_slopes_of_positions(name):
    assert REFERENCE_NAMES == ("p_z", "theta", "v_z", "omega")
    durations, _, reference = make(name)
    count = reference.rows.shape[1]
    for duration, rows in zip(durations, reference.rows, strict=True):
        h = duration / (count - 1)
        position, rate = rows[:, :2], rows[:, 2:]
        trapezoid = 0.5 * h * (rate[1:] + rate[:-1])
        # The rule's error is h^3 / 12 times the third derivative. The force rises to J / 0.75 T
        # within T / 4, J at most m g times the cycle, and turns with at most REAR m / I of it.
        steepest = G * durations.sum() / (0.75 * 0.25 * duration**2)
        error = h**3 / 12 * steepest * np.array([1.0, REAR * MASS / INERTIA])
        assert (np.abs(np.diff(position, axis=0) - trapezoid) <= error + 1e-9).all()
        assert np.abs(np.diff(position, axis=0)).max() > 100 * error.max()


@pytest.mark.parametrize(
    ("modes", "shares"),
    [
        ([Mode.STAND, Mode.FLIGHT], [1.0, 0.0]),  # a pronk
        ([Mode.TROT, Mode.FLIGHT, Mode.TROT, Mode.FLIGHT], [0.4, 0.0, 0.6, 0.0]),
    ],
)
def test_ends_that_stand_together_lift_without_a_turn(modes, shares):
    """Impulses of 40 and 60 % where the stances are 0.10 and 0.15 s long."""
    durations = np.array([0.10, 0.06, 0.15, 0.08])[: len(modes)]
    rows = np.asarray(periodic_reference(durations, modes, FRONT, REAR, MASS, INERTIA).rows)
    total, x = MASS * G * durations.sum(), rows[0, 0]
    for phase, (duration, share) in enumerate(zip(durations, shares, strict=True)):
        x = integrate(x, duration, share * total, 0.0, times(duration, rows.shape[1]))
        np.testing.assert_allclose(rows[phase, :, [0, 2]].T, x[:, [0, 2]], rtol=0, atol=2e-7)
        x = x[-1]
    np.testing.assert_allclose(rows[..., [1, 3]], 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(x[[0, 2]], rows[0, 0, [0, 2]], rtol=0, atol=2e-7)


def test_a_longer_flight_makes_a_higher_bound_with_more_pitch():
    ranges = []
    for flight in (0.03, 0.065, 0.10):
        durations = np.array([0.10, flight, 0.05, flight])
        rows = periodic_reference(durations, PAPER[1], FRONT, REAR, MASS, INERTIA).rows
        ranges.append(np.ptp(rows.reshape(-1, 4), axis=0))
    assert (np.diff(ranges, axis=0) > 0).all()


@pytest.mark.parametrize(
    "modes",
    [
        [Mode.FRONT, Mode.FLIGHT],
        [Mode.FLIGHT, Mode.REAR],
        [Mode.FRONT, Mode.REAR, Mode.REAR],
        [Mode.TROT, Mode.TROT],
        [Mode.STAND],
        [Mode.FRONT, Mode.STAND],
        [],
    ],
)
def test_a_cycle_without_one_front_and_one_rear_stance_is_refused(modes):
    with pytest.raises(ValueError, match="front and rear must stand"):
        periodic_reference(np.full(len(modes), 0.1), modes, FRONT, REAR, MASS, INERTIA)
