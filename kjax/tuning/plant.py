"""The plant that is differentiated: a planar rigid body and the spin of its legs.

Stance feet stay where they came down; swing feet follow their reference. The legs' mass is part of
the body's, but their swinging turns it: the angular momentum of thighs and calves against the trunk
is the trunk's loss,

    d/dt (I omega + L_legs) = sum of moments,   L_legs = sum_i m_i (rho_i x rho_i') + I_i w_i,

which takes a bound's trunk through some 10 rad/s^2 in flight. What MuJoCo has and this has not:
impacts, slip as motion, terrain, a centre of mass that moves with the legs. Forces are what the
joints' torque limits and the ground's friction leave of the planned ones, less a part that is lost.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.dynamics import srb_planar
from kjax.legs.base import View
from kjax.legs.kinematics import PlanarState, inverse, leg_trig, moving_moments, planar_state
from kjax.legs.posture import standing
from kjax.legs.stance import stance_torque
from kjax.legs.swing import joint_reference
from kjax.types import RobotParams


class PlantParams(NamedTuple):
    """Parameters of the plant; data, so that every scenario may have its own.

    Attributes:
      mass: [kg].
      inertia: about the centre of mass, pitch axis [kg m^2].
      com: (2,) centre of mass in the trunk frame [m].
      friction: of the ground [-].
      lag: time constant with which a leg's force follows the planned one, from zero at touchdown;
        0: at once. It stands for all that joints, feet and ground take their time for [s].
      gain: part of a planned force that arrives; on the Go1 in MuJoCo 0.87 of F_x and 0.93 of F_z
        do [-].
      link_inertia: (2,) of a thigh and a calf about their centres of mass; both 0 and ``spin`` 0
        for legs without mass [kg m^2].
      spin: part of the legs' angular momentum that counts: 1, or 0 for legs without mass [-].
    """

    mass: Float[Array, ""]
    inertia: Float[Array, ""]
    com: Float[Array, "2"]
    friction: Float[Array, ""]
    lag: Float[Array, ""]
    gain: Float[Array, ""]
    link_inertia: Float[Array, "2"]
    spin: Float[Array, ""]


def nominal_plant(
    robot: RobotParams,
    mass: float,
    inertia: float,
    friction: float = 0.8,
    lag: float = 0.0,
    gain: float = 1.0,
    link_inertia: tuple[float, float] | None = None,
    spin: float = 1.0,
) -> PlantParams:
    """The plant of a robot that stands: its centre of mass is that of the whole body.

    Eight arguments: those of ``PlantParams``, with defaults.

    Args:
      robot: geometry and masses of the links.
      mass: of the body [kg].
      inertia: of the body [kg m^2].
      friction: of the ground [-].
      lag: of the forces [s].
      gain: of the forces [-].
      link_inertia: of a thigh and a calf about their centres of mass, the robot's if ``None``
        [kg m^2].
      spin: part of the legs' angular momentum that counts [-].
    """
    own = robot.link_inertia if link_inertia is None else link_inertia
    return PlantParams(
        mass=jnp.asarray(mass, float),
        inertia=jnp.asarray(inertia, float),
        com=planar_state(robot, standing()).x[:2],
        friction=jnp.asarray(friction, float),
        lag=jnp.asarray(lag, float),
        gain=jnp.asarray(gain, float),
        link_inertia=jnp.asarray(own, float),
        spin=jnp.asarray(spin, float),
    )


def view(
    robot: RobotParams, com: Float[Array, "2"], x: Float[Array, "6"], feet: Float[Array, "4 2"]
) -> View:
    """The robot as the controller sees it, legs from feet (4, 2) in the world [m]."""
    rotation = srb_planar.planar_rotation(x[2])
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
    still = jnp.zeros_like(feet)
    return View(planar=body, feet=feet, feet_vel=still, base_vel=body.base_vel, whole=None)


def local_view(
    robot: RobotParams, com: Float[Array, "2"], x: Float[Array, "6"], feet: Float[Array, "4 2"]
) -> View:
    """``view`` from the trunk's origin, as the controller keeps its points."""
    seen = view(robot, com, x, feet)
    body, origin = seen.planar, seen.planar.base
    return seen._replace(
        planar=body._replace(
            x=body.x.at[:2].add(-origin), base=body.base - origin, feet=body.feet - origin
        ),
        feet=seen.feet - origin,
    )


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
    return plant.gain * held / jnp.maximum(excess, 1.0)[:, None]


def follow(
    plant: PlantParams, before: Float[Array, "4 2"], planned: Float[Array, "4 2"], dt: float
) -> tuple[Float[Array, "4 2"], Float[Array, "4 2"]]:
    """Mean force of the next ``dt`` [s], and that at its end, from ``before`` to ``planned``."""
    return lagged(plant.lag, before, planned, dt)


def lagged(
    lag: Float[Array, ""], before: Float[Array, "4 d"], planned: Float[Array, "4 d"], dt: float
) -> tuple[Float[Array, "4 d"], Float[Array, "4 d"]]:
    """``follow`` with a time constant ``lag`` [s]."""
    ticks = dt / jnp.maximum(lag, 1e-3 * dt)
    left = jnp.exp(-ticks)
    gap = before - planned
    return planned + gap * (1.0 - left) / ticks, planned + gap * left


def leg_momentum(
    robot: RobotParams,
    plant: PlantParams,
    body: PlanarState,
    feet: Float[Array, "4 2"],
    feet_rate: Float[Array, "4 2"],
) -> Float[Array, ""]:
    """Angular momentum of the legs against the trunk, about the centre of mass [kg m^2/s].

    Args:
      robot: geometry and masses of the links.
      plant: centre of mass, inertia of the links.
      body: where the trunk is and how it moves.
      feet: (4, 2) where the feet are, world [m].
      feet_rate: (4, 2) their velocity, world [m/s].
    """
    angle, rate = joint_reference(robot, body, feet, feet_rate)
    still = jnp.zeros((4, 1), angle.dtype)
    angles, rates = (jnp.concatenate([still, a], axis=1) for a in (angle, rate))
    trig = leg_trig(angles)
    _, _, x_rate, z_rate = moving_moments(robot, trig, rates)
    hips = robot.hip_pos[:, ::2] - plant.com
    about_hips = jnp.sum(hips[:, 0] * z_rate - hips[:, 1] * x_rate)
    # A leg whose knee points ahead turns the other way round in its mirrored plane.
    # Thigh and calf about the thigh joint: a positive joint rate takes the nose-up sense backwards.
    _, m_thigh, m_calf = robot.link_mass
    thigh, calf = (robot.link_com[:, i, ::2] for i in (1, 2))
    q1, q12 = rates[:, 1], rates[:, 1] + rates[:, 2]
    knee = -robot.thigh_length * jnp.stack([trig.s1, trig.c1], axis=-1)
    shin = jnp.stack([trig.c12 * calf[:, 0] + trig.s12 * calf[:, 1],
                      -trig.s12 * calf[:, 0] + trig.c12 * calf[:, 1]], axis=-1)  # fmt: skip
    end = knee + shin
    knee_rate = q1[:, None] * jnp.stack([knee[:, 1], -knee[:, 0]], axis=-1)
    end_rate = knee_rate + q12[:, None] * jnp.stack([shin[:, 1], -shin[:, 0]], axis=-1)
    thighs = -(m_thigh * jnp.sum(thigh**2, axis=1) + plant.link_inertia[0]) * q1
    calves = m_calf * (end[:, 0] * end_rate[:, 1] - end[:, 1] * end_rate[:, 0])
    calves = calves - plant.link_inertia[1] * q12
    return plant.spin * (about_hips + jnp.sum(robot.knee * (thighs + calves)))


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
      plant: parameters.
      stance: (4,) legs that stand.
      x: (6,) state.
      contact: (4, 2) contact points of the feet, world [m].
      force: (4, 2) force of each leg, body frame [N].
      dt: [s].
    """
    body = srb_planar.SrbParams(plant.mass, plant.inertia, jnp.zeros((2, 2), x.dtype))
    stands = stance.astype(x.dtype)
    return srb_planar.rk4(
        lambda x: srb_planar.planted_dynamics(body, stands, contact, x, force.reshape(-1)), x, dt
    )
