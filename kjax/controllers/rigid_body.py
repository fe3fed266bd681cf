"""The rigid body of the prediction: the robot's own, unless a config says otherwise."""

from typing import Any

import numpy as np
from jaxtyping import Array, Float

from kjax.concrete import stacked
from kjax.config import Overlay, RunConfig, SrbConfig
from kjax.config.units import InSi
from kjax.dynamics.srb_planar import SrbParams
from kjax.gait import Gait
from kjax.legs.posture import nominal_feet
from kjax.types import GRAVITY, RobotParams


def own_body(srb: SrbConfig, robot: RobotParams, height: float | None = None) -> SrbParams:
    """The rigid body of a config, the robot's own where it gives none; NumPy in float64.

    Args:
      srb: of the config.
      robot: its mass, inertia and geometry.
      height: of the centre of mass in the nominal stance; the robot's own if ``None`` [m].
    """
    front, rear = nominal_feet(robot, float(robot.stand_height) if height is None else height)
    own = (
        robot.mass if srb.mass is None else srb.mass,
        robot.pitch_inertia if srb.inertia is None else srb.inertia,
        (
            front if srb.feet_front is None else srb.feet_front,
            rear if srb.feet_rear is None else srb.feet_rear,
        ),
    )
    return SrbParams(*(np.asarray(part, float) for part in own))  # type: ignore[arg-type]


def body_numbers(config: RunConfig | Overlay | InSi, robot: RobotParams) -> tuple[Any, Any]:
    """Mass [kg] and pitch inertia [kg m^2] of the prediction; may be traced."""
    srb = config.srb
    return (
        robot.mass if srb.mass is None else srb.mass,
        robot.pitch_inertia if srb.inertia is None else srb.inertia,
    )


def levers(own: InSi, robot: RobotParams) -> tuple[Any, Any]:
    """Distances of a gait's front and rear footholds from the centre of mass, standing still [m].

    Below the hips both count as the hips' mean, so that the ends share the weight alike.
    """
    if own.foothold_front is None or own.foothold_rear is None:
        return (abs(robot.hip_pos[:, 0]).mean(),) * 2
    return own.foothold_front, own.foothold_rear


def mean_force(gaits: list[Gait], config: InSi, robot: RobotParams) -> Float[Array, "G 2"]:
    """Vertical force of one front and one rear leg of each gait, mean of its stance [N].

    Over a cycle the legs carry the weight and leave no net pitch moment:
    J_f + J_r = m g T,  J_f l_f = J_r l_r,  each shared by the stances of its legs. Zero where the
    config wants the paper's.
    """
    on = float(config.lmpc.input_reference == "mean")
    weight = body_numbers(config, robot)[0] * GRAVITY
    rows = []
    for one in gaits:
        front, rear = levers(config.gaits[one.name], robot)
        shares = stacked([rear, front]) / (front + rear)
        standing = [
            sum(phase.duration * sum(phase.stance[i] for i in legs) for phase in one.phases)
            for legs in ((0, 1), (2, 3))
        ]
        rows.append(shares * one.period / np.asarray(standing))
    return on * weight * stacked(rows)
