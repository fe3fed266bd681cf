"""Unitree Go1: constants, and where its MJCF lies.

Source of the figures: Unitree's go1_description URDF, as carried by MuJoCo Menagerie's
``unitree_go1``; ``tests/robots`` compares every one of them with the compiled model. This module
needs numpy only; ``kjax.sim.scene`` compiles the MJCF.
"""

from importlib.resources import files
from importlib.resources.abc import Traversable

from kjax.robots.mirrored import mirrored_params
from kjax.robots.robot import Robot

MJCF: Traversable = files("kjax.robots") / "go1.xml"

THIGH_LENGTH = 0.213  # m, hip to knee
CALF_LENGTH = 0.213  # m, knee to foot centre
FOOT_RADIUS = 0.023  # m

PARAMS = mirrored_params(
    trunk_mass=5.204,
    trunk_com=(0.0223, 0.002, -0.0005),
    link_mass=(0.68, 1.009, 0.195862),
    link_com=(
        (-0.0049166, -0.00762615, -8.865e-05),
        (-0.00304722, -0.019315, -0.0305004),
        (0.00429862, 0.000976676, -0.146197),
    ),
    calf_is_mirrored=False,
    hip=(0.1881, 0.04675),
    abduction_offset=0.08,
    thigh_length=THIGH_LENGTH,
    calf_length=CALF_LENGTH,
    foot_radius=FOOT_RADIUS,
    torque_limit=(23.7, 23.7, 35.55),
    # Inside the MJCF's 0.863, -0.686 .. 4.501 and -2.818 .. -0.888 by a small margin.
    joint_range=((-0.85, 0.85), (-0.67, 4.48), (-2.80, -0.90)),
    # Composite inertia of all links about the common centre of mass, in the nominal stance.
    inertia=(
        (0.127259, -0.000438, -0.014365),
        (-0.000438, 0.394350, -0.000092),
        (-0.014365, -0.000092, 0.422779),
    ),
    link_inertia=(0.004689, 0.001498),
    stand_height=0.27,
    joint_inertia=(0.01708, 0.01992, 0.01465),
)

ROBOT = Robot(name="go1", params=PARAMS, mjcf=MJCF)
