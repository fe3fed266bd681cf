"""Unitree Go1: constants, nominal stance, and where its MJCF lies.

Source of the figures: Unitree's go1_description URDF, as carried by MuJoCo Menagerie's
``unitree_go1``; ``tests/robots`` compares every one of them with the compiled model. This module
needs numpy only; ``kjax.sim.scene`` compiles the MJCF.
"""

from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, cast

import numpy as np
from jaxtyping import Array

from kjax.types import RobotParams

MJCF: Traversable = files("kjax.robots") / "go1.xml"

JOINTS = ("abduction", "thigh", "calf")

THIGH_LENGTH = 0.213  # m, hip to knee
CALF_LENGTH = 0.213  # m, knee to foot centre
FOOT_RADIUS = 0.023  # m
_HIP_X, _HIP_Y, _ABDUCTION = 0.1881, 0.04675, 0.08  # m
_FORE = np.array([1.0, 1.0, -1.0, -1.0])  # FR, FL, RR, RL
_LEFT = np.array([-1.0, 1.0, -1.0, 1.0])

_TRUNK_MASS = 5.204  # kg
_LINK_MASS = np.array([0.68, 1.009, 0.195862])  # kg: hip, thigh, calf
LINK_INERTIA = (
    0.004689,
    0.001498,
)  # kg m^2: thigh and calf about their centres of mass, pitch axis


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
    # Composite inertia of all links about the common centre of mass, in ``stand_pose(0.27)``.
    pitch_inertia=_f(0.394350),
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
)


def stand_pose(com_height: float) -> tuple[float, np.ndarray]:
    """Trunk height [m] and joint angles (4, 3) [rad] that stand with feet below the hips.

    Args:
      com_height: height of the whole-body centre of mass above flat ground [m].

    Raises:
      ValueError: if the legs are too short or too long for that height.
    """
    l1, l2 = THIGH_LENGTH, CALF_LENGTH
    trunk_height = com_height
    for _ in range(50):  # the legs' share of the centre of mass moves little: contracts fast
        drop = trunk_height - FOOT_RADIUS
        cosine = (drop**2 - l1**2 - l2**2) / (2 * l1 * l2)
        if not (drop > 0 and -0.942 < cosine < 0.622):  # knee within -2.80 .. -0.90 rad
            raise ValueError(f"com_height must be about 0.10 to 0.37 m, got {com_height}")
        calf = -np.arccos(cosine)
        thigh = -np.arctan2(l2 * np.sin(calf), l1 + l2 * np.cos(calf))
        offset = _com_height_in_trunk(thigh, calf)
        if abs(com_height - offset - trunk_height) < 1e-12:
            break
        trunk_height = com_height - offset
    return trunk_height, np.tile([0.0, thigh, calf], (4, 1))


def _com_height_in_trunk(thigh: float, calf: float) -> float:
    """Height of the whole-body centre of mass above the trunk frame, all legs alike [m]."""
    hip_com, thigh_com, calf_com = (_link_com()[:, i] for i in range(3))
    total = thigh + calf
    z_thigh = -np.sin(thigh) * thigh_com[:, 0] + np.cos(thigh) * thigh_com[:, 2]
    z_calf = (
        -THIGH_LENGTH * np.cos(thigh)
        - np.sin(total) * calf_com[:, 0]
        + np.cos(total) * calf_com[:, 2]
    )
    m_hip, m_thigh, m_calf = _LINK_MASS
    moment = _TRUNK_MASS * PARAMS.trunk_com[2] + np.sum(
        m_hip * hip_com[:, 2] + m_thigh * z_thigh + m_calf * z_calf
    )
    return float(moment / PARAMS.mass)
