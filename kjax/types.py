"""Data types that cross module borders; leg, mode and state order are decided here, once.

World frame: x forward, y left, z up. Everything is SI. Pitch is positive nose *up*, so the planar
rotation from body to world is the textbook ``[[cos, -sin], [sin, cos]]`` on (x, z).
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

GRAVITY = 9.81  # m/s^2, MuJoCo's default

STATE_NAMES = ("p_x", "p_z", "theta", "v_x", "v_z", "omega")
STATE_UNITS = ("m", "m", "rad", "m/s", "m/s", "rad/s")
STATE_DIM = len(STATE_NAMES)

INPUT_NAMES = ("F_x_front", "F_z_front", "F_x_rear", "F_z_rear")
INPUT_DIM = len(INPUT_NAMES)


class Leg(IntEnum):
    """Leg order of every (4, ...) array in kjax."""

    FR = 0
    FL = 1
    RR = 2
    RL = 3


class Mode(IntEnum):
    """Contact mode of the planar rigid body; also the index into every per-mode table."""

    FLIGHT = 0
    FRONT = 1
    REAR = 2
    TROT = 3
    STAND = 4


# Number of stance legs at the front and at the rear (the paper's alpha_i, alpha_j), by mode.
MODE_ALPHA = np.array([[0, 0], [2, 0], [0, 2], [1, 1], [2, 2]])


class Observation(NamedTuple):
    """What the controller reads of the robot, from any simulator or state estimator.

    Attributes:
      base_pos: position of the trunk frame, world [m].
      base_quat: orientation of the trunk, (w, x, y, z), body to world [-].
      base_vel: velocity of the trunk frame's origin, world [m/s].
      base_ang_vel: angular velocity of the trunk, *body* frame [rad/s].
      joint_pos: abduction, thigh, calf angle of each leg (order of ``Leg``) [rad].
      joint_vel: their rates [rad/s].
      contact: whether the foot's contact sensor fires [-].
    """

    base_pos: Float[Array, "3"]
    base_quat: Float[Array, "4"]
    base_vel: Float[Array, "3"]
    base_ang_vel: Float[Array, "3"]
    joint_pos: Float[Array, "4 3"]
    joint_vel: Float[Array, "4 3"]
    contact: Bool[Array, "4"]


class RobotParams(NamedTuple):
    """Geometry, masses and limits that the controller needs; pure data, so it may be batched.

    Attributes:
      mass: total mass [kg].
      pitch_inertia: of the whole robot about its centre of mass, nominal stance [kg m^2].
      trunk_mass: mass of the trunk link [kg].
      trunk_com: its centre of mass, trunk frame [m].
      link_mass: mass of hip, thigh and calf link [kg].
      link_com: (leg, link, xyz) centre of mass of each link in its own frame [m].
      hip_pos: (leg, xyz) abduction axis in the trunk frame [m].
      abduction_offset: (leg,) signed lateral offset from hip to thigh, left positive [m].
      thigh_length: hip to knee [m].
      calf_length: knee to foot centre [m].
      foot_radius: radius of the spherical foot [m].
      torque_limit: of abduction, thigh and calf joint [N m].
    """

    mass: Float[Array, ""]
    pitch_inertia: Float[Array, ""]
    trunk_mass: Float[Array, ""]
    trunk_com: Float[Array, "3"]
    link_mass: Float[Array, "3"]
    link_com: Float[Array, "4 3 3"]
    hip_pos: Float[Array, "4 3"]
    abduction_offset: Float[Array, "4"]
    thigh_length: Float[Array, ""]
    calf_length: Float[Array, ""]
    foot_radius: Float[Array, ""]
    torque_limit: Float[Array, "3"]


class Command(NamedTuple):
    """Forward velocity command, piecewise constant in time.

    Attributes:
      times: start of each piece, increasing, the first one 0 [s].
      velocities: velocity that holds from that time on [m/s].
    """

    times: Float[Array, "pieces"]
    velocities: Float[Array, "pieces"]
