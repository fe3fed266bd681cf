"""Sagittal two-link leg kinematics and the whole-body centre of mass.

Leg frame: origin at the thigh joint, x forward, z up, in the trunk's sagittal plane (the trunk
frame shifted to the hip). Joint angles are the robot's: 0 is straight down, a positive thigh angle
swings the foot back, the calf angle is negative (knee pointing back). A leg whose knee points
ahead is the mirror image: k = -1, and its angles count the other way round.

    x = k (-l1 sin(q1) - l2 sin(q1 + q2)),   z = -l1 cos(q1) - l2 cos(q1 + q2)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.types import Observation, RobotParams

# Shortest and longest hip-to-foot distance that inverse kinematics is asked for, as fractions of
# the stretched leg: the first keeps clear of the folded knee's limit, the second of the singular
# straight leg.
REACH = (0.15, 0.985)
SINGULAR = 0.0275  # Jacobian's determinant over the squared leg length; below it a leg is straight


class LegTrig(NamedTuple):
    """Sines and cosines of q1 and q1 + q2, one of each per leg; shared by everything below."""

    s1: Float[Array, "n"]
    c1: Float[Array, "n"]
    s12: Float[Array, "n"]
    c12: Float[Array, "n"]


def leg_trig(joint_pos: Float[Array, "4 3"]) -> LegTrig:
    """Trigonometry of all legs, from joint angles (4, 3) [rad]."""
    q1 = joint_pos[:, 1]
    q12 = q1 + joint_pos[:, 2]
    trig = LegTrig(s1=jnp.sin(q1), c1=jnp.cos(q1), s12=jnp.sin(q12), c12=jnp.cos(q12))
    # Without a barrier XLA's CPU backend fuses the sines into every later use and so evaluates
    # them again for each element of each result.
    return jax.lax.optimization_barrier(trig)


def foot_position(robot: RobotParams, trig: LegTrig) -> Float[Array, "n 2"]:
    """Foot centres (x, z) of all legs relative to the thigh joints, trunk frame [m]."""
    l1, l2 = robot.thigh_length, robot.calf_length
    x = robot.knee * (-l1 * trig.s1 - l2 * trig.s12)
    return jnp.stack([x, -l1 * trig.c1 - l2 * trig.c12], axis=-1)


def foot_jacobian(robot: RobotParams, trig: LegTrig) -> Float[Array, "n 2 2"]:
    """Derivative of ``foot_position`` by (thigh, calf) angle, [leg, (x, z), joint] [m/rad]."""
    l1, l2 = robot.thigh_length, robot.calf_length
    calf_x, calf_z = -l2 * trig.c12, l2 * trig.s12
    thigh_x, thigh_z = -l1 * trig.c1 + calf_x, l1 * trig.s1 + calf_z
    thigh_x, calf_x = robot.knee * thigh_x, robot.knee * calf_x
    return jnp.stack(
        [jnp.stack([thigh_x, calf_x], axis=-1), jnp.stack([thigh_z, calf_z], axis=-1)], axis=-2
    )


def inverse(
    robot: RobotParams, foot: Float[Array, "n 2"]
) -> tuple[Float[Array, "n"], Float[Array, "n"], LegTrig]:
    """Thigh and calf angle that put the foot at ``foot``, and their trigonometry.

    A target out of reach is pulled to the nearest reachable one on the line from the hip.

    Args:
      robot: link lengths.
      foot: (n, 2) target (x, z) relative to the thigh joint, trunk frame [m].
    """
    l1, l2 = robot.thigh_length, robot.calf_length
    low, high = REACH[0] * (l1 + l2), REACH[1] * (l1 + l2)
    # The hip itself has no direction: take straight down, before any square root sees it.
    at_hip = jnp.sum(foot**2, axis=-1, keepdims=True) < 1e-12
    foot = jnp.where(at_hip, jnp.stack([jnp.zeros_like(low), -low]), foot)
    square = jnp.sum(foot**2, axis=-1)
    factor = jnp.sqrt(jnp.clip(square, low**2, high**2) / square)
    x, z = robot.knee * foot[:, 0] * factor, foot[:, 1] * factor
    cosine = (square * factor**2 - l1**2 - l2**2) / (2.0 * l1 * l2)
    folded, straight = jnp.cos(robot.joint_range[2])
    c2 = jnp.clip(cosine, folded, straight)
    s2 = -jnp.sqrt(1.0 - c2**2)
    # (x, z) = -Rot(q1) (k2, k1): read the angle off the rotated pair instead of two arctangents.
    k1, k2 = l1 + l2 * c2, l2 * s2
    sine, cosine = -x * k1 + z * k2, -z * k1 - x * k2
    norm = jnp.sqrt(sine**2 + cosine**2)
    s1, c1 = sine / norm, cosine / norm
    trig = LegTrig(s1=s1, c1=c1, s12=s1 * c2 + c1 * s2, c12=c1 * c2 - s1 * s2)
    angles = jnp.arctan2(sine, cosine), jnp.arctan2(s2, c2), trig
    return jax.lax.optimization_barrier(angles)


def joint_rates(
    robot: RobotParams, trig: LegTrig, velocity: Float[Array, "4 2"]
) -> Float[Array, "4 2"]:
    """Thigh and calf rates [rad/s] that move the feet with a velocity (x, z), trunk frame [m/s].

    A leg too near its singular straight posture gets none.
    """
    J = foot_jacobian(robot, trig)
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    least = SINGULAR * (robot.thigh_length + robot.calf_length) ** 2
    safe = jnp.where(jnp.abs(det) > least, det, jnp.inf)
    thigh = (J[:, 1, 1] * velocity[:, 0] - J[:, 0, 1] * velocity[:, 1]) / safe
    calf = (J[:, 0, 0] * velocity[:, 1] - J[:, 1, 0] * velocity[:, 0]) / safe
    return jnp.stack([thigh, calf], axis=-1)


class PlanarState(NamedTuple):
    """Sagittal-plane quantities that plan and act share.

    Attributes:
      x: (6,) SRB state of the *whole-body* centre of mass with the trunk's pitch.
      rotation: (2, 2) R_world_body on (x, z).
      base: (2,) trunk origin, world [m].
      base_vel: (2,) its velocity, world [m/s].
      omega: () pitch rate, nose-up positive [rad/s].
      trig: leg trigonometry.
      feet: (4, 2) foot centres, world [m].
    """

    x: Float[Array, "6"]
    rotation: Float[Array, "2 2"]
    base: Float[Array, "2"]
    base_vel: Float[Array, "2"]
    omega: Float[Array, ""]
    trig: LegTrig
    feet: Float[Array, "4 2"]


def planar_state(robot: RobotParams, observation: Observation) -> PlanarState:
    """SRB state, rotation and feet in the sagittal plane, from an observation.

    The trunk's roll and yaw and the abduction joints are taken as zero (planar robot).
    """
    w, _, y, _ = observation.base_quat
    # A turn about +y by phi takes the nose down: theta = -phi, and (w, y) = (cos, sin)(phi / 2).
    scale = 1.0 / (w * w + y * y)
    c, s = (w * w - y * y) * scale, -2.0 * w * y * scale
    rotation = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    omega = -observation.base_ang_vel[1]
    base, base_vel = observation.base_pos[::2], observation.base_vel[::2]

    trig = leg_trig(observation.joint_pos)
    com, com_rate = _center_of_mass(robot, trig, observation.joint_vel)
    lever = rotation @ com
    com_vel = base_vel + omega * jnp.stack([-lever[1], lever[0]]) + rotation @ com_rate
    x = jnp.concatenate([base + lever, jnp.arctan2(s, c)[None], com_vel, omega[None]])
    local = foot_position(robot, trig) + robot.hip_pos[:, ::2]
    state = PlanarState(
        x=x,
        rotation=rotation,
        base=base,
        base_vel=base_vel,
        omega=omega,
        trig=trig,
        feet=base[None] + local @ rotation.T,
    )
    return jax.lax.optimization_barrier(state)


def _center_of_mass(
    robot: RobotParams, trig: LegTrig, joint_vel: Float[Array, "4 3"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Whole-body centre of mass (x, z) in the trunk frame [m] and its rate there [m/s]."""
    m_hip, m_thigh, m_calf = robot.link_mass
    hip_com = robot.link_com[:, 0, ::2]
    x, z, x_rate, z_rate = moving_moments(robot, trig, joint_vel)
    hips = robot.hip_pos[:, ::2]
    fixed = robot.trunk_mass * robot.trunk_com[::2]
    fixed = fixed + (m_hip * (hips + hip_com) + (m_thigh + m_calf) * hips).sum(axis=0)
    moving = jnp.stack([x.sum(), z.sum()])
    rate = jnp.stack([x_rate.sum(), z_rate.sum()])
    total = robot.trunk_mass + 4.0 * (m_hip + m_thigh + m_calf)
    return (fixed + moving) / total, rate / total


def moving_moments(
    robot: RobotParams, trig: LegTrig, joint_vel: Float[Array, "4 3"]
) -> tuple[Float[Array, "4"], Float[Array, "4"], Float[Array, "4"], Float[Array, "4"]]:
    """Mass times place (x, z) of thigh and calf about the thigh joint [kg m], and its rates.

    In the leg's plane: the trunk's axes while the abduction joint is at zero.
    """
    _, m_thigh, m_calf = robot.link_mass
    thigh_com, calf_com = (robot.link_com[:, i, ::2] for i in (1, 2))
    l1 = robot.thigh_length
    # Moments of mass about the thigh joint, split by the angle that turns them: a link offset
    # (a, b) at angle q sits at (c a + s b, -s a + c b), its derivative by q is (z, -x) of that.
    a1 = m_thigh * thigh_com[:, 0]
    b1 = m_thigh * thigh_com[:, 1] - m_calf * l1
    a12, b12 = m_calf * calf_com[:, 0], m_calf * calf_com[:, 1]
    x1, z1 = trig.c1 * a1 + trig.s1 * b1, -trig.s1 * a1 + trig.c1 * b1
    x12, z12 = trig.c12 * a12 + trig.s12 * b12, -trig.s12 * a12 + trig.c12 * b12
    q1_rate = joint_vel[:, 1]
    q12_rate = q1_rate + joint_vel[:, 2]
    x_rate = z1 * q1_rate + z12 * q12_rate
    z_rate = -(x1 * q1_rate + x12 * q12_rate)
    return robot.knee * (x1 + x12), z1 + z12, robot.knee * x_rate, z_rate
