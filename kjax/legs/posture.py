"""The nominal stance: feet below the hips, the centre of mass at a height."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.legs import kinematics
from kjax.types import Observation, RobotParams


def standing(joint_pos: Float[Array | np.ndarray, "4 3"] | None = None) -> Observation:
    """What is measured of a robot that stands still and level on all feet.

    Args:
      joint_pos: (4, 3) of its joints; a common crouch where not given [rad].
    """
    if joint_pos is None:
        joint_pos = np.tile([0.0, 0.9, -1.8], (4, 1))
    fields: dict[str, Any] = {
        "base_pos": np.zeros(3),
        "base_quat": np.array([1.0, 0.0, 0.0, 0.0]),
        "base_vel": np.zeros(3),
        "base_ang_vel": np.zeros(3),
        "joint_pos": joint_pos,
        "joint_vel": np.zeros((4, 3)),
        "contact": np.ones(4, bool),
    }
    return Observation(**jax.device_put(fields))  # compiles nothing, unlike jnp.zeros


def stand_pose(robot: RobotParams, com_height: float) -> tuple[float, np.ndarray]:
    """Trunk height [m] and joint angles (4, 3) [rad] that stand with feet below the hips.

    Args:
      robot: geometry and masses.
      com_height: height of the whole-body centre of mass above flat ground [m].

    Raises:
      ValueError: if the legs are too short or too long for that height.
    """
    with jax.enable_x64(True):
        com, joints = (np.asarray(a, float) for a in _stance(robot, float(com_height)))
    trunk_height = float(com_height - com[1])
    l1, l2 = float(robot.thigh_length), float(robot.calf_length)
    drops = trunk_height + np.asarray(robot.hip_pos)[:, 2] - float(robot.foot_radius)
    # Law of cosines at the ends of the knee's range.
    low, high = np.sqrt(l1**2 + l2**2 + 2 * l1 * l2 * np.cos(np.asarray(robot.joint_range)[2]))
    if not ((drops > low) & (drops < high)).all():
        with jax.enable_x64(True):
            least, most = sorted(float(_height(robot, drop)) for drop in (low, high))
        raise ValueError(f"com_height must be about {least:.2f} to {most:.2f} m, got {com_height}")
    return trunk_height, joints


def nominal_feet(
    robot: RobotParams, height: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Soles (x, z) of the front and rear feet from the centre of mass, standing below the hips [m].

    Args:
      robot: geometry and masses.
      height: of the centre of mass above the ground [m].
    """
    with jax.enable_x64(True):
        com, _ = _stance(robot, height)
        along = np.asarray(robot.hip_pos)[:, 0] - float(com[0])
    return (float(along[:2].mean()), -height), (float(along[2:].mean()), -height)


@jax.jit
def _stance(robot: RobotParams, height: Float[Array, ""] | float) -> tuple[Array, Array]:
    """Centre of mass (2,) in the trunk frame, standing, and joint angles (4, 3)."""

    def joints(com: Array) -> Array:
        return _posture(robot, height - robot.foot_radius - com[1] + robot.hip_pos[:, 2])

    def again(_: Any, com: Array) -> Array:
        return kinematics.planar_state(robot, standing(joints(com))).x[:2]

    # The legs' share of the centre of mass moves little with the posture: this contracts fast.
    com = jax.lax.fori_loop(0, 20, again, jnp.zeros(2))
    return com, joints(com)


@jax.jit
def _height(robot: RobotParams, drop: Float[Array, ""] | float) -> Array:
    """Height of the centre of mass above the ground, soles a foot's radius below ``drop``."""
    seen = standing(_posture(robot, jnp.full(4, drop)))
    com = kinematics.planar_state(robot, seen).x[1]
    return com + drop + robot.foot_radius - robot.hip_pos[:, 2].mean()


def _posture(robot: RobotParams, drop: Float[Array, "4"]) -> Array:
    """Joint angles (4, 3) with the feet's centres that far below the hips."""
    foot = jnp.stack([jnp.zeros(4), -drop], axis=-1)
    thigh, calf, _trig = kinematics.inverse(robot, foot)
    return jnp.stack([jnp.zeros(4), thigh, calf], axis=-1)
