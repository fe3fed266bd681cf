"""What depends on the trunk's base: how the robot is seen, and what the legs do about a plan.

Everything else of the controller, the LMPC above all, sees the sagittal plane and is shared. The
choice is static, so that the planar robot pays nothing for the free one.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.legs import lateral, spatial, swing
from kjax.legs.kinematics import PlanarState, planar_state
from kjax.legs.stance import spatial_stance_torque, stance_torque
from kjax.types import Observation, RobotParams


class View(NamedTuple):
    """The robot as a base sees it.

    Attributes:
      planar: the sagittal plane, for the LMPC.
      feet: (4, d) foot centres: (x, z) in the world, or (4, 3) in the track frame [m].
      whole: the free robot, ``None`` on the planar base.
    """

    planar: PlanarState
    feet: Float[Array, "4 d"]
    whole: spatial.SpatialState | None


class LegCommand(NamedTuple):
    """What the legs shall do now.

    Attributes:
      stance: (4,) legs that press.
      force: (4, 2) with what force (x, z), body frame of the sagittal plane [N].
      swing: where the others are on their way.
      stance_time: (4,) length of their stance to come [s].
      velocity: forward velocity wanted [m/s].
    """

    stance: Bool[Array, "4"]
    force: Float[Array, "4 2"]
    swing: swing.SwingState
    stance_time: Float[Array, "4"]
    velocity: Float[Array, ""]


class Base(NamedTuple):
    """A base is a record of pure functions.

    Attributes:
      track: observation at ``init`` -> (2,) cosine and sine of the heading to keep, world; ``None``
        where the base keeps it.
      view: (robot, track, observation) -> view.
      torque: (robot, swing and lateral settings of the gait, view, command, observation) ->
        joint torques (4, 3), not yet within the robot's limits [N m].
    """

    track: Callable[[Observation], Any]
    view: Callable[[RobotParams, Any, Observation], View]
    torque: Callable[
        [
            RobotParams,
            swing.SwingParams,
            lateral.LateralParams,
            View,
            LegCommand,
            Observation,
        ],
        Float[Array, "4 3"],
    ]


def build_base(kind: Literal["planar", "free"]) -> Base:
    """The functions of a base."""
    if kind == "planar":
        return Base(track=_no_track, view=_planar_view, torque=_planar_torque)
    return Base(track=spatial.heading, view=_free_view, torque=_free_torque)


def _no_track(observation: Observation) -> None:
    return None


def _planar_view(robot: RobotParams, track: None, observation: Observation) -> View:
    body = planar_state(robot, observation)
    return View(planar=body, feet=body.feet, whole=None)


def _planar_torque(
    robot: RobotParams,
    settings: swing.SwingParams,
    sideways: lateral.LateralParams,
    view: View,
    command: LegCommand,
    observation: Observation,
) -> Float[Array, "4 3"]:
    """Thigh and calf press or swing; the abduction joints are held at zero."""
    body = view.planar
    along, _ = _next_step(robot, settings, body, command)
    target = jnp.stack([along, jnp.full_like(along, robot.foot_radius)], axis=-1)
    position, velocity = swing.foot_reference(settings, command.swing, target)
    angle, rate = swing.joint_reference(robot, body, position, velocity)
    follow = swing.swing_torque(settings, observation.joint_pos, observation.joint_vel, angle, rate)
    press = stance_torque(robot, body.trig, command.force)
    sagittal = jnp.where(command.stance[:, None], press, follow)
    abduction = (
        -settings.kp[0] * observation.joint_pos[:, 0] - settings.kd[0] * observation.joint_vel[:, 0]
    )
    return jnp.concatenate([abduction[:, None], sagittal], axis=-1)


def _free_view(robot: RobotParams, track: Float[Array, "2"], observation: Observation) -> View:
    body = spatial.spatial_state(robot, track, observation)
    return View(planar=body.planar, feet=body.feet, whole=body)


def _free_torque(
    robot: RobotParams,
    settings: swing.SwingParams,
    sideways: lateral.LateralParams,
    view: View,
    command: LegCommand,
    observation: Observation,
) -> Float[Array, "4 3"]:
    """All joints press with the regulated forces, or swing to footholds beside the hips."""
    body = view.whole
    assert body is not None  # _free_view made it
    along, remaining = _next_step(robot, settings, body.planar, command)
    target = swing.spatial_foothold(
        robot, body, along, remaining, command.stance_time, sideways.foothold_gain
    )
    position, velocity = swing.foot_reference(settings, command.swing, target)
    angle, rate = swing.spatial_joint_reference(robot, body, position, velocity)
    follow = swing.swing_torque(settings, observation.joint_pos, observation.joint_vel, angle, rate)
    force = lateral.stance_forces(sideways, robot, body, command.stance, command.force)
    press = spatial_stance_torque(robot, body.hip, body.planar.trig, force)
    # A sideways force has nothing to push against before the foot is down: keep the leg upright.
    loose = command.stance & ~observation.contact
    press = press.at[:, 0].set(jnp.where(loose, follow[:, 0], press[:, 0]))
    return jnp.where(command.stance[:, None], press, follow)


def _next_step(
    robot: RobotParams, settings: swing.SwingParams, body: PlanarState, command: LegCommand
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Place of each leg's next foothold in the sagittal plane [m], and the time to it [s]."""
    remaining = jnp.maximum(command.swing.duration - command.swing.elapsed, 0.0)
    along = swing.foothold(robot, settings, body, remaining, command.stance_time, command.velocity)
    return along, remaining
