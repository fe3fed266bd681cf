"""Gaits as arrays and the phase clock, against an unrolled time line."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import gait
from kjax.gait import Phase
from kjax.types import Leg, Mode

FRONT = (True, True, False, False)
REAR = (False, False, True, True)
NONE = (False, False, False, False)
BOUND = [
    Phase(FRONT, Mode.FRONT, 0.10),
    Phase(NONE, Mode.FLIGHT, 0.04),
    Phase(REAR, Mode.REAR, 0.12),
    Phase(NONE, Mode.FLIGHT, 0.06),
]


def cast(tree, dtype):
    """Floating leaves in another precision, the rest as they are."""
    return jax.tree.map(
        lambda a: np.asarray(a, dtype if jnp.issubdtype(a.dtype, jnp.floating) else None), tree
    )


@partial(jax.jit, static_argnames=("dt", "ticks"))
def walk(schedule, clock, dt, ticks):
    def tick(clock, _):
        clock = gait.advance(schedule, clock, dt)
        return clock, (clock.phase, clock.elapsed)

    return jax.lax.scan(tick, clock, length=ticks)[1]


def record(schedule, *, dt, ticks, index=0, dtype="float64"):
    """Phase and elapsed time at each of ``ticks`` ticks."""
    phase, elapsed = walk(cast(schedule, dtype), cast(gait.start(index, dt), dtype), dt, ticks)
    return np.asarray(phase), np.asarray(elapsed)


def entries(phase):
    """Ticks at which a phase is entered, the first tick among them."""
    return np.flatnonzero(np.diff(phase, prepend=-1))


def test_the_first_tick_enters_the_first_phase_at_its_beginning():
    phase, elapsed = record(gait.build_schedule([BOUND]), dt=0.005, ticks=1)
    assert phase[0] == 0
    assert elapsed[0] == 0.0


def test_trot_alternates_the_diagonals():
    schedule = gait.build_schedule([gait.trot(0.25)])
    phase, _ = record(schedule, dt=0.005, ticks=200)
    stance = np.asarray(schedule.stance[0])[phase]
    first = stance[:50]
    assert first[:, [Leg.FR, Leg.RL]].all()
    assert not first[:, [Leg.FL, Leg.RR]].any()
    # 0.25 s is 50 ticks: the same for the other diagonal, and over again.
    np.testing.assert_array_equal(stance[50:100], ~first)
    np.testing.assert_array_equal(stance[100:], stance[:100])
    np.testing.assert_array_equal(schedule.mode[0], Mode.TROT)


@pytest.mark.parametrize("stance_time", [0.25, 0.2513, 0.0171, 0.005])
def test_the_mean_period_is_exact_whatever_the_tick(dtype, stance_time):
    dt, ticks = 0.005, 20_000
    schedule = gait.build_schedule([gait.trot(stance_time)])
    phase, elapsed = record(schedule, dt=dt, ticks=ticks, dtype=dtype)
    switch = entries(phase) * dt
    ideal = np.arange(len(switch)) * np.asarray(stance_time, dtype).astype(float)
    # Each switch falls on the tick nearest to its due time. In float32 the clock itself drifts by
    # its rounding, 3e-8 relative a tick of up to 0.25 s, over 100 s: allow half a tick more.
    slack = {"float32": dt / 2, "float64": 1e-9}[dtype.name]
    assert np.abs(switch - ideal).max() <= dt / 2 + slack
    assert abs(len(switch) - ticks * dt / stance_time) <= 2
    assert elapsed.min() >= -dt / 2 - slack


def timeline(phases, leg):
    """Stances of a leg as (begin, end) over several cycles, merged where phases adjoin."""
    stances, now = [], 0.0
    for phase in phases * 4:
        if phase.stance[leg]:
            if stances and abs(stances[-1][1] - now) < 1e-9:
                stances[-1][1] = now + phase.duration
            else:
                stances.append([now, now + phase.duration])
        now += phase.duration
    return stances


GAITS = {
    "trot": gait.trot(0.2),
    "bound": BOUND,
    "stance over the end of the cycle": [
        Phase(FRONT, Mode.FRONT, 0.10),
        Phase(REAR, Mode.REAR, 0.12),
        Phase((True, True, True, True), Mode.STAND, 0.05),
    ],
}


@pytest.mark.parametrize("name", GAITS)
def test_touchdown_and_stance_times_are_those_of_the_unrolled_time_line(name):
    phases = GAITS[name]
    schedule = gait.build_schedule([phases])
    cycle = sum(phase.duration for phase in phases)
    for index in range(len(phases)):
        now = cycle + sum(phase.duration for phase in phases[:index])
        for leg in Leg:
            begin, end = next(s for s in timeline(phases, leg) if s[1] > now + 1e-9)
            wait = schedule.time_to_touchdown[0, index, leg]
            length = schedule.stance_time[0, index, leg]
            # Sums of up to twelve durations, rounded.
            np.testing.assert_allclose(wait, max(begin - now, 0.0), rtol=0, atol=1e-14)
            np.testing.assert_allclose(length, end - begin, rtol=0, atol=1e-14)


def test_a_bound_waits_out_flight_and_the_other_pair():
    """The same by hand: what is left of the cycle before the leg's own phase."""
    schedule = gait.build_schedule([BOUND])
    # Rounding of sums of three durations.
    np.testing.assert_allclose(
        schedule.time_to_touchdown[0, :, Leg.FL], [0.0, 0.22, 0.18, 0.06], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(
        schedule.time_to_touchdown[0, :, Leg.RR], [0.14, 0.04, 0.0, 0.20], rtol=0, atol=1e-15
    )
    np.testing.assert_array_equal(schedule.stance_time[0, :, Leg.FL], 0.10)
    np.testing.assert_array_equal(schedule.stance_time[0, :, Leg.RR], 0.12)


def test_a_leg_that_always_stands_stands_for_the_whole_cycle():
    schedule = gait.build_schedule([gait.stand()])
    np.testing.assert_array_equal(schedule.stance_time, 1.0)
    np.testing.assert_array_equal(schedule.time_to_touchdown, 0.0)


def test_every_time_in_a_schedule_is_a_floating_number():
    for phases in (gait.stand(), gait.trot(0.25)):
        schedule = gait.build_schedule([phases])
        for times in (schedule.duration, schedule.time_to_touchdown, schedule.stance_time):
            assert times.dtype == jnp.float64


def test_a_shorter_gait_never_enters_its_padding():
    schedule = gait.build_schedule([gait.trot(0.02), BOUND])
    chex.assert_shape(schedule.stance, (2, 4, 4))
    trot, _ = record(schedule, dt=0.005, ticks=100, index=0)
    bound, _ = record(schedule, dt=0.005, ticks=200, index=1)
    assert set(trot) == {0, 1}
    assert set(bound) == {0, 1, 2, 3}
    alone, _ = record(gait.build_schedule([gait.trot(0.02)]), dt=0.005, ticks=100)
    np.testing.assert_array_equal(trot, alone)


def test_phases_come_in_order():
    phase, _ = record(gait.build_schedule([BOUND]), dt=0.005, ticks=300)
    order = phase[entries(phase)]
    np.testing.assert_array_equal(order, np.arange(len(order)) % 4)


def test_the_clock_moves_on_by_one_phase_at_most():
    """A tick of half a second is longer than the whole cycle."""
    phase, _ = record(gait.build_schedule([BOUND]), dt=0.5, ticks=9)
    np.testing.assert_array_equal(np.diff(phase) % 4, 1)


def test_gaits_in_a_batch_are_an_index_and_trace_once(dtype):
    schedule = gait.build_schedule([gait.trot(0.02), gait.stand(), BOUND])
    schedule = jax.tree.map(jnp.asarray, cast(schedule, dtype))

    @jax.jit
    @chex.assert_max_traces(n=1)
    def advance(clock):
        return gait.advance(schedule, clock, 0.005)

    clock = cast(gait.start(0, 0.005), dtype)
    for index in range(3):
        moved = advance(clock._replace(gait=np.int32(index)))
        chex.assert_trees_all_equal_shapes_and_dtypes(moved, clock)
        assert moved.gait == index


@pytest.mark.parametrize(
    ("gaits", "message"),
    [
        ([], "gaits must be"),
        ([gait.stand(), []], "gaits must be"),
        ([[Phase(FRONT, Mode.FRONT, 0.0)]], r"durations must be positive, got 0"),
        ([[Phase(FRONT, Mode.FRONT, -0.1)]], r"durations must be positive, got -0.1"),
        ([[Phase(FRONT, Mode.FRONT, float("nan"))]], r"durations must be positive, got nan"),
        ([[Phase(FRONT, Mode.FRONT, 0.1)]], "leg 2 never stands"),
    ],
)
def test_a_gait_that_cannot_be_walked_is_refused(gaits, message):
    with pytest.raises(ValueError, match=message):
        gait.build_schedule(gaits)
