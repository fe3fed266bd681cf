"""The free base in numpy: its place in qpos, its attitude, and metrics that a plane does not have.

qpos of the free base: position (3,) [m], quaternion (w, x, y, z), joints (12,) [rad]; qvel:
velocity in the world (3,) [m/s], angular velocity in the body (3,) [rad/s], joint rates.
qpos of the planar base: x, z [m], MuJoCo's angle about +y [rad], joints.
"""

from typing import Any

import numpy as np

from kjax.robots import go1

_FREE_NQ = 19


def is_free(qpos: np.ndarray) -> bool:
    """Whether qpos (..., nq) is that of a free base."""
    return qpos.shape[-1] == _FREE_NQ


def from_planar(qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Qpos (19,) and qvel (18,) of the free robot in the state of a planar one."""
    half = 0.5 * qpos[2]
    pose = [qpos[0], 0.0, qpos[1], np.cos(half), 0.0, np.sin(half), 0.0]
    return np.r_[pose, qpos[3:]], np.r_[qvel[0], 0.0, qvel[1], 0.0, qvel[2], 0.0, qvel[3:]]


def turn(qpos: np.ndarray, qvel: np.ndarray, yaw: float) -> None:
    """Turn a free robot about the world's vertical through the origin, in place.

    Args:
      qpos: (19,) positions.
      qvel: (18,) velocities; the angular one is in the body and stays.
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
    R = _rotation(qpos[..., 3:7])
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    return roll, pitch, np.arctan2(R[..., 1, 0], R[..., 0, 0])


def joints(qpos: np.ndarray) -> np.ndarray:
    """Joint angles (..., 4, 3) [rad] of either base."""
    return qpos[..., -12:].reshape(*qpos.shape[:-1], 4, 3)


def metrics(qpos: np.ndarray, steady: np.ndarray) -> dict[str, float]:
    """Largest roll and yaw, and how far the trunk strays from its first heading's line.

    Args:
      qpos: (N, nq) of an episode; a planar one gives nothing.
      steady: (N,) samples that count.
    """
    if not is_free(qpos):
        return {}
    roll, _, yaw = attitude(qpos)
    turned = np.angle(np.exp(1j * (yaw - yaw[0])))
    way = qpos[:, :2] - qpos[0, :2]
    drift = np.cos(yaw[0]) * way[:, 1] - np.sin(yaw[0]) * way[:, 0]
    return {
        "roll_max_deg": float(np.degrees(np.abs(roll[steady])).max()),
        "yaw_max_deg": float(np.degrees(np.abs(turned[steady])).max()),
        "lateral_drift_m": float(np.abs(drift[steady]).max()),
    }


def sliding_speed(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Horizontal speed (N, 4) of the material point at the bottom of each foot [m/s].

    Args:
      qpos: (N, 19) of a free base.
      qvel: (N, 18).
    """
    R, q, rate = _rotation(qpos[:, 3:7]), joints(qpos), qvel[:, 6:].reshape(-1, 4, 3)
    side = np.asarray(go1.PARAMS.abduction_offset)
    # Joint by joint down the leg: axis and place in the trunk's axes, then v += rate axis x lever.
    s0, c0 = np.sin(q[..., 0]), np.cos(q[..., 0])
    zero, one = np.zeros_like(s0), np.ones_like(s0)
    roll_axis = np.stack([one, zero, zero], axis=-1)
    pitch_axis = np.stack([zero, c0, s0], axis=-1)
    down = np.stack([zero, s0, -c0], axis=-1)  # of the leg's plane

    def link(angle: np.ndarray, length: float) -> np.ndarray:
        along = -np.sin(angle)[..., None] * roll_axis + np.cos(angle)[..., None] * down
        return length * along

    thigh = side[:, None] * pitch_axis
    knee = thigh + link(q[..., 1], go1.THIGH_LENGTH)
    foot = knee + link(q[..., 1] + q[..., 2], go1.CALF_LENGTH)
    # The bottom of the sphere: straight down in the world.
    bottom = foot - go1.FOOT_RADIUS * R[:, None, 2, :]
    hips = np.asarray(go1.PARAMS.hip_pos)
    velocity = np.cross(qvel[:, None, 3:6], hips + bottom)
    for axis, origin, joint in (
        (roll_axis, zero[..., None], 0),
        (pitch_axis, thigh, 1),
        (pitch_axis, knee, 2),
    ):
        velocity += rate[..., joint, None] * np.cross(axis, bottom - origin)
    world = qvel[:, None, :3] + np.einsum("nij,nlj->nli", R, velocity)
    return np.hypot(world[..., 0], world[..., 1])


def _rotation(quat: np.ndarray) -> np.ndarray:
    """R_world_body (..., 3, 3) of quaternions (..., 4) as (w, x, y, z)."""
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
