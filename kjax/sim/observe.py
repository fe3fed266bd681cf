"""From an engine's arrays to an ``Observation``: the only place with addresses and signs.

It reads ``qpos``, ``qvel`` and ``sensordata`` only, so the same function serves ``MjData`` and
``mjx.Data``, one robot or, under ``vmap``, many.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

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
