"""A second robot, for tests: see toy.xml."""

from pathlib import Path

import numpy as np

from kjax.robots import Robot
from kjax.types import RobotParams

_NAMES = ("fore_right", "fore_left", "hind_right", "hind_left")  # order of ``Leg``
_FORE, _LEFT = np.array([1.0, 1.0, -1.0, -1.0]), np.array([-1.0, 1.0, -1.0, 1.0])
_ZERO, _ONE = np.zeros(4), np.ones(4)

PARAMS = RobotParams(
    mass=np.asarray(12.0 + 4 * (1.1 + 1.9 + 0.35)),
    inertia=np.array(
        [[0.421826, 0.0, -0.047472], [0.0, 1.481031, 0.0], [-0.047472, 0.0, 1.591930]]
    ),
    trunk_mass=np.asarray(12.0),
    trunk_com=np.array([0.01, 0.0, 0.005]),
    link_mass=np.array([1.1, 1.9, 0.35]),
    link_com=np.stack(
        [
            np.stack([-0.006 * _FORE, 0.004 * _LEFT, _ZERO], axis=-1),
            np.stack([-0.004 * _ONE, -0.02 * _LEFT, -0.04 * _ONE], axis=-1),
            np.stack([0.003 * _ONE, _ZERO, -0.11 * _ONE], axis=-1),
        ],
        axis=1,
    ),
    hip_pos=np.stack([0.26 * _FORE, 0.06 * _LEFT, 0.02 * _ONE], axis=-1),
    abduction_offset=0.09 * _LEFT,
    thigh_length=np.asarray(0.26),
    calf_length=np.asarray(0.25),
    foot_radius=np.asarray(0.03),
    torque_limit=np.array([45.0, 45.0, 70.0]),
    joint_range=np.array([[-0.88, 0.88], [-0.95, 3.95], [-2.85, -0.85]]),
    link_inertia=np.array([0.012, 0.003]),
    stand_height=np.asarray(0.36),
)

ROBOT = Robot(
    name="toy_robot:ROBOT",
    params=PARAMS,
    mjcf=Path(__file__).with_name("toy.xml"),
    trunk="torso",
    joints=tuple((f"{n}_roll", f"{n}_pitch", f"{n}_knee") for n in _NAMES),
    motors=tuple((f"{n}_roll_motor", f"{n}_pitch_motor", f"{n}_knee_motor") for n in _NAMES),
    feet=tuple(f"{n}_sole" for n in _NAMES),
    touch=tuple(f"{n}_touch" for n in _NAMES),
    joint_sign=-np.ones((4, 3)),
    joint_zero=np.tile([0.0, 0.0, -1.5], (4, 1)),
)
