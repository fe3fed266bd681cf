"""Gaits as arrays, and the phase clock that walks through them.

A gait is a cycle of phases; each phase says which legs stand, in which contact mode, for how long.
Gaits are stacked on a leading axis and padded to one number of phases, so that picking or
switching a gait is an index and never recompiles.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax.types import Mode


class Phase(NamedTuple):
    """One phase of a gait: stance flags in leg order (FR, FL, RR, RL), mode, duration [s]."""

    stance: tuple[bool, bool, bool, bool]
    mode: Mode
    duration: float


class Schedule(NamedTuple):
    """Stacked gaits (G gaits, P phases, padding repeats phase 0 and is never entered).

    Attributes:
      phases: (G,) number of phases of the gait.
      duration: (G, P) duration of the phase [s].
      mode: (G, P) contact mode.
      stance: (G, P, 4) whether the leg stands.
      time_to_touchdown: (G, P, 4) from the phase's start to the leg's next touchdown, 0 in
        stance [s].
      stance_time: (G, P, 4) length of the leg's current or next stance [s].
    """

    phases: Int[Array, "G"]
    duration: Float[Array, "G P"]
    mode: Int[Array, "G P"]
    stance: Bool[Array, "G P 4"]
    time_to_touchdown: Float[Array, "G P 4"]
    stance_time: Float[Array, "G P 4"]


class Clock(NamedTuple):
    """Where in the schedule a robot is.

    Attributes:
      gait: index into the schedule.
      phase: index of the phase.
      elapsed: time since the phase began [s].
    """

    gait: Int[Array, ""]
    phase: Int[Array, ""]
    elapsed: Float[Array, ""]


def trot(stance_time: float) -> list[Phase]:
    """Diagonal pairs FR-RL and FL-RR in turn, ``stance_time`` [s] each."""
    return [
        Phase((True, False, False, True), Mode.TROT, stance_time),
        Phase((False, True, True, False), Mode.TROT, stance_time),
    ]


def stand() -> list[Phase]:
    """All four feet down."""
    return [Phase((True, True, True, True), Mode.STAND, 1.0)]


def build_schedule(gaits: list[list[Phase]]) -> Schedule:
    """Stack gaits into one schedule; works out touchdown and stance times per leg."""
    if not gaits or not all(gaits):
        raise ValueError("gaits must be a non-empty list of non-empty lists of phases")
    for phase in (p for gait in gaits for p in gait):
        if not phase.duration > 0:
            raise ValueError(f"phase durations must be positive, got {phase.duration} s")
    padded = max(len(gait) for gait in gaits)
    rows = [[_timing(gait, min(i, len(gait) - 1)) for i in range(padded)] for gait in gaits]
    phases = [[gait[min(i, len(gait) - 1)] for i in range(padded)] for gait in gaits]
    return Schedule(
        phases=jnp.asarray([len(gait) for gait in gaits]),
        duration=jnp.asarray([[p.duration for p in row] for row in phases], float),
        mode=jnp.asarray([[int(p.mode) for p in row] for row in phases]),
        stance=jnp.asarray([[p.stance for p in row] for row in phases]),
        time_to_touchdown=jnp.asarray(np.array([[t[0] for t in row] for row in rows], float)),
        stance_time=jnp.asarray(np.array([[t[1] for t in row] for row in rows], float)),
    )


def _timing(gait: list[Phase], index: int) -> tuple[list[float], list[float]]:
    """Time to touchdown and length of the current or next stance of each leg, at a phase start."""
    wait, stance = [], []
    for leg in range(4):
        ahead = [gait[(index + k) % len(gait)] for k in range(len(gait))]
        first = next((k for k, phase in enumerate(ahead) if phase.stance[leg]), None)
        if first is None:
            raise ValueError(f"leg {leg} never stands in this gait")
        wait.append(sum((phase.duration for phase in ahead[:first]), 0.0))
        stance.append(_stance_length(gait, leg, index + first))
    return wait, stance


def _stance_length(gait: list[Phase], leg: int, index: int) -> float:
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


def start(gait: int | Array, control_dt: float) -> Clock:
    """Clock whose first ``advance`` by ``control_dt`` enters phase 0 of a gait."""
    return Clock(
        gait=jnp.asarray(gait, jnp.int32),
        phase=jnp.zeros((), jnp.int32),
        elapsed=jnp.asarray(-control_dt, float),
    )


def advance(schedule: Schedule, clock: Clock, dt: float) -> Clock:
    """Clock after ``dt`` [s]; moves on by at most one phase.

    A phase ends at the tick nearest to its end, and the remainder is carried over, so that phases
    need not be multiples of the tick and the mean period stays exact.
    """
    duration = schedule.duration[clock.gait, clock.phase]
    elapsed = clock.elapsed + dt
    done = elapsed >= duration - 0.5 * dt
    following = clock.phase + 1
    following = jnp.where(following >= schedule.phases[clock.gait], 0, following)
    return Clock(
        gait=clock.gait,
        phase=jnp.where(done, following, clock.phase).astype(clock.phase.dtype),
        elapsed=jnp.where(done, elapsed - duration, elapsed),
    )
