"""Numbers over many episodes: median and worst, and the floor that physics sets to tracking."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from kjax.sim.metrics import SETTLE_TIME
from kjax.types import Command

# Where a small value is the bad one; of all others the largest magnitude is the worst.
LOWER_IS_WORSE = {"realtime_factor", "height_min_m", "distance_m", "velocity_late_mean_mps"}


def summarise(results: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Median, worst and number of each metric, over the episodes that did not fall.

    Args:
      results: from ``episode.metrics``.

    Returns:
      ``runs``, ``falls``, ``crossed`` where there is a field to cross, and for every numeric
      metric ``{"median", "worst", "n"}``.
    """
    results = list(results)
    upright = [result for result in results if not result["fell"]]
    out: dict[str, Any] = {"runs": len(results), "falls": len(results) - len(upright)}
    if any("crossed" in result for result in results):
        out["crossed"] = sum(result.get("crossed", False) for result in results)
    for key in dict.fromkeys(key for result in upright for key in result):
        values = [result[key] for result in upright if result.get(key) is not None]
        if not values or isinstance(values[0], bool):
            continue
        worst = min(values) if key in LOWER_IS_WORSE else max(values, key=abs)
        out[key] = {"median": float(np.median(values)), "worst": worst, "n": len(values)}
    return out


def tracking_floor(
    command: Command, acceleration: float, *, end: float, start: float = SETTLE_TIME
) -> float:
    """Velocity RMSE that remains if the robot answers every step at a constant acceleration [m/s].

    A step of dv costs dv^3 / (3 a) of integrated square error; less where the next step or the end
    of the window comes first.

    Args:
      command: steps of the velocity.
      acceleration: that the robot can muster [m/s^2].
      end: of the measured window [s].
      start: of the measured window [s].
    """
    times = [*np.asarray(command.times), end]
    wanted_speed = np.asarray(command.values)[:, 0]
    velocity = wanted_speed[0]  # the window begins after the first piece has
    total = 0.0
    for wanted, begin, until in zip(wanted_speed, times[:-1], times[1:], strict=True):
        error = wanted - velocity
        low, high = (_left(abs(error), acceleration, t - begin) for t in (max(begin, start), until))
        if min(until, end) > max(begin, start):
            total += (low**3 - high**3) / (3.0 * acceleration)
        left = _left(abs(error), acceleration, until - begin)
        velocity = wanted - np.sign(error) * left
        if until >= end:
            break
    return float(np.sqrt(total / (end - start)))


def _left(error: float, acceleration: float, time: float) -> float:
    """What is left of an error after some time at full acceleration."""
    return max(error - acceleration * time, 0.0)
