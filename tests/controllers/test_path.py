"""Following a path from outside: the command leads along it and back to it."""

import numpy as np
import pytest

from kjax.controllers.path import PathPoint, follow_path, nearest_on_circle


def walk(place, yaw, speed, seconds, dt=0.02):
    """A point that does what it is told, around a circle of 1 m about (0, 1)."""
    place, ways = np.array(place, float), []
    for _ in range(round(seconds / dt)):
        point = nearest_on_circle(place, np.array([0.0, 1.0]), 1.0)
        told = follow_path(point, speed, place, yaw)
        c, s = np.cos(yaw), np.sin(yaw)
        place = place + dt * np.array(
            [c * told["v_x"] - s * told["v_y"], s * told["v_x"] + c * told["v_y"]]
        )
        yaw += dt * told["yaw_rate"]
        ways.append((*place, yaw))
    return np.array(ways)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (0.3, -0.2, 1.0), (0.0, 0.4, -2.0)])
def test_it_comes_to_the_circle_and_goes_round_it(start):
    ways = walk(start[:2], start[2], 0.5, 16.0)
    late = ways[-300:]  # 6 s
    away = np.hypot(late[:, 0], late[:, 1] - 1.0) - 1.0
    np.testing.assert_allclose(away, 0.0, atol=5e-3)
    np.testing.assert_allclose((late[-1, 2] - late[0, 2]) / (299 * 0.02), 0.5, rtol=0.02)


def test_on_the_path_the_command_is_the_paths_own():
    on_it = PathPoint(np.array([2.0, -1.0]), 0.7, 0.4)
    told = follow_path(on_it, 0.6, on_it.place, 0.7)
    assert told == pytest.approx({"v_x": 0.6, "v_y": 0.0, "yaw_rate": 0.24})


def test_a_heading_a_turn_away_is_the_same_one():
    point = PathPoint(np.zeros(2), 3.1, 0.0)
    told = follow_path(point, 0.0, np.zeros(2), -3.1)
    assert told["yaw_rate"] == pytest.approx(2.0 * (6.2 - 2 * np.pi))
