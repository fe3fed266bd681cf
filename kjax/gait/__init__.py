"""Gaits: schedules as data, the phase clock, the switch between gaits, periodic references."""

from kjax.gait.schedule import (
    Clock,
    Gait,
    Phase,
    Preview,
    Schedule,
    advance,
    build_schedule,
    flight_scale,
    phase_duration,
    phases,
    preview,
    start,
    time_to_touchdown,
)
from kjax.moved import moved_names

__all__ = [
    "Clock",
    "Gait",
    "Phase",
    "Preview",
    "Schedule",
    "advance",
    "build_schedule",
    "flight_scale",
    "phase_duration",
    "phases",
    "preview",
    "start",
    "time_to_touchdown",
]

__getattr__ = moved_names(__name__)
