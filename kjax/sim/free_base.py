"""The free base in numpy: its place in qpos, its attitude, and metrics that a plane does not have.

qpos of the free base: position (3,) [m], quaternion (w, x, y, z), joints (12,) [rad]; qvel:
velocity in the world (3,) [m/s], angular velocity in the body (3,) [rad/s], joint rates.
qpos of the planar base: x, z [m], MuJoCo's angle about +y [rad], joints.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.spatial.transform import Rotation

from kjax.legs import spatial
from kjax.legs.kinematics import leg_trig
from kjax.types import RobotParams

_FREE_NQ = 19


def is_free(qpos: np.ndarray) -> bool:
    """Whether qpos (..., nq) is that of a free base."""
    return qpos.shape[-1] == _FREE_NQ


def from_planar(pose: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose (7,) and velocity (6,) of a free trunk in the state of a planar one, (3,) each."""
    half = 0.5 * pose[2]
    free = np.array([pose[0], 0.0, pose[1], np.cos(half), 0.0, np.sin(half), 0.0])
    return free, np.array([rates[0], 0.0, rates[1], 0.0, rates[2], 0.0])


def turn(qpos: np.ndarray, qvel: np.ndarray, yaw: float) -> None:
    """Turn a free trunk about the world's vertical through the origin, in place.

    Args:
      qpos: (7,) pose.
      qvel: (6,) velocities; the angular one is in the body and stays.
      yaw: to the left [rad].
    """
    c, s = np.cos(yaw), np.sin(yaw)
    for vector in (qpos[:2], qvel[:2]):
        vector[:] = c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]
    half_c, half_s = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, z = qpos[3:7]
    qpos[3:7] = (
        half_c * w - half_s * z,
        half_c * x - half_s * y,
        half_c * y + half_s * x,
        half_c * z + half_s * w,
    )


def attitude(qpos: np.ndarray) -> tuple[Any, Any, Any]:
    """Roll, pitch (nose up positive) and yaw of the trunk, each (...) [rad], for either base."""
    if not is_free(qpos):
        zero = np.zeros(qpos.shape[:-1])
        return zero, -qpos[..., 2], zero
    w, x, y, z = np.moveaxis(qpos[..., 3:7], -1, 0)
    R = Rotation.from_quat(np.stack([x, y, z, w], axis=-1).reshape(-1, 4)).as_matrix()
    R = R.reshape(*qpos.shape[:-1], 3, 3)
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    return roll, pitch, np.arctan2(R[..., 1, 0], R[..., 0, 0])


def angular_velocity(qpos: np.ndarray, qvel: np.ndarray) -> Any:
    """Angular velocity (N, 3) of a free trunk, world [rad/s]."""
    return Rotation.from_quat(qpos[:, [4, 5, 6, 3]]).apply(qvel[:, 3:6])


def metrics(
    qpos: np.ndarray, qvel: np.ndarray, wanted: np.ndarray, steady: np.ndarray
) -> dict[str, float]:
    """Roll and yaw, sideways and turning motion against the command, and the drift from a line.

    The line is that of the first heading; the velocity is the trunk's, in its own heading.

    Args:
      qpos: (N, nq) of an episode; a planar one gives nothing.
      qvel: (N, nv) its velocities.
      wanted: (N, 2) v_y [m/s] and yaw rate [rad/s] in force.
      steady: (N,) samples that count.
    """
    if not is_free(qpos):
        return {}
    roll, _, yaw = attitude(qpos)
    tilt = np.degrees(np.abs(roll[steady]))
    turned = np.angle(np.exp(1j * (yaw - yaw[0])))
    way = qpos[:, :2] - qpos[0, :2]
    drift = np.cos(yaw[0]) * way[:, 1] - np.sin(yaw[0]) * way[:, 0]
    v_y = np.cos(yaw) * qvel[:, 1] - np.sin(yaw) * qvel[:, 0]
    rate = angular_velocity(qpos, qvel)[:, 2]  # about the vertical
    missed = np.stack([v_y, rate], axis=-1)[steady] - wanted[steady]
    rmse = np.sqrt(np.mean(missed**2, axis=0))
    return {
        "roll_max_deg": float(tilt.max()),
        "roll_p95_deg": float(np.percentile(tilt, 95)),
        "yaw_max_deg": float(np.degrees(np.abs(turned[steady])).max()),
        "velocity_y_rmse_mps": float(rmse[0]),
        "yaw_rate_rmse_radps": float(rmse[1]),
        "lateral_drift_m": float(np.abs(drift[steady]).max()),
    }


def path_errors(qpos: np.ndarray, reference: np.ndarray, dt: float) -> dict[str, float]:
    """Largest distance of the trunk from where, and turn from how, its references would take it.

    Args:
      qpos: (N, nq) of an episode from its start; a planar one gives nothing.
      reference: (N, 3) v_x, v_y [m/s] and yaw rate [rad/s].
      dt: time between two samples [s].
    """
    if not is_free(qpos):
        return {}
    yaw = np.unwrap(attitude(qpos)[2])
    heading = yaw[0] + dt * np.append(0.0, np.cumsum(reference[:-1, 2]))
    c, s = np.cos(heading), np.sin(heading)
    v_x, v_y = reference[:, 0], reference[:, 1]
    step = dt * np.stack([c * v_x - s * v_y, s * v_x + c * v_y], axis=-1)
    place = qpos[0, :2] + np.cumsum(np.concatenate([np.zeros((1, 2)), step[:-1]]), axis=0)
    return {
        "path_error_max_m": float(np.linalg.norm(qpos[:, :2] - place, axis=1).max()),
        "heading_error_max_deg": float(np.degrees(np.abs(yaw - heading)).max()),
    }


def sliding_speed(
    robot: RobotParams,
    quat: np.ndarray,
    velocity: np.ndarray,
    joints: np.ndarray,
    rates: np.ndarray,
) -> np.ndarray:
    """Horizontal speed (N, 4) of the material point at the bottom of each foot [m/s].

    Args:
      robot: geometry.
      quat: (N, 4) attitude of the trunk, (w, x, y, z).
      velocity: (N, 6) of the trunk: along the world's axes [m/s], about its own [rad/s].
      joints: (N, 4, 3) angles [rad].
      rates: (N, 4, 3) their rates [rad/s].
    """
    with jax.enable_x64(True):
        return np.asarray(_sole_speeds(robot, quat, velocity, joints, rates))


def sole_speed(
    robot: RobotParams, quat: Array, velocity: Array, joints: Array, rates: Array
) -> Array:
    """The same (4,) of one state, in JAX."""
    hip, trig = spatial.hip_trig(joints), leg_trig(joints)
    R_world_body, omega = spatial.rotation_matrix(quat), velocity[3:]
    foot = robot.hip_pos + spatial.foot_position(robot, hip, trig)
    J = spatial.foot_jacobian(robot, hip, trig)
    foot_vel = jnp.cross(omega, foot) + jnp.einsum("lij,lj->li", J, rates)
    # The calf turns with the trunk, about the abduction axis, and twice about the leg's own.
    zero, one = jnp.zeros(4), jnp.ones(4)
    roll_axis = jnp.stack([one, zero, zero], axis=-1)
    pitch_axis = jnp.stack([zero, hip.c0, hip.s0], axis=-1)
    bend = rates[:, 1] + rates[:, 2]
    omega_calf = omega + rates[:, :1] * roll_axis + bend[:, None] * pitch_axis
    bottom = -robot.foot_radius * R_world_body[2]  # straight down in the world
    world = velocity[:3] + (foot_vel + jnp.cross(omega_calf, bottom)) @ R_world_body.T
    return jnp.hypot(world[:, 0], world[:, 1])


_sole_speeds = jax.jit(jax.vmap(sole_speed, in_axes=(None, 0, 0, 0, 0)))
