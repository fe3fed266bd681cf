"""The plant that is differentiated: a planar rigid body on four legs without mass.

Stance feet stay where they came down; swing feet are where the foothold law says at the moment of
touchdown. What MuJoCo has and this has not: masses of the legs, impacts, slip as motion, terrain.
Forces are what the joints' torque limits and the ground's friction leave of the planned ones.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax import srb
from kjax.legs.base import View
from kjax.legs.kinematics import PlanarState, inverse, planar_state
from kjax.legs.stance import stance_torque
from kjax.types import Observation, RobotParams


class PlantParams(NamedTuple):
    """Numbers of the plant; data, so that every scenario may have its own.

    Attributes:
      mass: [kg].
      inertia: about the centre of mass, pitch axis [kg m^2].
      com: (2,) centre of mass in the trunk frame [m].
      friction: of the ground [-].
      lag: time constant with which a leg's force follows the planned one, from zero at touchdown;
        0: at once. It stands for all that joints, feet and ground take their time for [s].
    """

    mass: Float[Array, ""]
    inertia: Float[Array, ""]
    com: Float[Array, "2"]
    friction: Float[Array, ""]
    lag: Float[Array, ""]


def nominal_plant(
    robot: RobotParams, mass: float, inertia: float, friction: float = 0.8, lag: float = 0.0
) -> PlantParams:
    """The plant of a robot that stands: its centre of mass is that of the whole body.

    Args:
      robot: geometry and masses of the links.
      mass: of the body [kg].
      inertia: of the body [kg m^2].
      friction: of the ground [-].
      lag: of the forces [s].
    """
    standing = Observation(
        base_pos=jnp.zeros(3),
        base_quat=jnp.array([1.0, 0.0, 0.0, 0.0]),
        base_vel=jnp.zeros(3),
        base_ang_vel=jnp.zeros(3),
        joint_pos=jnp.tile(jnp.array([0.0, 0.9, -1.8]), (4, 1)),
        joint_vel=jnp.zeros((4, 3)),
        contact=jnp.ones(4, bool),
    )
    return PlantParams(
        mass=jnp.asarray(mass, float),
        inertia=jnp.asarray(inertia, float),
        com=planar_state(robot, standing).x[:2],
        friction=jnp.asarray(friction, float),
        lag=jnp.asarray(lag, float),
    )


def view(
    robot: RobotParams, com: Float[Array, "2"], x: Float[Array, "6"], feet: Float[Array, "4 2"]
) -> View:
    """The robot as the controller sees it, legs from feet (4, 2) in the world [m]."""
    rotation = srb.planar_rotation(x[2])
    lever = rotation @ com
    base = x[:2] - lever
    _, _, trig = inverse(robot, (feet - base) @ rotation - robot.hip_pos[:, ::2])
    body = PlanarState(
        x=x,
        rotation=rotation,
        base=base,
        base_vel=x[3:5] - x[5] * jnp.stack([-lever[1], lever[0]]),
        omega=x[5],
        trig=trig,
        feet=feet,
    )
    return View(planar=body, feet=feet, whole=None)


def feasible(
    robot: RobotParams, plant: PlantParams, body: PlanarState, force: Float[Array, "4 2"]
) -> Float[Array, "4 2"]:
    """What joints and ground let pass of planned forces (4, 2), body frame [N].

    A leg that lacks torque presses less in the same direction; the ground neither pulls nor holds
    beyond friction.
    """
    world = force @ body.rotation.T
    upward = jnp.maximum(world[:, 1], 0.0)
    hold = plant.friction * upward
    held = jnp.stack([jnp.clip(world[:, 0], -hold, hold), upward], axis=1) @ body.rotation
    torque = stance_torque(robot, body.trig, held)
    excess = jnp.max(jnp.abs(torque) / robot.torque_limit[1:], axis=1)
    return held / jnp.maximum(excess, 1.0)[:, None]


def follow(
    plant: PlantParams, before: Float[Array, "4 2"], planned: Float[Array, "4 2"], dt: float
) -> tuple[Float[Array, "4 2"], Float[Array, "4 2"]]:
    """Mean force of the next ``dt`` [s], and that at its end, from ``before`` to ``planned``."""
    ticks = dt / jnp.maximum(plant.lag, 1e-3 * dt)
    left = jnp.exp(-ticks)
    gap = before - planned
    return planned + gap * (1.0 - left) / ticks, planned + gap * left


def advance(
    plant: PlantParams,
    stance: Bool[Array, "4"],
    x: Float[Array, "6"],
    contact: Float[Array, "4 2"],
    force: Float[Array, "4 2"],
    dt: float,
) -> Float[Array, "6"]:
    """State ``dt`` [s] later, forces held in the body frame; one Runge-Kutta step.

    Args:
      plant: numbers.
      stance: (4,) legs that stand.
      x: (6,) state.
      contact: (4, 2) contact points of the feet, world [m].
      force: (4, 2) force of each leg, body frame [N].
      dt: [s].
    """
    body = srb.SrbParams(plant.mass, plant.inertia, jnp.zeros((2, 2), x.dtype))
    stands = stance.astype(x.dtype)
    return srb.rk4(
        lambda x: srb.planted_dynamics(body, stands, contact, x, force.reshape(-1)), x, dt
    )
