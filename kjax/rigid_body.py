"""The rigid body of the prediction: the robot's own, unless a config says otherwise."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.config import Overlay, RunConfig, SrbConfig
from kjax.config.units import InSi
from kjax.gait import Gait
from kjax.legs import kinematics
from kjax.observation import standing
from kjax.types import GRAVITY, RobotParams


def own_body(srb: SrbConfig, robot: RobotParams, height: float = 0.27) -> SrbConfig:
    """The rigid body of a config, the robot's own numbers where it gives none.

    Args:
      srb: of the config.
      robot: its mass, inertia and geometry.
      height: of the centre of mass in the nominal stance [m].
    """
    front, rear = nominal_feet(robot, height)
    return SrbConfig(
        mass=float(robot.mass) if srb.mass is None else srb.mass,
        inertia=float(robot.pitch_inertia) if srb.inertia is None else srb.inertia,
        feet_front=front if srb.feet_front is None else srb.feet_front,
        feet_rear=rear if srb.feet_rear is None else srb.feet_rear,
    )


def nominal_feet(
    robot: RobotParams, height: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Soles (x, z) of the front and rear feet from the centre of mass, standing below the hips [m].

    Args:
      robot: geometry and masses.
      height: of the centre of mass above the ground [m].
    """
    with jax.enable_x64(True):
        com, hips = _standing_com(robot, height)
        along = np.asarray(hips[:, 0] - com[0])
    return (float(along[:2].mean()), -height), (float(along[2:].mean()), -height)


@jax.jit
def _standing_com(robot: RobotParams, height: float) -> tuple[Array, Array]:
    """Centre of mass (2,) in the trunk frame with the feet below the hips, and the hips (4, 2)."""
    hips = jnp.asarray(robot.hip_pos[:, ::2], float)

    def again(_: Any, com: Array) -> Array:
        drop = height - robot.foot_radius - com[1]
        foot = jnp.stack([jnp.zeros(4), -drop - hips[:, 1]], axis=-1)
        thigh, calf, _trig = kinematics.inverse(robot, foot)
        joints = jnp.stack([jnp.zeros(4), thigh, calf], axis=-1)
        return kinematics.planar_state(robot, standing(joints)).x[:2]

    # The legs' share of the centre of mass moves little with the posture: this contracts fast.
    return jax.lax.fori_loop(0, 20, again, jnp.zeros(2)), hips


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
        return (jnp.abs(robot.hip_pos[:, 0]).mean(),) * 2
    return own.foothold_front, own.foothold_rear


def mean_force(gaits: list[Gait], config: InSi, robot: RobotParams) -> Float[Array, "G 2"]:
    """Vertical force of one front and one rear leg of each gait, mean of its stance [N].

    Over a cycle the legs carry the weight and leave no net turn:
    J_f + J_r = m g T,  J_f l_f = J_r l_r,  each shared by the stances of its legs. Zero where the
    config wants the paper's.
    """
    on = float(config.lmpc.input_reference == "mean")
    weight = body_numbers(config, robot)[0] * GRAVITY
    rows = []
    for one in gaits:
        front, rear = levers(config.gaits[one.name], robot)
        shares = jnp.stack([jnp.asarray(end, float) for end in (rear, front)]) / (front + rear)
        standing = [
            sum(phase.duration * sum(phase.stance[i] for i in legs) for phase in one.phases)
            for legs in ((0, 1), (2, 3))
        ]
        rows.append(shares * one.period / jnp.asarray(standing))
    return on * weight * jnp.stack(rows)
