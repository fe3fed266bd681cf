"""Gaits: schedules as data, and the phase clock."""

from kjax.gait.schedule import Clock, Phase, Schedule, advance, build_schedule, stand, start, trot

__all__ = ["Clock", "Phase", "Schedule", "advance", "build_schedule", "stand", "start", "trot"]
