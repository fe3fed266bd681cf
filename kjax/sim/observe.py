"""From an engine's arrays to an ``Observation``: the only place with addresses and signs.

It reads ``qpos``, ``qvel`` and ``sensordata`` only, so the same function serves ``MjData`` and
``mjx.Data``, one robot or, under ``vmap``, many.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from kjax.config import NoiseConfig
from kjax.robots import Robot
from kjax.types import Observation

Observe = Callable[[Array, Array, Array], Observation]


class Addresses(NamedTuple):
    """Where the model keeps what the controller needs, resolved by name, and how it counts.

    Attributes:
      qpos: (4, 3) position address of each joint, leg order.
      qvel: (4, 3) velocity address.
      actuator: (4, 3) actuator index.
      foot_force: (4,) address of each foot's touch sensor.
      feet: (4,) geom of each foot.
      trunk: body of the trunk.
      sign: (4, 3) 1 or -1: our angle is sign times (the model's - zero), our torque sign times its.
      zero: (4, 3) the model's angle where ours is 0 [rad].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    actuator: np.ndarray
    foot_force: np.ndarray
    feet: np.ndarray
    trunk: int
    sign: np.ndarray
    zero: np.ndarray

    def joint_pos(self, qpos: Any) -> Any:
        """Our joint angles (..., 4, 3) of positions (..., nq) [rad]."""
        return self.sign * (qpos[..., self.qpos] - self.zero)

    def joint_vel(self, qvel: Any) -> Any:
        """Our joint rates (..., 4, 3) of velocities (..., nv) [rad/s]."""
        return self.sign * qvel[..., self.qvel]

    def set_joints(self, qpos: np.ndarray, joint_pos: np.ndarray) -> None:
        """Write our joint angles (4, 3) [rad] into positions (nq,)."""
        qpos[self.qpos] = self.zero + self.sign * joint_pos


def find_addresses(robot: Robot, model: mujoco.MjModel) -> Addresses:
    """Addresses of a robot's trunk, joints, actuators, feet and sensors by name.

    Raises:
      ValueError: naming the body, joint, actuator, geom or sensor that the model lacks.
    """

    def find(kind: mujoco.mjtObj, name: str) -> int:
        index = mujoco.mj_name2id(model, kind, name)
        if index < 0:
            raise ValueError(f"the model has no {kind.name.removeprefix('mjOBJ_')} named '{name}'")
        return index

    kinds = mujoco.mjtObj
    joints = np.array([[find(kinds.mjOBJ_JOINT, name) for name in row] for row in robot.joints])
    motors = [[find(kinds.mjOBJ_ACTUATOR, name) for name in row] for row in robot.motors]
    sensors = [find(kinds.mjOBJ_SENSOR, name) for name in robot.touch]
    return Addresses(
        qpos=model.jnt_qposadr[joints],
        qvel=model.jnt_dofadr[joints],
        actuator=np.array(motors),
        foot_force=model.sensor_adr[sensors],
        feet=np.array([find(kinds.mjOBJ_GEOM, name) for name in robot.feet]),
        trunk=find(kinds.mjOBJ_BODY, robot.trunk),
        sign=robot.joint_sign,
        zero=robot.joint_zero,
    )


def build_observe(robot: Robot, model: mujoco.MjModel, contact_threshold: float) -> Observe:
    """Function (qpos, qvel, sensordata) -> Observation for a model of either base.

    Args:
      robot: in the model.
      model: from ``sim.scene``.
      contact_threshold: foot force above which a contact counts [N].
    """
    at = find_addresses(robot, model)
    is_free = model.nq == 19

    def observe_free(qpos: Array, qvel: Array, sensordata: Array) -> Observation:
        return Observation(
            base_pos=qpos[:3],
            base_quat=qpos[3:7],
            base_vel=qvel[:3],
            base_ang_vel=qvel[3:6],
            joint_pos=at.joint_pos(qpos),
            joint_vel=at.joint_vel(qvel),
            contact=sensordata[at.foot_force] > contact_threshold,
        )

    def observe_planar(qpos: Array, qvel: Array, sensordata: Array) -> Observation:
        zero = jnp.zeros_like(qpos[0])
        half = 0.5 * qpos[2]  # MuJoCo's angle about +y, nose-down positive
        return Observation(
            base_pos=jnp.stack([qpos[0], zero, qpos[1]]),
            base_quat=jnp.stack([jnp.cos(half), zero, jnp.sin(half), zero]),
            base_vel=jnp.stack([qvel[0], zero, qvel[1]]),
            base_ang_vel=jnp.stack([zero, qvel[2], zero]),
            joint_pos=at.joint_pos(qpos),
            joint_vel=at.joint_vel(qvel),
            contact=sensordata[at.foot_force] > contact_threshold,
        )

    return observe_free if is_free else observe_planar


NOISE_DIM = 30  # planar: x, z, pitch; their rates; 12 joint angles; 12 joint rates
FREE_NOISE_DIM = 36  # the same, then: y, roll, yaw; their rates


def noise_dim(base: str) -> int:
    """Length of the noise vector of a base."""
    return FREE_NOISE_DIM if base == "free" else NOISE_DIM


def noise_scale(config: NoiseConfig, base: str = "planar") -> Float[np.ndarray, "noise"]:
    """Standard deviation of each entry of the noise vector (zero where noise is off)."""
    scale = np.concatenate(
        [
            [config.position, config.position, config.pitch],
            [config.velocity, config.velocity, config.pitch_rate],
            np.full(12, config.joint_position),
            np.full(12, config.joint_velocity),
        ]
    )
    if base == "free":
        sideways = [config.position, config.pitch, config.pitch]
        rates = [config.velocity, config.pitch_rate, config.pitch_rate]
        scale = np.concatenate([scale, sideways, rates])
    return scale * config.enabled


def add_noise(observation: Observation, noise: Float[Array, "noise"]) -> Observation:
    """Observation with a noise vector added; zero noise changes nothing.

    The vector's length says which base it is for: 30 for the planar one, whose trunk has no roll
    and no yaw, 36 for the free one.
    """
    if noise.shape[-1] == FREE_NOISE_DIM:
        return _add_free_noise(observation, noise)
    x, z, pitch, v_x, v_z, rate = noise[:6]
    w, _, y, _ = observation.base_quat
    # Nose-up by ``pitch``: a turn about y by -pitch, to first order, then normalised.
    w, y = w + 0.5 * pitch * y, y - 0.5 * pitch * w
    norm = jnp.sqrt(w * w + y * y)
    zero = jnp.zeros_like(w)
    return observation._replace(
        base_pos=observation.base_pos + jnp.stack([x, zero, z]),
        base_quat=jnp.stack([w / norm, zero, y / norm, zero]),
        base_vel=observation.base_vel + jnp.stack([v_x, zero, v_z]),
        base_ang_vel=observation.base_ang_vel + jnp.stack([zero, -rate, zero]),
        joint_pos=observation.joint_pos + noise[6:18].reshape(4, 3),
        joint_vel=observation.joint_vel + noise[18:30].reshape(4, 3),
    )


def _add_free_noise(observation: Observation, noise: Float[Array, "noise"]) -> Observation:
    x, z, pitch, v_x, v_z, rate = noise[:6]
    y, roll, yaw, v_y, roll_rate, yaw_rate = noise[30:]
    # A small turn about the trunk's own axes, to first order, then normalised.
    w, i, j, k = observation.base_quat
    a, b, c = 0.5 * roll, -0.5 * pitch, 0.5 * yaw
    quat = jnp.stack(
        [
            w - i * a - j * b - k * c,
            i + w * a + j * c - k * b,
            j + w * b - i * c + k * a,
            k + w * c + i * b - j * a,
        ]
    )
    return observation._replace(
        base_pos=observation.base_pos + jnp.stack([x, y, z]),
        base_quat=quat / jnp.sqrt(jnp.sum(quat**2)),
        base_vel=observation.base_vel + jnp.stack([v_x, v_y, v_z]),
        base_ang_vel=observation.base_ang_vel + jnp.stack([roll_rate, -rate, yaw_rate]),
        joint_pos=observation.joint_pos + noise[6:18].reshape(4, 3),
        joint_vel=observation.joint_vel + noise[18:30].reshape(4, 3),
    )
