"""From a path and where the robot is to a command: feedback of the place, outside the controller.

The controller follows velocities and knows no place in the world, since a robot's odometry drifts.
Whoever has a place that does not (a map, motion capture, a simulator) closes this loop around it,
ten to a hundred times a second.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class PathPoint(NamedTuple):
    """A point of a path, world.

    Attributes:
      place: (2,) [m].
      heading: of the path there [rad].
      curvature: of the path there, to the left positive [1/m].
    """

    place: Float[np.ndarray, "2"]
    heading: float
    curvature: float


def nearest_on_circle(
    place: Float[np.ndarray, "2"], centre: Float[np.ndarray, "2"], radius: float
) -> PathPoint:
    """The nearest point of a circle, walked to the left.

    Args:
      place: of the robot, world [m].
      centre: of the circle, world [m].
      radius: of it [m].
    """
    out = np.asarray(place, float) - centre
    angle = np.arctan2(out[1], out[0])
    point = centre + radius * np.array([np.cos(angle), np.sin(angle)])
    return PathPoint(point, float(angle + np.pi / 2), 1.0 / radius)


def follow_path(
    point: PathPoint,
    speed: float,
    place: Float[np.ndarray, "2"],
    yaw: float,
    *,
    gains: tuple[float, float] = (1.5, 2.0),
) -> dict[str, float]:
    """Command that leads along a path and back to it.

    Args:
      point: of the path, where the robot should be now.
      speed: along the path [m/s].
      place: of the robot's centre of mass, world [m].
      yaw: of the robot [rad].
      gains: velocity per distance, and yaw rate per angle [1/s].

    Returns:
      ``v_x``, ``v_y`` [m/s] and ``yaw_rate`` [rad/s], for ``ControlLoop.command``.
    """
    along = speed * np.array([np.cos(point.heading), np.sin(point.heading)])
    v = along + gains[0] * (point.place - np.asarray(place, float))
    c, s = np.cos(yaw), np.sin(yaw)
    heading_error = np.arctan2(np.sin(point.heading - yaw), np.cos(point.heading - yaw))
    return {
        "v_x": float(c * v[0] + s * v[1]),
        "v_y": float(-s * v[0] + c * v[1]),
        "yaw_rate": float(speed * point.curvature + gains[1] * heading_error),
    }
