"""Samples of a Go1 on a free base, and what a controller answers to them; for tests."""

import jax.numpy as jnp
import mujoco
import numpy as np

from kjax import Observation, qp
from kjax.legs.posture import stand_pose
from kjax.robots import go1


def disturbed(seed, *, planar=False, scale=1.0, dtype=float):
    """The standing robot, moving and tilted a little; in the sagittal plane only if ``planar``."""
    rng = np.random.default_rng(seed)
    height, joints = stand_pose(go1.PARAMS, 0.27)
    keep = np.array([0.0, 1.0, 0.0]) if planar else np.ones(3)
    slide = np.array([1.0, 0.0, 1.0]) if planar else np.ones(3)
    quat, turns = np.zeros(4), 0.1 * scale * rng.normal(size=3) * keep
    mujoco.mju_euler2Quat(quat, turns[::-1].copy(), "zyx")
    loose = np.array([0.0, 1.0, 1.0]) if planar else np.ones(3)
    values = {
        "base_pos": np.array([0.0, 0.0, height]) + 0.02 * scale * rng.normal(size=3) * slide,
        "base_quat": quat,
        "base_vel": 0.1 * scale * rng.normal(size=3) * slide,
        "base_ang_vel": 0.5 * scale * rng.normal(size=3) * keep,
        "joint_pos": joints + 0.05 * scale * rng.normal(size=(4, 3)) * loose,
        "joint_vel": 0.3 * scale * rng.normal(size=(4, 3)) * loose,
    }
    arrays = {name: jnp.asarray(value, dtype) for name, value in values.items()}
    return Observation(**arrays, contact=jnp.asarray([True, False, False, True]))


def seen_from(observation, yaw, shift):
    """The same robot somewhere else, looking elsewhere."""
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    quat = np.zeros(4)
    half = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    mujoco.mju_mulQuat(quat, half, np.asarray(observation.base_quat, float))
    return observation._replace(
        base_pos=jnp.asarray(rotation @ observation.base_pos + np.array([*shift, 0.0])),
        base_quat=jnp.asarray(quat),
        base_vel=jnp.asarray(rotation @ observation.base_vel),
    )


def torques(controller, tables, observations, ticks=3):
    """Torques of a short history: one plan and one act for each observation."""
    state = controller.init(tables, observations[0])
    out = []
    for observation in observations[:ticks]:
        state, info = controller.plan(tables, state, observation)
        assert int(info.status) == qp.Status.SOLVED
        state, joints = controller.act(tables, state, observation)
        out.append(np.asarray(joints.torque))
    return np.stack(out), state
