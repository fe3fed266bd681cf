"""Three-dimensional leg kinematics, and the reduction of a free trunk to the sagittal plane.

Two frames turned about the vertical: the *track* frame is the world turned so that x is the
trunk's heading at ``init``; the *heading* frame is the track frame turned by the yaw psi since
then. Both keep the world's origin, so that z is the world's. The planar controller sees the robot
in the vertical plane of the heading frame, with the progress along the track for p_x.

The abduction joint turns the leg's plane about the trunk's x axis by q0; in that plane, offset to
the side by d, the leg is the planar one of ``legs.kinematics``:

    p_hip = Rx(q0) (X(q1, q2), d, Z(q1, q2))
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.legs import kinematics
from kjax.legs.kinematics import LegTrig, PlanarState
from kjax.types import Observation, RobotParams

# Part of the leg's length that the foot stays below the abduction axis at least, in its plane.
MIN_DEPTH = 0.1174


class HipTrig(NamedTuple):
    """Sine and cosine of the abduction angle, (4,) each."""

    s0: Float[Array, "4"]
    c0: Float[Array, "4"]


class SpatialState(NamedTuple):
    """The free robot as the controller sees it.

    Attributes:
      planar: its reduction to the vertical plane of the heading frame.
      heading: (2,) cosine and sine of the yaw psi since ``init`` [-].
      roll: () about the trunk's x axis, right side down positive [rad].
      yaw: () psi, to the left positive [rad].
      omega: (3,) angular velocity of the trunk, heading frame [rad/s].
      rotation: (3, 3) R_track_body.
      base: (3,) trunk origin, track frame [m].
      base_vel: (3,) its velocity, track frame [m/s].
      com: (3,) whole-body centre of mass, track frame [m].
      com_vel: (3,) its velocity, heading frame [m/s].
      hip: trigonometry of the abduction joints; ``planar.trig`` has the others'.
      feet: (4, 3) foot centres, track frame [m].
    """

    planar: PlanarState
    heading: Float[Array, "2"]
    roll: Float[Array, ""]
    yaw: Float[Array, ""]
    omega: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    base: Float[Array, "3"]
    base_vel: Float[Array, "3"]
    com: Float[Array, "3"]
    com_vel: Float[Array, "3"]
    hip: HipTrig
    feet: Float[Array, "4 3"]


class Trunk(NamedTuple):
    """How a free trunk lies and moves, track frame.

    Attributes:
      rotation: (3, 3) R_track_body.
      base: (3,) origin [m].
      base_vel: (3,) its velocity [m/s].
      omega: (3,) angular velocity [rad/s].
    """

    rotation: Float[Array, "3 3"]
    base: Float[Array, "3"]
    base_vel: Float[Array, "3"]
    omega: Float[Array, "3"]


def hip_trig(joint_pos: Float[Array, "4 3"]) -> HipTrig:
    """Trigonometry of the abduction joints, from joint angles (4, 3) [rad]."""
    trig = HipTrig(s0=jnp.sin(joint_pos[:, 0]), c0=jnp.cos(joint_pos[:, 0]))
    return jax.lax.optimization_barrier(trig)


def about_x(hip: HipTrig, vector: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
    """Rx(q0) times a vector of each leg: from the leg's plane to the trunk's axes."""
    x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
    return jnp.stack([x, hip.c0 * y - hip.s0 * z, hip.s0 * y + hip.c0 * z], axis=-1)


def foot_position(robot: RobotParams, hip: HipTrig, trig: LegTrig) -> Float[Array, "4 3"]:
    """Foot centres relative to the abduction axis (``hip_pos``), trunk axes [m]."""
    return about_x(hip, _in_leg_plane(robot, kinematics.foot_position(robot, trig)))


def foot_jacobian(robot: RobotParams, hip: HipTrig, trig: LegTrig) -> Float[Array, "4 3 3"]:
    """Derivative of ``foot_position`` by the joint angles, [leg, xyz, joint] [m/rad]."""
    _, y, z = jnp.moveaxis(foot_position(robot, hip, trig), -1, 0)
    planar = kinematics.foot_jacobian(robot, trig)
    zero = jnp.zeros_like(planar[:, 0])
    columns = [
        jnp.stack([jnp.zeros_like(y), -z, y], axis=-1),
        about_x(hip, jnp.stack([planar[:, 0, 0], zero[:, 0], planar[:, 1, 0]], axis=-1)),
        about_x(hip, jnp.stack([planar[:, 0, 1], zero[:, 1], planar[:, 1, 1]], axis=-1)),
    ]
    return jnp.stack(columns, axis=-1)


def inverse(
    robot: RobotParams, foot: Float[Array, "4 3"]
) -> tuple[Float[Array, "4 3"], HipTrig, LegTrig]:
    """Joint angles (4, 3) [rad] that put the foot at ``foot``, and their trigonometry.

    Of the two leg planes through a target it takes the one with the foot below the hip. A target
    out of reach is pulled into the nearest leg plane, then along the line from the hip.

    Args:
      robot: link lengths and abduction offsets.
      foot: (4, 3) targets relative to the abduction axis, trunk axes [m].
    """
    x, y, z = foot[:, 0], foot[:, 1], foot[:, 2]
    d = robot.abduction_offset
    least = _min_depth(robot)
    depth = -jnp.sqrt(jnp.maximum(y * y + z * z - d * d, least**2))
    # (y, z) = Rot(q0) (d, depth); depth is not zero, and a target on the axis means q0 = 0.
    sine, cosine = z * d - y * depth, y * d + z * depth
    on_axis = y * y + z * z < 1e-12
    angle = jnp.arctan2(jnp.where(on_axis, 0.0, sine), jnp.where(on_axis, 1.0, cosine))
    angle = jnp.clip(angle, *robot.joint_range[0])
    hip = HipTrig(s0=jnp.sin(angle), c0=jnp.cos(angle))
    below = jnp.minimum(-hip.s0 * y + hip.c0 * z, -least)
    thigh, calf, trig = kinematics.inverse(robot, jnp.stack([x, below], axis=-1))
    return jnp.stack([angle, thigh, calf], axis=-1), hip, trig


def joint_rates(
    robot: RobotParams, hip: HipTrig, trig: LegTrig, velocity: Float[Array, "4 3"]
) -> Float[Array, "4 3"]:
    """Joint rates [rad/s] that move the feet with a velocity [m/s], trunk axes.

    Directions in which a leg cannot move get no rate; the rates are not bounded otherwise.
    """
    v = about_x(HipTrig(s0=-hip.s0, c0=hip.c0), velocity)  # in the leg's plane
    depth = kinematics.foot_position(robot, trig)[:, 1]
    rate = -v[:, 1] / jnp.where(jnp.abs(depth) > 0.5 * _min_depth(robot), depth, jnp.inf)
    up = v[:, 2] - robot.abduction_offset * rate
    planar = kinematics.joint_rates(robot, trig, jnp.stack([v[:, 0], up], axis=-1))
    return jnp.concatenate([rate[:, None], planar], axis=-1)


def rotation_matrix(quat: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """R_world_body of a quaternion (w, x, y, z) of any length but zero."""
    w, x, y, z = quat / jnp.sqrt(jnp.sum(quat**2))
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def heading(observation: Observation) -> Float[Array, "2"]:
    """Cosine and sine of the trunk's yaw in the world: where its nose points."""
    return _heading(rotation_matrix(observation.base_quat))


def spatial_state(
    robot: RobotParams, track: Float[Array, "2"], observation: Observation
) -> SpatialState:
    """The free robot in the track frame, and its reduction to the sagittal plane.

    Args:
      robot: geometry and masses.
      track: (2,) cosine and sine of the trunk's yaw at ``init``, world [-].
      observation: of the robot.
    """
    rotation = rotate_back(track, rotation_matrix(observation.base_quat).T).T
    base = rotate_back(track, observation.base_pos)
    base_vel = rotate_back(track, observation.base_vel)
    omega = rotation @ observation.base_ang_vel

    trig = kinematics.leg_trig(observation.joint_pos)
    hip = hip_trig(observation.joint_pos)
    com, com_rate = _center_of_mass(robot, hip, trig, observation.joint_vel)
    lever = rotation @ com
    com_vel = base_vel + jnp.cross(omega, lever) + rotation @ com_rate
    com = base + lever
    local = foot_position(robot, hip, trig) + robot.hip_pos
    feet = base + local @ rotation.T

    return seen_from_trunk(Trunk(rotation, base, base_vel, omega), com, com_vel, hip, trig, feet)


def seen_from_trunk(
    trunk: Trunk,
    com: Float[Array, "3"],
    com_vel: Float[Array, "3"],
    hip: HipTrig,
    trig: LegTrig,
    feet: Float[Array, "4 3"],
) -> SpatialState:
    """The free robot of which everything is known in the track frame, as the controller sees it.

    Args:
      trunk: how it lies and moves.
      com: (3,) whole-body centre of mass [m].
      com_vel: (3,) its velocity [m/s].
      hip: trigonometry of the abduction joints.
      trig: of the other joints.
      feet: (4, 3) foot centres [m].
    """
    rotation, base, base_vel, omega = trunk
    forward = _heading(rotation)
    omega, com_vel = rotate_back(forward, omega), rotate_back(forward, com_vel)
    # The nose's horizontal part is never below zero: a pitch of -90 to 90 degrees.
    level = jnp.sqrt(rotation[0, 0] ** 2 + rotation[1, 0] ** 2)
    sine = rotation[2, 0]
    pitch_rate = -omega[1]  # a turn about +y takes the nose down

    def in_plane(points: Array) -> Array:
        """(x, z) in the heading frame about the CoM, with the CoM's progress along the track."""
        ahead = rotate_back(forward, points - com)[..., 0]
        return jnp.stack([com[0] + ahead, points[..., 2]], axis=-1)

    x = jnp.stack(
        [com[0], com[2], jnp.arctan2(sine, level), com_vel[0], com_vel[2], pitch_rate],
    )
    state = SpatialState(
        planar=PlanarState(
            x=x,
            rotation=jnp.stack([jnp.stack([level, -sine]), jnp.stack([sine, level])]),
            base=in_plane(base),
            base_vel=rotate_back(forward, base_vel)[::2],
            omega=pitch_rate,
            trig=trig,
            feet=in_plane(feet),
        ),
        heading=forward,
        roll=jnp.arctan2(rotation[2, 1], rotation[2, 2]),
        yaw=jnp.arctan2(forward[1], forward[0]),
        omega=omega,
        rotation=rotation,
        base=base,
        base_vel=base_vel,
        com=com,
        com_vel=com_vel,
        hip=hip,
        feet=feet,
    )
    return jax.lax.optimization_barrier(state)


def rotate(heading: Float[Array, "2"], vectors: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Vectors of the heading frame in the track frame: Rz(psi) times each of them."""
    c, s = heading
    x, y, z = jnp.moveaxis(vectors, -1, 0)
    return jnp.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def rotate_back(heading: Float[Array, "2"], vectors: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Vectors of the track frame in the heading frame, or of the world in the track frame."""
    c, s = heading
    return rotate(jnp.stack([c, -s]), vectors)


def _heading(rotation: Float[Array, "3 3"]) -> Float[Array, "2"]:
    """Unit vector of the nose's horizontal part; straight ahead where the nose is vertical."""
    nose = rotation[:2, 0]
    square = jnp.sum(nose**2)
    vertical = square < 1e-12  # not for NaN, which shall stay
    ahead = jnp.stack([jnp.ones_like(square), jnp.zeros_like(square)])
    return jnp.where(vertical, ahead, nose / jnp.sqrt(jnp.where(vertical, 1.0, square)))


def _min_depth(robot: RobotParams) -> Array:
    return MIN_DEPTH * (robot.thigh_length + robot.calf_length)


def _in_leg_plane(robot: RobotParams, foot: Float[Array, "4 2"]) -> Float[Array, "4 3"]:
    return jnp.stack([foot[:, 0], robot.abduction_offset, foot[:, 1]], axis=-1)


def _center_of_mass(
    robot: RobotParams, hip: HipTrig, trig: LegTrig, joint_vel: Float[Array, "4 3"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Whole-body centre of mass in the trunk frame [m] and its rate there [m/s]."""
    m_hip, m_thigh, m_calf = robot.link_mass
    hip_com, thigh_com, calf_com = (robot.link_com[:, i] for i in range(3))
    # Moments of mass about the hip in the leg's plane, Rx(q0) (fixed + moving).
    x, z, x_rate, z_rate = kinematics.moving_moments(robot, trig, joint_vel)
    side = (m_thigh + m_calf) * robot.abduction_offset
    side = side + m_thigh * thigh_com[:, 1] + m_calf * calf_com[:, 1]
    moment = m_hip * hip_com + jnp.stack([x, side, z], axis=-1)
    rate = jnp.stack([x_rate, jnp.zeros_like(x_rate), z_rate], axis=-1)
    # The abduction turns the plane about its own x axis: d/dt Rx(q0) a = Rx(q0) (q0' x_axis x a).
    turning = joint_vel[:, 0, None] * jnp.stack(
        [jnp.zeros_like(x), -moment[:, 2], moment[:, 1]], axis=-1
    )
    legs = about_x(hip, moment).sum(axis=0)
    hips = (m_hip + m_thigh + m_calf) * robot.hip_pos.sum(axis=0)
    total = robot.trunk_mass + 4.0 * (m_hip + m_thigh + m_calf)
    com = (robot.trunk_mass * robot.trunk_com + hips + legs) / total
    return com, about_x(hip, rate + turning).sum(axis=0) / total
