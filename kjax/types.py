"""Data types that cross module borders; leg, mode and state order are decided here, once.

World frame: x forward, y left, z up. Everything is SI. Pitch is positive nose *up*, so the planar
rotation from body to world is the textbook ``[[cos, -sin], [sin, cos]]`` on (x, z).
"""

from collections.abc import Sequence
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


JOINT_NAMES = ("abduction", "thigh", "calf")


class Mode(IntEnum):
    """Contact mode of the planar rigid body: how many legs stand in front and behind."""

    FLIGHT = 0
    FRONT = 1
    REAR = 2
    TROT = 3  # one of each: a pace's too
    STAND = 4
    ONE_FRONT = 5
    ONE_REAR = 6
    TWO_FRONT_ONE_REAR = 7
    ONE_FRONT_TWO_REAR = 8


# Number of stance legs at the front and at the rear (the paper's alpha_i, alpha_j), by mode.
MODE_ALPHA = np.array([[0, 0], [2, 0], [0, 2], [1, 1], [2, 2], [1, 0], [0, 1], [2, 1], [1, 2]])


def contact_mode(stance: Sequence[bool]) -> Mode:
    """Contact mode of four legs, order of ``Leg``, that stand or do not."""
    count = np.array([sum(map(bool, stance[:2])), sum(map(bool, stance[2:]))])
    return Mode(int((count == MODE_ALPHA).all(axis=1).argmax()))


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
      inertia: (3, 3) of the whole robot about its centre of mass, nominal stance, trunk axes
        [kg m^2].
      trunk_mass: mass of the trunk link [kg].
      trunk_com: its centre of mass, trunk frame [m].
      link_mass: mass of hip, thigh and calf link [kg].
      link_com: (leg, link, xyz) centre of mass of each link in its own frame; x of the thigh and
        calf of a leg whose knee points ahead counts backwards, as all in its plane does [m].
      hip_pos: (leg, xyz) abduction axis in the trunk frame [m].
      abduction_offset: (leg,) signed lateral offset from hip to thigh, left positive [m].
      thigh_length: hip to knee [m].
      calf_length: knee to foot centre [m].
      foot_radius: radius of the spherical foot [m].
      torque_limit: of abduction, thigh and calf joint [N m].
      joint_range: (joint, low and high) angles that legs are asked for, inside the mechanical
        limits by a margin [rad].
      link_inertia: pitch inertia of thigh and calf about their own centres of mass [kg m^2].
      stand_height: of the centre of mass above the ground in the nominal stance [m].
      joint_inertia: least that a torque of the abduction, thigh and calf joint meets, rotors and
        recoil included; it bounds the gains of a leg in the air. Infinite: not known [kg m^2].
      knee: (leg,) 1 where the knee points back, -1 where it points ahead: such a leg is the mirror
        image of the others, its thigh and calf angles count the other way round [-].
    """

    mass: Float[Array, ""]
    inertia: Float[Array, "3 3"]
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
    joint_range: Float[Array, "3 2"]
    link_inertia: Float[Array, "2"]
    stand_height: Float[Array, ""]
    joint_inertia: Float[Array, "3"] = np.full(3, np.inf)  # type: ignore[assignment]
    knee: Float[Array, "4"] = np.ones(4)  # type: ignore[assignment]

    @property
    def pitch_inertia(self) -> Float[Array, ""]:
        """About the axis to the left [kg m^2]."""
        return self.inertia[..., 1, 1]


COMMAND_NAMES = ("v_x", "v_y", "yaw_rate", "height", "roll", "pitch")


class Command(NamedTuple):
    """What the robot is asked to do, piecewise constant in time.

    Attributes:
      times: start of each piece, increasing, the first one 0 [s].
      values: (pieces, 6) what holds from that time on, order of ``COMMAND_NAMES``: velocity along
        the heading and to the left [m/s], yaw rate [rad/s], height of the centre of mass above the
        gait's own [m], roll and pitch [rad]. The planar controller follows the first and fourth.
    """

    times: Float[Array, "pieces"]
    values: Float[Array, "pieces 6"]

    def hold(self, **columns: float) -> "Command":
        """A command of the same shape that asks for these values at all times, for 0 elsewhere.

        Args:
          columns: by name, e.g. ``v_x=0.3``.
        """
        unknown = sorted(columns.keys() - set(COMMAND_NAMES))
        if unknown:
            raise ValueError(f"{unknown[0]}: no column of a command, wanted {list(COMMAND_NAMES)}")
        row = np.array([columns.get(name, 0.0) for name in COMMAND_NAMES], float)
        values = np.broadcast_to(row, np.shape(self.values))
        return self._replace(values=values)  # type: ignore[arg-type]


class JointCommand(NamedTuple):
    """What the joints are told; (leg, joint), legs FR, FL, RR, RL by abduction, thigh, calf.

    A torque-controlled joint takes ``torque``. A motor with a PD loop of its own takes the other
    five and gives, for the sample that they were made from, the same:

        torque = feedforward + kp (q - joint_pos) + kd (dq - joint_vel)

    Attributes:
      torque: within the robot's limits [N m].
      q: angle wanted; the measured one where there is no stiffness [rad].
      dq: rate wanted; the measured one where there is no damping [rad/s].
      kp: proportional gain of the PD loop; 0 in stance [N m/rad].
      kd: its derivative gain; 0 in stance [N m s/rad].
      feedforward: torque besides those [N m].
    """

    torque: Float[Array, "4 3"]
    q: Float[Array, "4 3"]
    dq: Float[Array, "4 3"]
    kp: Float[Array, "4 3"]
    kd: Float[Array, "4 3"]
    feedforward: Float[Array, "4 3"]
