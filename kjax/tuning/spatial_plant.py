"""The plant that is differentiated in three dimensions: a rigid body on legs without mass.

Its step is exact in place, velocity and angular momentum (``dynamics.srb_spatial``). Stance feet
stay where they came down; swing feet follow their reference and weigh nothing: the legs' mass is
part of the body's, their swinging turns it not. Forces are what the joints' torque limits and the
ground's friction cone leave of the planned ones, less a part that is lost; they hold in the world
until the next plan. What MuJoCo has and this has not: angular momentum of swinging legs, impacts,
slip as motion, terrain, a centre of mass that moves with the legs.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.legs import spatial
from kjax.legs.base import View
from kjax.legs.posture import standing
from kjax.legs.stance import spatial_stance_torque
from kjax.types import RobotParams

NOISE_DIM = 9  # attitude, velocity, angular velocity


class SpatialPlantParams(NamedTuple):
    """Parameters of the plant; data, so that every scenario may have its own.

    Attributes:
      body: mass and inertia.
      com: (3,) centre of mass in the trunk frame [m].
      friction: of the ground [-].
      lag: time constant with which a leg's force follows the planned one, see ``plant.PlantParams``
        [s].
      gain: part of a planned force that arrives [-].
    """

    body: SpatialBody
    com: Float[Array, "3"]
    friction: Float[Array, ""]
    lag: Float[Array, ""]
    gain: Float[Array, ""]


def nominal_spatial_plant(
    robot: RobotParams,
    body: SpatialBody,
    friction: float = 0.8,
    lag: float = 0.0,
    gain: float = 1.0,
) -> SpatialPlantParams:
    """The plant of a robot that stands: its centre of mass is that of the whole robot.

    Args:
      robot: geometry and masses of the links.
      body: mass [kg] and inertia (3, 3) [kg m^2].
      friction: of the ground [-].
      lag: of the forces [s].
      gain: of the forces [-].
    """
    ahead = jnp.array([1.0, 0.0])
    return SpatialPlantParams(
        body=SpatialBody(jnp.asarray(body.mass, float), jnp.asarray(body.inertia, float)),
        com=spatial.spatial_state(robot, ahead, standing()).com,
        friction=jnp.asarray(friction, float),
        lag=jnp.asarray(lag, float),
        gain=jnp.asarray(gain, float),
    )


def trunk_origin(plant: SpatialPlantParams, body: BodyState) -> Float[Array, "3"]:
    """Origin of the trunk's frame, world [m]."""
    return body.p - body.R @ plant.com


def measure(
    robot: RobotParams,
    plant: SpatialPlantParams,
    body: BodyState,
    feet: Float[Array, "4 3"],
    error: Float[Array, "9"],
) -> View:
    """The robot as the controller sees it, from the trunk's origin, axes of the world.

    Args:
      robot: geometry.
      plant: parameters.
      body: the body.
      feet: (4, 3) foot centres, world [m].
      error: (9,) of the measured attitude (a turn about the trunk's axes), velocity of the trunk
        and angular velocity (about its axes); with the attitude everything is seen turned
        [rad, m/s, rad/s].
    """
    local = (feet - trunk_origin(plant, body)) @ body.R
    _, hip, trig = spatial.inverse(robot, local - robot.hip_pos)
    omega = srb_spatial.angular_velocity(plant.body, body.R, body.L)
    base_vel = body.v - jnp.cross(omega, body.R @ plant.com) + error[3:6]
    R = body.R @ rotations.exp(error[:3])
    omega = R @ (body.R.T @ omega + error[6:])
    com = R @ plant.com
    whole = spatial.seen_from_trunk(
        spatial.Trunk(rotation=R, base=jnp.zeros_like(com), base_vel=base_vel, omega=omega),
        com,
        base_vel + jnp.cross(omega, com),
        hip,
        trig,
        local @ R.T,
    )
    still = jnp.zeros_like(feet)
    return View(
        planar=whole.planar, feet=whole.feet, feet_vel=still, base_vel=base_vel, whole=whole
    )


def feasible(
    robot: RobotParams,
    plant: SpatialPlantParams,
    body: BodyState,
    seen: View,
    force: Float[Array, "4 3"],
) -> Float[Array, "4 3"]:
    """What joints and ground let pass of planned forces (4, 3), world [N].

    A leg that lacks torque presses less in the same direction; the ground neither pulls nor holds
    beyond its friction cone.

    Args:
      robot: geometry and torque limits.
      plant: friction and gain.
      body: its attitude.
      seen: whose joint angles are right, whatever the attitude's error.
      force: planned.
    """
    upward = jnp.maximum(force[:, 2], 0.0)
    square = force[:, 0] ** 2 + force[:, 1] ** 2
    hold = plant.friction * upward
    slides = square > hold**2
    # No root of 0, whose derivative is infinite.
    part = jnp.where(slides, hold / jnp.sqrt(jnp.where(slides, square, 1.0)), 1.0)
    held = jnp.concatenate([force[:, :2] * part[:, None], upward[:, None]], axis=1)
    assert seen.whole is not None  # ``measure`` made it
    torque = spatial_stance_torque(robot, seen.whole.hip, seen.planar.trig, held @ body.R)
    excess = jnp.max(jnp.abs(torque) / robot.torque_limit, axis=1)
    return plant.gain * held / jnp.maximum(excess, 1.0)[:, None]


def advance(
    robot: RobotParams,
    plant: SpatialPlantParams,
    stance: Bool[Array, "4"],
    body: BodyState,
    feet: Float[Array, "4 3"],
    force: Float[Array, "4 3"],
    dt: float,
) -> BodyState:
    """The body ``dt`` [s] later, forces held in the world. Seven arguments: all that acts on it.

    Args:
      robot: radius of the feet, which press on level ground.
      plant: parameters.
      stance: (4,) legs that stand.
      body: now.
      feet: (4, 3) foot centres, world [m].
      force: (4, 3) force of each leg, world [N].
      dt: [s].
    """
    soles = feet.at[:, 2].add(-robot.foot_radius)
    pressed = Contacts(feet=soles, force=jnp.where(stance[:, None], force, 0.0))
    return srb_spatial.step(plant.body, body, pressed, dt)
