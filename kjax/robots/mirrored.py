"""A record of constants for a robot whose legs are mirror images of each other."""

from typing import Any, cast

import numpy as np
from jaxtyping import Array

from kjax.types import RobotParams

FORE = np.array([1.0, 1.0, -1.0, -1.0])  # FR, FL, RR, RL
LEFT = np.array([-1.0, 1.0, -1.0, 1.0])

Point = tuple[float, float, float]


def mirrored_params(
    *,
    hip: tuple[float, float],
    link_mass: Point,
    link_com: tuple[Point, Point, Point],
    calf_is_mirrored: bool,
    trunk_mass: float,
    abduction_offset: float,
    **others: Any,
) -> RobotParams:
    """Parameters of all legs from those of the front left one; NumPy in float64.

    Args:
      hip: its abduction axis, ahead and to the left of the trunk's origin [m].
      link_mass: of its hip, thigh and calf [kg].
      link_com: (x, y, z) of their centres of mass, link frames [m].
      calf_is_mirrored: whether the right calf is another part than the left one.
      trunk_mass: [kg].
      abduction_offset: from its hip to its thigh [m].
      others: fields of ``RobotParams``, as they are.
    """
    zero, one = np.zeros(4), np.ones(4)
    side = LEFT if calf_is_mirrored else one
    com = [
        np.stack([link_com[0][0] * FORE, link_com[0][1] * LEFT, link_com[0][2] * one], axis=-1),
        np.stack([link_com[1][0] * one, link_com[1][1] * LEFT, link_com[1][2] * one], axis=-1),
        np.stack([link_com[2][0] * one, link_com[2][1] * side, link_com[2][2] * one], axis=-1),
    ]
    fields = others | {
        "mass": trunk_mass + 4 * np.asarray(link_mass).sum(),
        "trunk_mass": trunk_mass,
        "link_mass": link_mass,
        "link_com": np.stack(com, axis=1),
        "hip_pos": np.stack([hip[0] * FORE, hip[1] * LEFT, zero], axis=-1),
        "abduction_offset": abduction_offset * LEFT,
    }
    # Host arrays stand in for device arrays: such a module must not start JAX's backend.
    return RobotParams(
        **{name: cast(Array, np.asarray(value, np.float64)) for name, value in fields.items()}
    )
