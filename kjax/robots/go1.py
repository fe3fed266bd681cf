"""Unitree Go1: constants, and where its MJCF lies.

Source of the figures: Unitree's go1_description URDF, as carried by MuJoCo Menagerie's
``unitree_go1``; ``tests/robots`` compares every one of them with the compiled model. This module
needs numpy only; ``kjax.sim.scene`` compiles the MJCF.
"""

from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, cast

import numpy as np
from jaxtyping import Array

from kjax.robots.robot import Robot
from kjax.types import RobotParams

MJCF: Traversable = files("kjax.robots") / "go1.xml"

THIGH_LENGTH = 0.213  # m, hip to knee
CALF_LENGTH = 0.213  # m, knee to foot centre
FOOT_RADIUS = 0.023  # m
_HIP_X, _HIP_Y, _ABDUCTION = 0.1881, 0.04675, 0.08  # m
_FORE = np.array([1.0, 1.0, -1.0, -1.0])  # FR, FL, RR, RL
_LEFT = np.array([-1.0, 1.0, -1.0, 1.0])

_TRUNK_MASS = 5.204  # kg
_LINK_MASS = np.array([0.68, 1.009, 0.195862])  # kg: hip, thigh, calf
_LINK_INERTIA = (0.004689, 0.001498)  # kg m^2: thigh and calf, pitch axis


def _link_com() -> np.ndarray:
    """Centre of mass of hip, thigh and calf link of each leg, link frames [m]."""
    hip = np.stack([-0.0049166 * _FORE, -0.00762615 * _LEFT, np.full(4, -8.865e-05)], axis=-1)
    thigh = np.stack([np.full(4, -0.00304722), -0.019315 * _LEFT, np.full(4, -0.0305004)], axis=-1)
    calf = np.tile([0.00429862, 0.000976676, -0.146197], (4, 1))
    return np.stack([hip, thigh, calf], axis=1)


def _f(values: Any) -> Array:
    """Host array standing in for a device array: this module must not start JAX's backend."""
    return cast(Array, np.asarray(values, np.float64))


PARAMS = RobotParams(
    mass=_f(_TRUNK_MASS + 4 * _LINK_MASS.sum()),  # 12.743 kg
    # Composite inertia of all links about the common centre of mass, in the nominal stance.
    inertia=_f(
        [
            [0.127259, -0.000438, -0.014365],
            [-0.000438, 0.394350, -0.000092],
            [-0.014365, -0.000092, 0.422779],
        ]
    ),
    trunk_mass=_f(_TRUNK_MASS),
    trunk_com=_f([0.0223, 0.002, -0.0005]),
    link_mass=_f(_LINK_MASS),
    link_com=_f(_link_com()),
    hip_pos=_f(np.stack([_HIP_X * _FORE, _HIP_Y * _LEFT, np.zeros(4)], axis=-1)),
    abduction_offset=_f(_ABDUCTION * _LEFT),
    thigh_length=_f(THIGH_LENGTH),
    calf_length=_f(CALF_LENGTH),
    foot_radius=_f(FOOT_RADIUS),
    torque_limit=_f([23.7, 23.7, 35.55]),
    # Inside the MJCF's 0.863, -0.686 .. 4.501 and -2.818 .. -0.888 by a small margin.
    joint_range=_f([[-0.85, 0.85], [-0.67, 4.48], [-2.80, -0.90]]),
    link_inertia=_f(_LINK_INERTIA),
    stand_height=_f(0.27),
    joint_inertia=_f([0.01708, 0.01992, 0.01465]),
)

ROBOT = Robot(name="go1", params=PARAMS, mjcf=MJCF)
