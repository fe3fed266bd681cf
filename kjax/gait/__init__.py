"""Gaits: schedules as data, the phase clock, the switch between gaits, periodic references."""

from kjax.gait.schedule import (
    Clock,
    Gait,
    Phase,
    Preview,
    Schedule,
    advance,
    bound,
    build_schedule,
    flight_scale,
    phase_duration,
    preview,
    stand,
    start,
    time_to_touchdown,
    trot,
)

__all__ = [
    "Clock",
    "Gait",
    "Phase",
    "Preview",
    "Schedule",
    "advance",
    "bound",
    "build_schedule",
    "flight_scale",
    "phase_duration",
    "preview",
    "stand",
    "start",
    "time_to_touchdown",
    "trot",
]
