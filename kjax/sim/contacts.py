"""What of the robot touches the world besides its feet, from recorded positions."""

import mujoco
import numpy as np

from kjax.sim.observe import Addresses


def body_contact(model: mujoco.MjModel, at: Addresses, qpos: np.ndarray) -> np.ndarray:
    """Whether anything but a foot touches the world, for each configuration (N,).

    A batch keeps no contacts, so they are found again from the positions that it records.

    Args:
      model: of the scene, with the episode's terrain.
      at: addresses of the robot in it.
      qpos: (N, nq) positions.
    """
    harmless = model.geom_bodyid == 0
    harmless[at.feet] = True
    data, out = mujoco.MjData(model), np.zeros(len(qpos), bool)
    for i, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        out[i] = not harmless[data.contact.geom].all()
    return out
