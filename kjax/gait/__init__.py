"""Gaits: schedules as data, the phase clock, the switch between gaits, periodic references."""

from kjax.gait.schedule import (
    Clock,
    Gait,
    Phase,
    Schedule,
    advance,
    bound,
    build_schedule,
    flight_scale,
    phase_duration,
    stand,
    start,
    time_to_touchdown,
    trot,
)

__all__ = [
    "Clock",
    "Gait",
    "Phase",
    "Schedule",
    "advance",
    "bound",
    "build_schedule",
    "flight_scale",
    "phase_duration",
    "stand",
    "start",
    "time_to_touchdown",
    "trot",
]
