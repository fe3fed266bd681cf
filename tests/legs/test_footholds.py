"""Footholds of a trunk that turns, against where a foot must stand."""

import jax.numpy as jnp
import numpy as np
import pytest

from kjax.legs.footholds import Arrival, footholds, turned
from kjax.robots import go1
from kjax.types import RobotParams

ROBOT = RobotParams(*map(jnp.asarray, go1.PARAMS))
COM = jnp.array([-0.005, 0.001, 0.0])
HEIGHT, STANCE = 0.27, 0.2


def placed(velocity, yaw_rate, yaw=0.0, error=(0.0, 0.0)):
    body = Arrival(
        place=jnp.tile(jnp.array([2.0, -1.0]), (4, 1)),
        velocity=jnp.tile(jnp.asarray(velocity), (4, 1)),
        error=jnp.tile(jnp.asarray(error), (4, 1)),
        heading=jnp.tile(jnp.array([np.cos(yaw), np.sin(yaw)]), (4, 1)),
        height=jnp.asarray(HEIGHT),
    )
    return np.asarray(
        footholds(
            ROBOT, jnp.zeros(4), body, COM, jnp.full(4, STANCE), jnp.array([0.03, 0.05]),
            jnp.asarray(yaw_rate),
        )
    )  # fmt: skip


def test_standing_still_the_feet_are_below_the_thighs_whatever_the_heading():
    feet = placed([0.0, 0.0], 0.0, yaw=0.7) - [2.0, -1.0]
    thigh = go1.PARAMS.hip_pos[:, :2] - np.asarray(COM)[:2]
    thigh = thigh + np.stack([np.zeros(4), go1.PARAMS.abduction_offset], axis=-1)
    for foot, wanted in zip(feet, thigh, strict=True):
        np.testing.assert_allclose(foot, np.asarray(turned(jnp.asarray(0.7), jnp.asarray(wanted))))


@pytest.mark.parametrize(
    ("velocity", "yaw_rate"), [([0.8, 0.0], 1.5), ([0.3, -0.4], -1.0), ([0.5, 0.2], 0.0)]
)
def test_a_diagonal_pair_bears_the_pull_of_the_curve_without_a_moment(velocity, yaw_rate):
    """In the middle of the stance weight and centrifugal force meet the ground between the feet."""
    feet = placed(velocity, yaw_rate)
    inwards = yaw_rate * np.array([-velocity[1], velocity[0]])
    middle = np.array([2.0, -1.0]) + 0.5 * STANCE * np.array(velocity)
    pressed = middle - HEIGHT / 9.81 * inwards
    for pair in ((0, 3), (1, 2)):
        spread = feet[pair[1]] - feet[pair[0]]
        off = feet[pair[0]] - pressed
        # Its distance from the line between them; COM and hips leave 5 mm.
        distance = (spread[0] * off[1] - spread[1] * off[0]) / np.linalg.norm(spread)
        assert abs(distance) < 0.006


def test_a_velocity_s_error_moves_the_feet_by_its_gains_in_the_heading():
    yaw = 0.4
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-np.sin(yaw), np.cos(yaw)])
    shift = placed([0.0, 0.0], 0.0, yaw, error=0.2 * ahead - 0.1 * left)
    shift = shift - placed([0.0, 0.0], 0.0, yaw)
    wanted = 0.03 * 0.2 * ahead - 0.05 * 0.1 * left
    np.testing.assert_allclose(shift, np.tile(wanted, (4, 1)), atol=1e-7)
