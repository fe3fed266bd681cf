"""Unitree A1: constants, and where its MJCF lies.

Source of the figures: MuJoCo Menagerie's ``unitree_a1``, from Unitree's description.
``tests/robots`` compares every one of them with the compiled model.
"""

from importlib.resources import files
from importlib.resources.abc import Traversable

from kjax.robots.mirrored import mirrored_params
from kjax.robots.robot import Robot

MJCF: Traversable = files("kjax.robots") / "a1.xml"

PARAMS = mirrored_params(
    trunk_mass=4.713,
    trunk_com=(0.0, 0.0041, -0.0005),
    link_mass=(0.696, 1.013, 0.226),
    link_com=(
        (-0.003311, 0.000635, 3.1e-05),
        (-0.003237, -0.022327, -0.027326),
        (0.00472659, 0.0, -0.131975),
    ),
    calf_is_mirrored=True,
    hip=(0.183, 0.047),
    abduction_offset=0.08505,
    thigh_length=0.2,
    calf_length=0.2,
    foot_radius=0.02,
    torque_limit=(33.5, 33.5, 33.5),
    # Inside the MJCF's 0.802851, -1.0472 .. 4.18879 and -2.69653 .. -0.916298 by a small margin.
    joint_range=((-0.787, 0.787), (-1.032, 4.173), (-2.681, -0.932)),
    # Composite inertia of all links about the common centre of mass, in the nominal stance.
    inertia=(
        (0.142901, -0.000252, -0.009695),
        (-0.000252, 0.368469, -0.000405),
        (-0.009695, -0.000405, 0.399093),
    ),
    link_inertia=(0.005139, 0.003403),
    stand_height=0.253521,
    joint_inertia=(0.01827, 0.02155, 0.01566),
)

ROBOT = Robot(name="a1", params=PARAMS, mjcf=MJCF)
