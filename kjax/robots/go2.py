"""Unitree Go2: constants, and where its MJCF lies.

Source of the figures: MuJoCo Menagerie's ``unitree_go2``, from Unitree's description; our feet lie
at the very end of the calf.
``tests/robots`` compares every one of them with the compiled model.
"""

from importlib.resources import files
from importlib.resources.abc import Traversable

from kjax.robots.mirrored import mirrored_params
from kjax.robots.robot import Robot

MJCF: Traversable = files("kjax.robots") / "go2.xml"

PARAMS = mirrored_params(
    trunk_mass=6.921,
    trunk_com=(0.021112, 0.0, -0.005366),
    link_mass=(0.678, 1.152, 0.241352),
    link_com=(
        (-0.0054, 0.00194, -0.000105),
        (-0.00374, -0.0223, -0.0327),
        (0.00629595, -0.000622121, -0.141417),
    ),
    calf_is_mirrored=True,
    hip=(0.1934, 0.0465),
    abduction_offset=0.0955,
    thigh_length=0.213,
    calf_length=0.213,
    foot_radius=0.022,
    torque_limit=(23.7, 23.7, 45.43),
    # Inside 1.0472, -0.5236 .. 3.4907 (front and rear legs in common), -2.7227 .. -0.83776.
    joint_range=((-1.032, 1.032), (-0.508, 3.475), (-2.707, -0.853)),
    # Composite inertia of all links about the common centre of mass, in the nominal stance.
    inertia=(
        (0.172228, 0.000122, -0.016666),
        (0.000122, 0.485181, -0.000031),
        (-0.016666, -0.000031, 0.534879),
    ),
    link_inertia=(0.0058, 0.00149),
    stand_height=0.27,
    joint_inertia=(0.01912, 0.02188, 0.01513),
)

ROBOT = Robot(name="go2", params=PARAMS, mjcf=MJCF)
