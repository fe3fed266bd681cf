"""What is known of a robot: plain data, in one record.

A robot of one's own is a module with a ``Robot`` in it; ``robot = "module:NAME"`` in a config finds
it, ``get_robot`` loads it.
"""

import pkgutil
from dataclasses import dataclass, field
from functools import cache
from importlib.resources.abc import Traversable
from pathlib import Path

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
      mjcf: the robot without ground and without joints of its trunk.
      trunk: name of the trunk's body in the MJCF.
      joints: names of the joints.
      motors: names of the actuators, one newton metre per unit of control.
      feet: names of the feet's geoms, spheres.
      touch: names of the feet's touch sensors.
      joint_sign: (4, 3) 1 or -1 [-].
      joint_zero: (4, 3) the model's angle where ours is 0 [rad].
    """

    name: str
    params: RobotParams
    mjcf: Traversable | Path
    trunk: str = "trunk"
    joints: JointNames = _JOINTS
    motors: JointNames = _JOINTS
    feet: LegNames = _FEET
    touch: LegNames = _FEET
    joint_sign: np.ndarray = field(default_factory=lambda: np.ones((4, 3)))
    joint_zero: np.ndarray = field(default_factory=lambda: np.zeros((4, 3)))


@cache
def robot_names() -> list[str]:
    """Names of the robots that kjax has: the modules beside this one."""
    import kjax.robots as package

    return sorted(one.name for one in pkgutil.iter_modules(package.__path__) if one.name != "robot")


def get_robot(name: str = DEFAULT) -> Robot:
    """A robot by its name.

    Args:
      name: of a robot that kjax has, or ``"module:NAME"`` for one's own: a ``Robot`` in a module
        that can be imported.

    Raises:
      ValueError: for a name that is none.
    """
    known = {one: f"kjax.robots.{one}:ROBOT" for one in robot_names()}
    robot: Robot = look_up("robot", name, known, Robot)
    return robot
