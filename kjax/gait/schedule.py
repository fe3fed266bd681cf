"""Gaits as arrays, and the phase clock that runs through them.

A gait is a cycle of phases; each phase says which legs stand, in which contact mode, for how long.
Gaits are stacked on a leading axis and padded to one number of phases, so that picking or
switching a gait is an index and never recompiles.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax.types import Mode, contact_mode

SwitchRule = Literal["anywhere", "first_flight", "cycle_end"]


class Phase(NamedTuple):
    """One phase of a gait: the same legs stand.

    Attributes:
      stance: whether each leg stands, order FR, FL, RR, RL.
      duration: [s].
    """

    stance: tuple[bool, bool, bool, bool]
    duration: float

    @property
    def flies(self) -> bool:
        """Whether no leg stands."""
        return not any(self.stance)


class Gait(NamedTuple):
    """A cycle of phases.

    Attributes:
      name: of the gait.
      phases: in order.
      ramp_start: flights begin at this fraction of their length and grow to all of it [-].
      ramp_cycles: over so many cycles; 0 for no ramp.
      switch_rule: when it may be left: "anywhere", as the "first_flight" of its cycle begins, or at
        the "cycle_end".
      transition_gait: name of the gait in between when this one is left; itself for none.
    """

    name: str
    phases: tuple[Phase, ...]
    ramp_start: float = 1.0
    ramp_cycles: int = 0
    switch_rule: SwitchRule = "anywhere"
    transition_gait: str = ""

    @property
    def period(self) -> float:
        """Length of a cycle, flights at full length [s]."""
        return sum(phase.duration for phase in self.phases)

    def durations(self, cycle: int) -> list[float]:
        """Length of each phase in a cycle, counted from the gait's beginning [s]."""
        grown = min(cycle / self.ramp_cycles, 1.0) if self.ramp_cycles else 1.0
        scale = self.ramp_start + (1.0 - self.ramp_start) * grown
        return [p.duration * (scale if p.flies else 1.0) for p in self.phases]

    def may_leave(self) -> list[bool]:
        """Whether a switch to another gait may happen during each phase."""
        if self.switch_rule == "anywhere":
            return [True] * len(self.phases)
        at = 0
        if self.switch_rule == "first_flight":
            flights = [i for i, phase in enumerate(self.phases) if phase.flies]
            if not flights:
                raise ValueError(f"{self.name} has no flight that it could be left in")
            at = flights[0]
        return [i == at for i in range(len(self.phases))]


def phases(period: float, offset: Sequence[float], duty: Sequence[float]) -> tuple[Phase, ...]:
    """Phases of a cycle from when each leg touches down and how long it stands.

    Args:
      period: of the cycle [s].
      offset: (4,) touchdown of each leg, part of the cycle [-].
      duty: (4,) part of the cycle in which it stands, from there on; 1 for always [-].

    Returns:
      Those between touchdowns and lift-offs in order, from the first of these at or after the
      cycle's beginning on.
    """
    same = 1e-9  # parts of a cycle that rounding leaves between two events at once
    events: list[float] = []
    for begin, length in zip(offset, duty, strict=True):
        for event in (begin, begin + length) if length < 1.0 - same else ():
            at = event % 1.0
            at = 0.0 if at > 1.0 - same else at
            if all(abs(at - other) > same for other in events):
                events.append(at)
    events = sorted(events) or [0.0]
    out = []
    for at, until in itertools.pairwise([*events, events[0] + 1.0]):
        middle = 0.5 * (at + until)
        stands = [
            (middle - begin) % 1.0 < length for begin, length in zip(offset, duty, strict=True)
        ]
        fr, fl, rr, rl = stands
        out.append(Phase((fr, fl, rr, rl), (until - at) * period))
    return tuple(out)


class Schedule(NamedTuple):
    """Stacked gaits (G gaits, P phases; padding is never entered).

    Attributes:
      phases: (G,) number of phases of the gait.
      duration: (G, P) duration of the phase, flights at full length [s].
      mode: (G, P) contact mode.
      stance: (G, P, 4) whether the leg stands.
      time_to_touchdown: (G, P, 4) from the phase's start to the leg's next touchdown, 0 in
        stance, flights at full length [s].
      flight_to_touchdown: (G, P, 4, 2) parts of it that are flights of this and of the next cycle,
        whose lengths differ while a ramp lasts [s].
      stance_time: (G, P, 4) length of the leg's current or next stance [s].
      may_leave: (G, P) whether a switch to another gait may happen during the phase.
      leave_when_done: (G,) whether it waits for the phase's end.
      transition_gait: (G,) gait in between, itself for none.
      ramp_start: (G,) fraction of the flights' length in the first cycle [-].
      ramp_cycles: (G,) cycles until it is 1.
    """

    phases: Int[Array, "G"]
    duration: Float[Array, "G P"]
    mode: Int[Array, "G P"]
    stance: Bool[Array, "G P 4"]
    time_to_touchdown: Float[Array, "G P 4"]
    flight_to_touchdown: Float[Array, "G P 4 2"]
    stance_time: Float[Array, "G P 4"]
    may_leave: Bool[Array, "G P"]
    leave_when_done: Bool[Array, "G"]
    transition_gait: Int[Array, "G"]
    ramp_start: Float[Array, "G"]
    ramp_cycles: Int[Array, "G"]


class Clock(NamedTuple):
    """Where in the schedule a robot is.

    Attributes:
      gait: index into the schedule.
      phase: index of the phase.
      cycle: number of completed cycles of this gait.
      elapsed: time since the phase began [s].
    """

    gait: Int[Array, ""]
    phase: Int[Array, ""]
    cycle: Int[Array, ""]
    elapsed: Float[Array, ""]


def build_schedule(gaits: list[Gait]) -> Schedule:
    """Stack gaits into one schedule; works out touchdown and stance times per leg."""
    if not gaits or not all(gait.phases for gait in gaits):
        raise ValueError("gaits must be a non-empty list of gaits with at least one phase each")
    names = [gait.name for gait in gaits]
    for gait in gaits:
        for phase in gait.phases:
            if not phase.duration > 0:
                raise ValueError(f"phase durations must be positive, got {phase.duration} s")
        if (gait.transition_gait or gait.name) not in names:
            raise ValueError(f"transition_gait names no gait here: {gait.transition_gait!r}")
    padded = max(len(gait.phases) for gait in gaits)
    rows = [[(g.phases, min(i, len(g.phases) - 1)) for i in range(padded)] for g in gaits]

    leave = [gait.may_leave() for gait in gaits]
    leave = [[row[min(i, len(row) - 1)] for i in range(padded)] for row in leave]

    def table(value: Callable[[tuple[Phase, ...], int], Any], kind: type = float) -> Any:
        return np.array([[value(*entry) for entry in row] for row in rows], kind)

    columns: dict[str, Any] = {
        "phases": [len(gait.phases) for gait in gaits],
        "duration": table(lambda phases, i: phases[i].duration),
        "mode": table(lambda phases, i: contact_mode(phases[i].stance), int),
        "stance": table(lambda phases, i: phases[i].stance, bool),
        "time_to_touchdown": table(_waits),
        "flight_to_touchdown": table(_flights),
        "stance_time": table(_stance_times),
        "may_leave": leave,
        "leave_when_done": [gait.switch_rule != "anywhere" for gait in gaits],
        "transition_gait": [names.index(gait.transition_gait or gait.name) for gait in gaits],
        "ramp_start": [float(gait.ramp_start) for gait in gaits],
        "ramp_cycles": [gait.ramp_cycles for gait in gaits],
    }
    # Moved in one go, which compiles nothing.
    return Schedule(**jax.device_put({name: np.array(of) for name, of in columns.items()}))


def _steps_to_stance(phases: tuple[Phase, ...], index: int, leg: int) -> int:
    """Number of phases from ``index`` on until the leg stands."""
    n = len(phases)
    for k in range(n):
        if phases[(index + k) % n].stance[leg]:
            return k
    raise ValueError(f"leg {leg} never stands in this gait")


def _waits(phases: tuple[Phase, ...], index: int) -> list[float]:
    """Time to each leg's touchdown from the start of a phase, flights at full length."""
    between = (_phases_to_stance(phases, index, leg) for leg in range(4))
    return [sum((phases[k % len(phases)].duration for k in ahead), 0.0) for ahead in between]


def _flights(phases: tuple[Phase, ...], index: int) -> list[list[float]]:
    """Flight in each leg's time to touchdown: what lies in this cycle and in the next one."""
    parts = []
    for leg in range(4):
        sums = [0.0, 0.0]
        for k in _phases_to_stance(phases, index, leg):
            phase = phases[k % len(phases)]
            if phase.flies:
                sums[k // len(phases)] += phase.duration
        parts.append(sums)
    return parts


def _phases_to_stance(phases: tuple[Phase, ...], index: int, leg: int) -> range:
    """Phases from ``index`` on until the leg stands; indices run past the end of the cycle."""
    return range(index, index + _steps_to_stance(phases, index, leg))


def _stance_times(phases: tuple[Phase, ...], index: int) -> list[float]:
    """Length of each leg's current or next stance, seen from a phase."""
    return [
        _stance_length(phases, leg, index + _steps_to_stance(phases, index, leg))
        for leg in range(4)
    ]


def _stance_length(gait: tuple[Phase, ...], leg: int, index: int) -> float:
    """Length of the unbroken stance of ``leg`` that contains phase ``index`` of the cycle."""
    n = len(gait)
    if all(phase.stance[leg] for phase in gait):
        return sum((phase.duration for phase in gait), 0.0)
    begin = index
    while gait[(begin - 1) % n].stance[leg]:
        begin -= 1
    length = 0.0
    while gait[begin % n].stance[leg]:
        length += gait[begin % n].duration
        begin += 1
    return length


def start(gait: Int[Array, ""], elapsed: Float[Array, ""]) -> Clock:
    """Clock at the beginning of a gait; ``elapsed`` < 0 [s] is the time until then."""
    zero = jnp.zeros_like(gait)
    return Clock(gait=gait, phase=zero, cycle=zero, elapsed=elapsed)


def flight_scale(schedule: Schedule, clock: Clock) -> Float[Array, "*k"]:
    """Fraction of their full length that the flights have in this cycle [-]."""
    begin, cycles = schedule.ramp_start[clock.gait], schedule.ramp_cycles[clock.gait]
    grown = jnp.where(cycles > 0, jnp.minimum(clock.cycle / jnp.maximum(cycles, 1), 1.0), 1.0)
    return begin + (1.0 - begin) * grown.astype(begin.dtype)


def phase_duration(schedule: Schedule, clock: Clock) -> Float[Array, "*k"]:
    """Length of the phase that the clock is in [s]; of several, if the clock's leaves have axes."""
    where = (clock.gait, clock.phase)
    scale = jnp.where(schedule.mode[where] == Mode.FLIGHT, flight_scale(schedule, clock), 1.0)
    return schedule.duration[where] * scale


def time_to_touchdown(schedule: Schedule, clock: Clock) -> Float[Array, "4"]:
    """Time from now to each leg's next touchdown, 0 in stance [s]."""
    where = (clock.gait, clock.phase)
    following = clock._replace(cycle=clock.cycle + 1)
    scale = jnp.stack([flight_scale(schedule, clock), flight_scale(schedule, following)])
    missing = schedule.flight_to_touchdown[where] @ (1.0 - scale)
    wait = schedule.time_to_touchdown[where] - missing
    return jnp.where(schedule.stance[where], 0.0, wait - clock.elapsed)


class Preview(NamedTuple):
    """The phases of one gait cycle from now on: P + 1 slots, unused ones of no duration.

    Slot 0 is what is left of the present phase, the last one in use what has passed of it.

    Attributes:
      phase: (S,) index of the phase.
      cycle: (S,) its cycle.
      begin: (S,) time from now to the slot's start [s].
      duration: (S,) of the slot [s].
      fraction: (S,) of its phase that the slot holds [-].
      passed: (S,) time between the phase's start and the slot's [s].
    """

    phase: Int[Array, "S"]
    cycle: Int[Array, "S"]
    begin: Float[Array, "S"]
    duration: Float[Array, "S"]
    fraction: Float[Array, "S"]
    passed: Float[Array, "S"]


def preview(schedule: Schedule, clock: Clock, shortest: float) -> Preview:
    """Phases of one cycle of the present gait, from now to the same place in the next cycle.

    Args:
      schedule: of all gaits.
      clock: now.
      shortest: least time that is taken to be left of the present phase [s].
    """
    count = schedule.phases[clock.gait]
    slot = jnp.arange(schedule.duration.shape[1] + 1)
    steps = clock.phase + slot
    wraps = steps >= count
    seen = Clock(
        gait=clock.gait,
        phase=jnp.where(wraps, steps - count, steps) % count,
        cycle=clock.cycle + wraps,
        elapsed=jnp.zeros_like(slot, dtype=clock.elapsed.dtype),
    )
    full = phase_duration(schedule, seen)
    left = jnp.clip(full[0] - clock.elapsed, shortest, full[0])
    duration = jnp.select([slot == 0, slot < count, slot == count], [left, full, full - left], 0.0)
    return Preview(
        phase=seen.phase,
        cycle=seen.cycle,
        begin=jnp.cumsum(duration) - duration,
        duration=duration,
        fraction=duration / full,
        passed=jnp.where(slot == 0, full - left, 0.0),
    )


def advance(
    schedule: Schedule, clock: Clock, dt: float, wanted: Int[Array, ""] | None = None
) -> Clock:
    """Clock after ``dt`` [s]; moves on by at most one phase or into another gait.

    A phase ends at the tick nearest to its end, and the remainder is carried over, so that phases
    need not be multiples of the tick and the mean period stays exact.

    Args:
      schedule: of all gaits.
      clock: now.
      dt: tick [s].
      wanted: gait to be in; it is entered as soon as the present gait's rule lets it.
    """
    duration = phase_duration(schedule, clock)
    elapsed = clock.elapsed + dt
    done = elapsed >= duration - 0.5 * dt
    following = clock.phase + 1
    wraps = following >= schedule.phases[clock.gait]
    following = jnp.where(wraps, 0, following)
    onward = Clock(
        gait=clock.gait,
        phase=jnp.where(done, following, clock.phase),
        cycle=jnp.where(done & wraps, clock.cycle + 1, clock.cycle),
        elapsed=jnp.where(done, elapsed - duration, elapsed),
    )
    if wanted is None:
        return onward
    free = schedule.may_leave[onward.gait, onward.phase]
    free = free & (done | ~schedule.leave_when_done[clock.gait])
    through = schedule.transition_gait[clock.gait]
    target = jnp.where(through == clock.gait, wanted, through).astype(clock.gait.dtype)
    entered = start(target, jnp.zeros_like(elapsed))
    # A carried remainder is at least -dt / 2; anything below means that the gait has not begun.
    leaves = free & (wanted != clock.gait) & (clock.elapsed > -0.75 * dt)
    return jax.tree.map(lambda new, old: jnp.where(leaves, new, old), entered, onward)
