"""Gaits as arrays, the phase clock and the switch, against unrolled time lines."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import gait
from kjax.gait import Gait, Phase
from kjax.types import Leg, Mode

FRONT = (True, True, False, False)
REAR = (False, False, True, True)
NONE = (False, False, False, False)
ALL = (True, True, True, True)
BOUND = Gait(
    "by hand",
    (
        Phase(FRONT, 0.10),
        Phase(NONE, 0.04),
        Phase(REAR, 0.12),
        Phase(NONE, 0.06),
    ),
)


def one(name, *phases, **rules):
    return Gait(name, phases, **rules)


def trot(stance_time, flight_time=0.0):
    period = 2.0 * (stance_time + flight_time)
    duty = stance_time / period
    return one("trot", *gait.phases(period, (0.0, 0.5, 0.5, 0.0), (duty,) * 4))


def stand(duration=1.0, **rules):
    return one(rules.pop("name", "stand"), *gait.phases(duration, (0.0,) * 4, (1.0,) * 4), **rules)


def bounding(stances, flights, **rules):
    return one(
        "bound", Phase(FRONT, stances[0]), Phase(NONE, flights[0]),
        Phase(REAR, stances[1]), Phase(NONE, flights[1]), **rules,
    )  # fmt: skip


def cast(tree, dtype):
    """Floating leaves in another precision, the rest as they are."""
    return jax.tree.map(
        lambda a: np.asarray(a, dtype if jnp.issubdtype(a.dtype, jnp.floating) else None), tree
    )


def begin(index, dt, dtype="float64"):
    """Clock whose first tick is the beginning of a gait."""
    return cast(gait.start(jnp.asarray(index), jnp.asarray(-dt)), dtype)


@partial(jax.jit, static_argnames=("dt", "ticks"))
def run_clock(schedule, clock, dt, ticks):
    def tick(clock, _):
        clock = gait.advance(schedule, clock, dt)
        return clock, clock

    return jax.lax.scan(tick, clock, length=ticks)[1]


def record(schedule, *, dt, ticks, index=0, dtype="float64"):
    """Phase and elapsed time at each of ``ticks`` ticks."""
    clocks = run_clock(cast(schedule, dtype), begin(index, dt, dtype), dt, ticks)
    return np.asarray(clocks.phase), np.asarray(clocks.elapsed)


def entries(phase):
    """Ticks at which a phase is entered, the first tick among them."""
    return np.flatnonzero(np.diff(phase, prepend=-1))


def test_the_first_tick_enters_the_first_phase_at_its_beginning():
    phase, elapsed = record(gait.build_schedule([BOUND]), dt=0.005, ticks=1)
    assert phase[0] == 0
    assert elapsed[0] == 0.0


def test_trot_alternates_the_diagonals():
    schedule = gait.build_schedule([trot(0.25)])
    phase, _ = record(schedule, dt=0.005, ticks=200)
    stance = np.asarray(schedule.stance[0])[phase]
    first = stance[:50]
    assert first[:, [Leg.FR, Leg.RL]].all()
    assert not first[:, [Leg.FL, Leg.RR]].any()
    # 0.25 s is 50 ticks: the same for the other diagonal, and over again.
    np.testing.assert_array_equal(stance[50:100], ~first)
    np.testing.assert_array_equal(stance[100:], stance[:100])
    np.testing.assert_array_equal(schedule.mode[0], Mode.TROT)


def test_a_flying_trot_leaves_the_ground_after_each_diagonal():
    schedule = gait.build_schedule([trot(0.20, 0.05)])
    phase, _ = record(schedule, dt=0.005, ticks=200)
    stance, mode = np.asarray(schedule.stance[0])[phase], np.asarray(schedule.mode[0])[phase]
    diagonal = np.array([True, False, False, True])
    expected = [diagonal] * 40 + [[False] * 4] * 10 + [~diagonal] * 40 + [[False] * 4] * 10
    np.testing.assert_array_equal(stance, np.tile(expected, (2, 1)))
    np.testing.assert_array_equal(mode, np.where(stance.any(axis=1), Mode.TROT, Mode.FLIGHT))


@pytest.mark.parametrize("stance_time", [0.25, 0.2513, 0.0171, 0.005])
def test_the_mean_period_is_exact_whatever_the_tick(dtype, stance_time):
    dt, ticks = 0.005, 20_000
    schedule = gait.build_schedule([trot(stance_time)])
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
    "trot": trot(0.2),
    "flying trot": trot(0.2, 0.03),
    "bound": BOUND,
    "stance over the end of the cycle": one(
        "odd",
        Phase(FRONT, 0.10),
        Phase(REAR, 0.12),
        Phase(ALL, 0.05),
    ),
}


@pytest.mark.parametrize("name", GAITS)
def test_touchdown_and_stance_times_are_those_of_the_unrolled_time_line(name):
    phases = GAITS[name].phases
    schedule = gait.build_schedule([GAITS[name]])
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
    np.testing.assert_allclose(
        schedule.flight_to_touchdown[0, :, Leg.FL],
        [[0.0, 0.0], [0.10, 0.0], [0.06, 0.0], [0.06, 0.0]],
        rtol=0,
        atol=1e-15,
    )
    np.testing.assert_allclose(
        schedule.flight_to_touchdown[0, :, Leg.RR],  # the last flight is of this cycle, the first
        [[0.04, 0.0], [0.04, 0.0], [0.0, 0.0], [0.06, 0.04]],  # of the next one
        rtol=0,
        atol=1e-15,
    )
    np.testing.assert_array_equal(schedule.stance_time[0, :, Leg.FL], 0.10)
    np.testing.assert_array_equal(schedule.stance_time[0, :, Leg.RR], 0.12)


def test_a_leg_that_always_stands_stands_for_the_whole_cycle():
    schedule = gait.build_schedule([stand()])
    np.testing.assert_array_equal(schedule.stance_time, 1.0)
    np.testing.assert_array_equal(schedule.time_to_touchdown, 0.0)


def test_every_time_in_a_schedule_is_a_floating_number():
    for phases in (stand(), trot(0.25)):
        schedule = gait.build_schedule([phases])
        for times in (
            schedule.duration,
            schedule.time_to_touchdown,
            schedule.flight_to_touchdown,
            schedule.stance_time,
            schedule.ramp_start,
        ):
            assert times.dtype == jnp.float64


def test_a_shorter_gait_never_enters_its_padding():
    schedule = gait.build_schedule([trot(0.02), BOUND])
    chex.assert_shape(schedule.stance, (2, 4, 4))
    short, _ = record(schedule, dt=0.005, ticks=100, index=0)
    bound, _ = record(schedule, dt=0.005, ticks=200, index=1)
    assert set(short) == {0, 1}
    assert set(bound) == {0, 1, 2, 3}
    alone, _ = record(gait.build_schedule([trot(0.02)]), dt=0.005, ticks=100)
    np.testing.assert_array_equal(short, alone)


def test_phases_come_in_order():
    phase, _ = record(gait.build_schedule([BOUND]), dt=0.005, ticks=300)
    order = phase[entries(phase)]
    np.testing.assert_array_equal(order, np.arange(len(order)) % 4)


def test_the_clock_moves_on_by_one_phase_at_most():
    """A tick of half a second is longer than the whole cycle."""
    phase, _ = record(gait.build_schedule([BOUND]), dt=0.5, ticks=9)
    np.testing.assert_array_equal(np.diff(phase) % 4, 1)


def test_gaits_in_a_batch_are_an_index_and_trace_once(dtype):
    schedule = gait.build_schedule([trot(0.02), stand(), BOUND])
    schedule = jax.tree.map(jnp.asarray, cast(schedule, dtype))

    @jax.jit
    @chex.assert_max_traces(n=1)
    def advance(clock):
        return gait.advance(schedule, clock, 0.005)

    clock = begin(0, 0.005, dtype)
    for index in range(3):
        next_clock = advance(clock._replace(gait=np.asarray(index)))
        chex.assert_trees_all_equal_shapes_and_dtypes(next_clock, clock)
        assert next_clock.gait == index


# The ramp of the flights. Phases that are no multiples of the tick and a ramp of 7 ms a cycle.
RAMP_START, RAMP_CYCLES, STANCES, FLIGHTS = 0.3, 10, (0.1017, 0.0508), (0.1003, 0.0991)


def ramped(**changes):
    settings = {"ramp_start": RAMP_START, "ramp_cycles": RAMP_CYCLES} | changes
    return bounding(STANCES, FLIGHTS, switch_rule="first_flight", **settings)


def unrolled(cycles, *, start=RAMP_START, grown_after=RAMP_CYCLES):
    """Begin of every phase of ``cycles`` cycles and one more, by hand (4 a cycle)."""
    scale = np.ones(cycles)
    scale[:grown_after] = np.linspace(start, 1.0, grown_after + 1)[:-1]
    durations = np.stack(
        [
            np.full(cycles, STANCES[0]),
            scale * FLIGHTS[0],
            np.full(cycles, STANCES[1]),
            scale * FLIGHTS[1],
        ],
        axis=1,
    )
    return np.concatenate([[0.0], np.cumsum(durations)])


@pytest.fixture(scope="module")
def ramp():
    """Clocks of 15 cycles of a ramped bound at 200 Hz, and their times to touchdown."""
    dt = 0.005
    begins = unrolled(15)
    schedule = gait.build_schedule([trot(0.25), ramped()])
    clocks = run_clock(schedule, begin(1, dt), dt, int(begins[-1] / dt))
    waits = jax.jit(jax.vmap(partial(gait.time_to_touchdown, schedule)))(clocks)
    lengths = jax.jit(jax.vmap(partial(gait.phase_duration, schedule)))(clocks)
    return dt, begins, jax.device_get(clocks), np.asarray(waits), np.asarray(lengths)


def test_flights_grow_over_the_ramp_and_every_phase_begins_at_the_nearest_tick(ramp):
    dt, begins, clocks, _, lengths = ramp
    place = 4 * clocks.cycle + clocks.phase
    first = entries(place)
    np.testing.assert_array_equal(place[first], np.arange(len(first)))
    assert len(first) > 4 * 14
    # Nearest tick, and sums of 3e2 ticks rounded.
    assert np.abs(first * dt - begins[: len(first)]).max() <= dt / 2 + 1e-12
    np.testing.assert_allclose(lengths, np.diff(begins)[place], rtol=0, atol=1e-14)


def test_after_the_ramp_the_period_is_the_full_one(ramp):
    dt, _, clocks, _, _ = ramp
    place = 4 * clocks.cycle + clocks.phase
    period = sum(STANCES) + sum(FLIGHTS)
    due = np.flatnonzero(np.diff(clocks.cycle))[RAMP_CYCLES - 1 :] * dt
    assert len(due) == 5
    # Both ends on the nearest tick; the first cycle is 0.14 s shorter.
    assert np.abs(np.diff(due) - period).max() <= dt
    first = entries(place)[4] * dt
    assert abs(first - (sum(STANCES) + RAMP_START * sum(FLIGHTS))) <= dt / 2


@pytest.mark.parametrize(
    "legs",
    [
        pytest.param([Leg.FR, Leg.FL], id="front"),
        pytest.param(
            [Leg.RR, Leg.RL],
            id="rear",
        ),
    ],
)
def test_the_time_to_touchdown_is_that_of_the_unrolled_time_line(ramp, legs):
    dt, begins, clocks, waits, _ = ramp
    own = 0 if legs[0] == Leg.FR else 2
    now = dt * np.arange(len(waits))
    stances = begins[own::4]
    standing = clocks.phase == own
    np.testing.assert_array_equal(waits[standing][:, legs], 0.0)
    # A stance may begin up to half a tick late; it is still the one that is waited for.
    next_one = np.searchsorted(stances, now - dt / 2 - 1e-9)
    known = ~standing & (next_one < len(stances))
    expected = stances[next_one[known]] - now[known]
    # The clock carries remainders over, so that only rounding is left.
    np.testing.assert_allclose(waits[known][:, legs[0]], expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(waits[:, legs[0]], waits[:, legs[1]])


def test_without_ramp_cycles_the_first_flight_is_a_full_one():
    schedule = gait.build_schedule([ramped(ramp_cycles=0)])
    phase, _ = record(schedule, dt=0.005, ticks=100)
    begins = unrolled(2, grown_after=0)
    assert np.abs(entries(phase)[:5] * 0.005 - begins[:5]).max() <= 0.0025 + 1e-12


def test_a_ramp_that_begins_at_full_length_is_none():
    dt = 0.005
    phase, _ = record(gait.build_schedule([ramped(ramp_start=1.0)]), dt=dt, ticks=300)
    begins, first = unrolled(5, grown_after=0), entries(phase)
    assert len(first) > 16
    assert np.abs(first * dt - begins[: len(first)]).max() <= dt / 2 + 1e-12


# The switch. Ticks and phases are fractions of two, so that no time is rounded.
TICK = 1 / 256
TICKS = np.array([26, 25, 13, 25])  # phases of the bound; a cycle is 89
CYCLE = TICKS.sum()
STANCE_TICKS, LANDING_TICKS = 32, 18
TROT, BOUNDING, LANDING = 0, 1, 2


def gaits(*, anywhere=False, landing=False, tick=TICK):
    return gait.build_schedule(
        [
            trot(STANCE_TICKS * tick),
            bounding(
                TICKS[::2] * tick,
                TICKS[1::2] * tick,
                switch_rule="anywhere" if anywhere else "first_flight",
                transition_gait="landing" if landing else "",
            ),
            stand(LANDING_TICKS * tick, name="landing", switch_rule="cycle_end"),
        ]
    )


@partial(jax.jit, static_argnames="dt")
def _follow(schedule, clock, wanted, dt):
    def tick(clock, wanted):
        clock = gait.advance(schedule, clock, dt, wanted)
        return clock, clock

    return jax.vmap(lambda line: jax.lax.scan(tick, clock, line)[1])(wanted)


def follow(schedule, clock, wanted, dt):
    """Clocks (R, ticks) of robots that want gaits ``wanted`` (R, ticks)."""
    return jax.device_get(_follow(schedule, clock, wanted, dt))


def requests(first, then, ticks, length):
    """Wanted gaits (R, length): another one from each of ``ticks`` on."""
    return np.where(np.arange(length) >= ticks[:, None], then, first)


LENGTH = 3 * CYCLE
ASKED = np.arange(1, CYCLE + 1)  # every tick of a cycle but the first, which begins the gait


def switched(clocks, index):
    """First tick at which each robot is in a gait."""
    within = clocks.gait == index
    assert within.any(axis=1).all()
    return within.argmax(axis=1)


def at(clocks, ticks):
    return jax.tree.map(lambda leaf: leaf[np.arange(len(ticks)), ticks], clocks)


def test_a_trot_is_left_at_the_tick_asked_for():
    clocks = follow(gaits(), begin(TROT, TICK), requests(TROT, BOUNDING, ASKED, LENGTH), TICK)
    np.testing.assert_array_equal(switched(clocks, BOUNDING), ASKED)
    entered = at(clocks, ASKED)
    np.testing.assert_array_equal(entered.phase, 0)
    np.testing.assert_array_equal(entered.elapsed, 0.0)
    np.testing.assert_array_equal(entered.cycle, 0)
    # From there on it is the bound that a robot starts with.
    fresh = np.asarray(run_clock(gaits(), begin(BOUNDING, TICK), TICK, int(CYCLE)).phase)
    for robot, tick in enumerate(ASKED):
        np.testing.assert_array_equal(clocks.phase[robot, tick : tick + CYCLE], fresh)


def bound_phase(tick):
    """Phase of the bound at a tick, by hand."""
    return np.searchsorted(np.cumsum(TICKS), tick % CYCLE, side="right")


@pytest.mark.parametrize("landing", [False, True])
def test_a_bound_is_left_as_the_flight_after_front_stance_begins_and_not_else(landing):
    schedule = gaits(landing=landing)
    wanted = requests(BOUNDING, TROT, ASKED, LENGTH)
    clocks = follow(schedule, begin(BOUNDING, TICK), wanted, TICK)
    left = switched(clocks, LANDING if landing else TROT)
    begins = [t for t in range(1, LENGTH) if bound_phase(t) == 1 and bound_phase(t - 1) == 0]
    np.testing.assert_array_equal(left, [min(t for t in begins if t >= a) for a in ASKED])
    # Asked just as it begins, it leaves then; asked a tick later, it waits for a whole cycle.
    assert (left - ASKED).min() == 0
    assert (left - ASKED).max() == CYCLE - 1


@pytest.mark.parametrize("landing", [False, True])
def test_a_bound_that_may_be_left_anywhere_is_left_at_once(landing):
    schedule = gaits(anywhere=True, landing=landing)
    wanted = requests(BOUNDING, TROT, ASKED, LENGTH)
    clocks = follow(schedule, begin(BOUNDING, TICK), wanted, TICK)
    np.testing.assert_array_equal(switched(clocks, LANDING if landing else TROT), ASKED)


def test_a_landing_stands_on_four_legs_for_its_time_and_then_enters_the_gait_wanted():
    schedule = gaits(landing=True)
    wanted = requests(BOUNDING, TROT, ASKED, LENGTH)
    clocks = follow(schedule, begin(BOUNDING, TICK), wanted, TICK)
    landed, trotting = switched(clocks, LANDING), switched(clocks, TROT)
    np.testing.assert_array_equal(trotting - landed, LANDING_TICKS)
    stance, mode = np.asarray(schedule.stance), np.asarray(schedule.mode)
    for robot in range(len(ASKED)):
        during = slice(landed[robot], trotting[robot])
        where = clocks.gait[robot, during], clocks.phase[robot, during]
        assert stance[where].all()
        np.testing.assert_array_equal(mode[where], Mode.STAND)
        np.testing.assert_array_equal(clocks.gait[robot, trotting[robot] :], TROT)
    entered = at(clocks, trotting)
    np.testing.assert_array_equal(entered.phase, 0)
    np.testing.assert_array_equal(entered.elapsed, 0.0)


def test_a_trot_never_lands():
    wanted = requests(TROT, BOUNDING, ASKED, LENGTH)
    clocks = follow(gaits(landing=True), begin(TROT, TICK), wanted, TICK)
    assert not (clocks.gait == LANDING).any()
    np.testing.assert_array_equal(switched(clocks, BOUNDING), ASKED)


@pytest.mark.parametrize("index", [TROT, BOUNDING])
def test_wanting_the_gait_one_is_in_changes_nothing(index):
    schedule = gaits(anywhere=True, landing=True)
    clock = begin(index, TICK)
    wanted = follow(schedule, clock, np.full((1, LENGTH), index), TICK)
    left_alone = run_clock(schedule, clock, TICK, int(LENGTH))
    chex.assert_trees_all_equal(jax.tree.map(lambda a: a[0], wanted), left_alone)


def test_a_request_withdrawn_before_it_may_be_met_changes_nothing():
    schedule, clock = gaits(), begin(BOUNDING, TICK)
    flights = TICKS[:2].sum(), CYCLE + TICKS[0]  # end of the first, begin of the next
    tick = np.arange(LENGTH)
    wanted = np.where((tick >= flights[0]) & (tick < flights[1]), TROT, BOUNDING)
    clocks = follow(schedule, clock, wanted[None], TICK)
    chex.assert_trees_all_equal(
        jax.tree.map(lambda a: a[0], clocks), run_clock(schedule, clock, TICK, int(LENGTH))
    )
    # One tick more and it is met.
    late = np.where(tick == flights[1], TROT, wanted)[None]
    assert follow(schedule, clock, late, TICK).gait[0, flights[1]] == TROT


def test_a_switch_does_not_wait_for_the_remainder_of_a_phase(dtype):
    """A phase of 10.6 ticks ends at the 11th, one of 10.4 at the 10th: both may be left then."""
    dt = 0.005
    schedule = cast(gait.build_schedule([trot(10.6 * dt), BOUND]), dtype)
    clocks = follow(schedule, begin(0, dt, dtype), requests(0, 1, ASKED, LENGTH), dt)
    np.testing.assert_array_equal(switched(clocks, 1), ASKED)


def test_a_robot_that_waits_for_its_start_keeps_its_gait():
    """Robots of a batch may start later; a request does not make them start."""
    clock = gait.start(jnp.asarray(TROT), jnp.asarray(-10 * TICK))
    clocks = follow(gaits(), clock, np.full((1, 20), BOUNDING), TICK)
    np.testing.assert_array_equal(clocks.gait[0], [TROT] * 10 + [BOUNDING] * 10)


def test_switches_of_any_kind_trace_once_and_keep_the_clock_s_types(dtype):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def tick(schedule, clock, wanted):
        return gait.advance(schedule, clock, 0.005, wanted)

    for anywhere, landing in ((False, False), (True, False), (True, True)):
        schedule = cast(gaits(anywhere=anywhere, landing=landing), dtype)
        for now in (TROT, BOUNDING, LANDING):
            for wanted in (TROT, BOUNDING):
                clock = begin(now, 0.005, dtype)
                next_clock = tick(schedule, clock, np.asarray(wanted))
                chex.assert_trees_all_equal_shapes_and_dtypes(next_clock, clock)


@pytest.mark.parametrize(
    ("gaits", "message"),
    [
        ([], "gaits must be"),
        ([stand(), one("empty")], "gaits must be"),
        ([one("x", Phase(FRONT, 0.0))], r"durations must be positive, got 0"),
        ([one("x", Phase(FRONT, -0.1))], r"durations must be positive, got -0.1"),
        ([one("x", Phase(FRONT, np.nan))], r"durations must be positive, got nan"),
        ([one("x", Phase(FRONT, 0.1))], "leg 2 never stands"),
        ([bounding((0.1, 0.1), (0.0, 0.1))], "must be positive"),
        ([one("x", Phase(NONE, 0.1))], "leg 0 never stands"),
        ([stand(0.0)], r"durations must be positive, got 0"),
        ([stand(switch_rule="first_flight")], "stand has no flight"),
        ([stand(), one("x", *BOUND.phases, transition_gait="nowhere")], "'nowhere'"),
    ],
)
def test_a_gait_that_cannot_be_walked_is_refused(gaits, message):
    with pytest.raises(ValueError, match=message):
        gait.build_schedule(gaits)


OFFSETS = {  # touchdown and duty factor of FR, FL, RR, RL -> phases: legs that stand, in sixtieths
    "trot": ((0, 0.5, 0.5, 0), (0.5,) * 4, [("FR RL", 30), ("FL RR", 30)]),
    "flying trot": (
        (0, 0.5, 0.5, 0), (5 / 12,) * 4, [("FR RL", 25), ("", 5), ("FL RR", 25), ("", 5)],
    ),
    "pace": ((0, 0.5, 0, 0.5), (0.5,) * 4, [("FR RR", 30), ("FL RL", 30)]),
    "pronk": ((0,) * 4, (0.6,) * 4, [("FR FL RR RL", 36), ("", 24)]),
    "walk": (
        (0.5, 0, 0.25, 0.75), (0.75,) * 4,
        [("FR FL RL", 15), ("FL RR RL", 15), ("FR FL RR", 15), ("FR RR RL", 15)],
    ),
    "bound": (
        (0, 0, 4 / 7, 4 / 7), (2 / 7, 2 / 7, 1 / 7, 1 / 7),
        [("FR FL", 120 / 7), ("", 120 / 7), ("RR RL", 60 / 7), ("", 120 / 7)],
    ),
    "stand": ((0.3,) * 4, (1.0,) * 4, [("FR FL RR RL", 60)]),
    "none at the beginning": (
        (0.1, 0.1, 0.6, 0.6), (0.5,) * 4, [("FR FL", 30), ("RR RL", 30)],
    ),
    "over the end of the cycle": (
        (0.8, 0.8, 0.3, 0.3), (0.4, 0.4, 0.5, 0.5), [("", 6), ("RR RL", 30), ("FR FL", 24)],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", OFFSETS)
def test_offsets_and_duty_factors_give_the_phases(name):
    offset, duty, wanted = OFFSETS[name]
    found = gait.phases(0.6, tuple(map(float, offset)), tuple(map(float, duty)))
    legs = [" ".join(Leg(i).name for i in range(4) if phase.stance[i]) for phase in found]
    assert legs == [text for text, _ in wanted]
    durations = [phase.duration for phase in found]
    np.testing.assert_allclose(durations, [0.01 * part for _, part in wanted], rtol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_legs_of_any_gait_stand_from_their_touchdown_for_their_duty_factor(seed):
    rng = np.random.default_rng(seed)
    offset, duty = rng.uniform(0, 1, 4), rng.uniform(0.1, 0.95, 4)
    found = gait.phases(1.0, offset.tolist(), duty.tolist())
    begin = min(list(offset) + list((offset + duty) % 1.0))
    phase_ends = begin + np.cumsum([phase.duration for phase in found])
    assert phase_ends[-1] == pytest.approx(begin + 1.0, abs=1e-12)
    for at in begin + (np.arange(500) + 0.5) / 500:
        phase = found[int(np.searchsorted(phase_ends, at))]
        assert phase.stance == tuple((at - offset) % 1.0 < duty)
