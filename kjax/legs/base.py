"""What depends on the trunk's base: how the robot is seen, and what the legs do about a plan.

Everything else of the controller, the LMPC above all, sees the sagittal plane and is shared. The
choice is static, so that the planar robot pays nothing for the free one.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.legs import lateral, spatial, swing
from kjax.legs.footholds import Arrival, footholds, turned
from kjax.legs.ground import rise
from kjax.legs.kinematics import PlanarState, foot_jacobian, planar_state
from kjax.legs.stance import spatial_stance_torque, stance_torque
from kjax.types import Observation, RobotParams


class View(NamedTuple):
    """The robot as a base sees it, in the frame that its observation's position is given in.

    Attributes:
      planar: the sagittal plane, for the LMPC.
      feet: (4, d) foot centres: (x, z), or (4, 3) with the axes of the track frame [m].
      feet_vel: (4, d) their velocity, the same axes [m/s].
      base_vel: (d,) velocity of the trunk, the same axes [m/s].
      whole: the free robot, ``None`` on the planar base.
    """

    planar: PlanarState
    feet: Float[Array, "4 d"]
    feet_vel: Float[Array, "4 d"]
    base_vel: Float[Array, "d"]
    whole: spatial.SpatialState | None


class LegCommand(NamedTuple):
    """What the legs shall do now.

    Attributes:
      stance: (4,) legs that press.
      force: (4, 3) with what force on the robot, axes of the view [N].
      foot: (4, d) where the feet of the others shall be [m].
      foot_vel: (4, d) and how fast [m/s].
    """

    stance: Bool[Array, "4"]
    force: Float[Array, "4 3"]
    foot: Float[Array, "4 d"]
    foot_vel: Float[Array, "4 d"]


class JointTargets(NamedTuple):
    """What the legs ask of the joints, each (leg, joint).

    Attributes:
      torque: not yet within the robot's limits [N m].
      q: angle that a leg in the air tracks [rad].
      dq: and its rate [rad/s].
      tracks: joints that track them by PD control; the others press.
    """

    torque: Float[Array, "4 3"]
    q: Float[Array, "4 3"]
    dq: Float[Array, "4 3"]
    tracks: Bool[Array, "4 3"]


class Footing(NamedTuple):
    """What footholds follow from.

    Attributes:
      remaining: (4,) time to touchdown [s].
      stance_time: (4,) length of the stance to come [s].
      velocity: (3,) v_x, v_y and yaw rate wanted [m/s, m/s, rad/s].
      ground: height of the ground, frame of the view; where it slopes, below the origin [m].
      slope: (2,) its rise along x and y; ``None`` where it counts as level [-].
    """

    remaining: Float[Array, "4"]
    stance_time: Float[Array, "4"]
    velocity: Float[Array, "3"]
    ground: Float[Array, ""]
    slope: Float[Array, "2"] | None


class Base(NamedTuple):
    """A base is a record of pure functions.

    Attributes:
      track: observation at ``init`` -> (2,) cosine and sine of the heading to keep, world; ``None``
        where the base keeps it.
      view: (robot, track, observation) -> view.
      foothold: (robot, swing and lateral settings of the gait, view, footing) -> next footholds,
        foot centres (4, d), frame of the view [m].
      joints: (robot, swing and lateral settings of the gait, view, command, observation) -> what
        the joints do about it.
    """

    track: Callable[[Observation], Any]
    view: Callable[[RobotParams, Any, Observation], View]
    foothold: Callable[
        [RobotParams, swing.SwingParams, lateral.LateralParams, View, Footing],
        Float[Array, "4 d"],
    ]
    joints: Callable[
        [
            RobotParams,
            swing.SwingParams,
            lateral.LateralParams,
            View,
            LegCommand,
            Observation,
        ],
        JointTargets,
    ]


def build_base(kind: Literal["planar", "free"], *, spatial_forces: bool = False) -> Base:
    """The functions of a base.

    Args:
      kind: of base.
      spatial_forces: whether forces are planned in three dimensions, so that no regulator acts
        besides and footholds turn with the trunk.
    """
    if spatial_forces:
        return Base(
            track=spatial.heading,
            view=_free_view,
            foothold=_turning_foothold,
            joints=_spatial_joints,
        )
    if kind == "planar":
        return Base(
            track=_no_track, view=_planar_view, foothold=planar_foothold, joints=_planar_joints
        )
    return Base(
        track=spatial.heading, view=_free_view, foothold=_free_foothold, joints=_free_joints
    )


def to_local(view: View, vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Vectors of the heading frame in the axes of the view: the same on the planar base."""
    return vectors if view.whole is None else spatial.rotate(view.whole.heading, vectors)


def _no_track(observation: Observation) -> None:
    return None


def _planar_view(robot: RobotParams, track: None, observation: Observation) -> View:
    body = planar_state(robot, observation)
    lever = body.feet - body.base[None]
    turning = body.omega * jnp.stack([-lever[:, 1], lever[:, 0]], axis=-1)
    inside = jnp.einsum("lij,lj->li", foot_jacobian(robot, body.trig), observation.joint_vel[:, 1:])
    feet_vel = body.base_vel[None] + turning + inside @ body.rotation.T
    return View(planar=body, feet=body.feet, feet_vel=feet_vel, base_vel=body.base_vel, whole=None)


def planar_foothold(
    robot: RobotParams,
    settings: swing.SwingParams,
    sideways: lateral.LateralParams,
    view: View,
    footing: Footing,
) -> Float[Array, "4 2"]:
    """Next footholds (x, z) in the sagittal plane, foot centres [m]."""
    along = swing.foothold(
        robot, settings, view.planar, footing.remaining, footing.stance_time, footing.velocity[0]
    )
    return jnp.stack([along, jnp.full_like(along, footing.ground + robot.foot_radius)], axis=-1)


def _planar_joints(
    robot: RobotParams,
    settings: swing.SwingParams,
    sideways: lateral.LateralParams,
    view: View,
    command: LegCommand,
    observation: Observation,
) -> JointTargets:
    """Thigh and calf press or swing; the abduction joints are held at zero."""
    body = view.planar
    angle, rate = swing.joint_reference(robot, body, command.foot, command.foot_vel)
    follow = swing.swing_torque(settings, observation.joint_pos, observation.joint_vel, angle, rate)
    press = stance_torque(robot, body.trig, command.force[:, ::2] @ body.rotation)
    sagittal = jnp.where(command.stance[:, None], press, follow)
    abduction = (
        -settings.kp[0] * observation.joint_pos[:, 0] - settings.kd[0] * observation.joint_vel[:, 0]
    )
    zero = jnp.zeros_like(abduction)[:, None]
    in_air = ~command.stance[:, None]
    return JointTargets(
        torque=jnp.concatenate([abduction[:, None], sagittal], axis=-1),
        q=jnp.concatenate([zero, angle], axis=-1),
        dq=jnp.concatenate([zero, rate], axis=-1),
        tracks=jnp.concatenate([jnp.ones_like(in_air), in_air, in_air], axis=-1),
    )


def _free_view(robot: RobotParams, track: Float[Array, "2"], observation: Observation) -> View:
    body = spatial.spatial_state(robot, track, observation)
    omega = spatial.rotate(body.heading, body.omega)
    jacobian = spatial.foot_jacobian(robot, body.hip, body.planar.trig)
    inside = jnp.einsum("lij,lj->li", jacobian, observation.joint_vel)
    turning = jnp.cross(omega[None], body.feet - body.base[None])
    feet_vel = body.base_vel[None] + turning + inside @ body.rotation.T
    return View(
        planar=body.planar, feet=body.feet, feet_vel=feet_vel, base_vel=body.base_vel, whole=body
    )


def _free_foothold(
    robot: RobotParams,
    settings: swing.SwingParams,
    sideways: lateral.LateralParams,
    view: View,
    footing: Footing,
) -> Float[Array, "4 3"]:
    """Next footholds beside the hips, foot centres [m]."""
    body = view.whole
    assert body is not None  # _free_view made it
    along = swing.foothold(
        robot, settings, body.planar, footing.remaining, footing.stance_time, footing.velocity[0]
    )
    return swing.spatial_foothold(
        robot,
        body,
        along,
        footing.remaining,
        footing.stance_time,
        sideways.foothold_gain,
        footing.ground,
    )


def _turning_foothold(
    robot: RobotParams,
    settings: swing.SwingParams,
    sideways: lateral.LateralParams,
    view: View,
    footing: Footing,
) -> Float[Array, "4 3"]:
    """Next footholds beside the hips of a trunk that turns, foot centres [m]."""
    body = view.whole
    assert body is not None  # _free_view made it
    wait, yaw_rate = footing.remaining, footing.velocity[2]
    assert footing.slope is not None  # the spatial controller's state has it
    ahead = yaw_rate * wait  # yaw until then
    angle = body.yaw + ahead
    # The way turns with the trunk.
    now = spatial.rotate(body.heading, body.com_vel)[:2]
    velocity = turned(ahead, now)
    below = footing.ground + rise(footing.slope, (body.com - body.base)[:2])
    place = footholds(
        robot,
        settings.offset,
        Arrival(
            place=body.com[None, :2] + wait[:, None] * turned(0.5 * ahead, now),
            velocity=velocity,
            error=velocity - turned(angle, footing.velocity[:2]),
            heading=jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1),
            height=body.com[2] - below,
        ),
        body.rotation.T @ (body.com - body.base),
        footing.stance_time,
        jnp.stack([settings.velocity_gain, sideways.foothold_gain]),
        yaw_rate,
    )
    height = footing.ground + rise(footing.slope, place) + robot.foot_radius
    return jnp.concatenate([place, height[:, None]], axis=1)


def _spatial_joints(
    robot: RobotParams,
    settings: swing.SwingParams,
    sideways: lateral.LateralParams,
    view: View,
    command: LegCommand,
    observation: Observation,
) -> JointTargets:
    """All joints press with the planned forces, or follow the path of a swing."""
    body = view.whole
    assert body is not None  # _free_view made it
    press = spatial_stance_torque(robot, body.hip, body.planar.trig, command.force @ body.rotation)
    return _press_or_follow(robot, settings, body, command, observation, press)


def _free_joints(
    robot: RobotParams,
    settings: swing.SwingParams,
    sideways: lateral.LateralParams,
    view: View,
    command: LegCommand,
    observation: Observation,
) -> JointTargets:
    """All joints press with the regulated forces, or follow the path of a swing."""
    body = view.whole
    assert body is not None  # _free_view made it
    force = lateral.stance_forces(sideways, robot, body, command.stance, command.force)
    press = spatial_stance_torque(robot, body.hip, body.planar.trig, force)
    # The regulator has changed the plan's forces: the limits of its rows hold for these as well.
    load = jnp.max(jnp.abs(press) / robot.torque_limit, axis=1, keepdims=True)
    press = press * jnp.minimum(1.0, sideways.torque_fraction / jnp.maximum(load, 1e-6))
    return _press_or_follow(robot, settings, body, command, observation, press)


def _press_or_follow(
    robot: RobotParams,
    settings: swing.SwingParams,
    body: spatial.SpatialState,
    command: LegCommand,
    observation: Observation,
    press: Float[Array, "4 3"],
) -> JointTargets:
    """Torques ``press`` [N m] of the legs that stand, the path of a swing for the others."""
    angle, rate = swing.spatial_joint_reference(robot, body, command.foot, command.foot_vel)
    follow = swing.swing_torque(settings, observation.joint_pos, observation.joint_vel, angle, rate)
    # A sideways force has nothing to push against before the foot is down: keep the leg upright.
    loose = command.stance & ~observation.contact
    tracks = jnp.broadcast_to(~command.stance[:, None], press.shape)
    tracks = tracks.at[:, 0].set(~command.stance | loose)
    return JointTargets(jnp.where(tracks, follow, press), angle, rate, tracks)
