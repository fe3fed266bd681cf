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

_GONE = ("trot", "bound", "stand")


def __getattr__(name: str) -> object:
    if name in _GONE:
        raise ImportError(
            f"kjax.gait.{name} has gone: gaits are data, kjax.config.gaits.LIBRARY['{name}']; "
            "their phases are gait.phases(period, offset, duty)"
        )
    raise AttributeError(f"module 'kjax.gait' has no attribute '{name}'")
