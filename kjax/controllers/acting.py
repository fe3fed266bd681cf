"""Between two plans: swing feet follow their paths, stance feet press the planned forces.

1. Swing paths: where the feet in the air shall be.
2. Contact: what they have hit meanwhile.
3. Torques: those of the last valid sample are held for a while, then joints are damped.
4. The local frame of the state moves on with the trunk.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.controllers.observation import MAX_JOINT_RATE, cast, is_valid, or_neutral
from kjax.controllers.params import ControllerParams, Tables
from kjax.controllers.state import ControllerState
from kjax.legs import contact, lateral, swing
from kjax.legs.base import Base, Footing, JointTargets, LegCommand, View
from kjax.legs.ground import moved, rise
from kjax.types import JointCommand, Observation

Act = Callable[[Tables, ControllerState, Observation], tuple[ControllerState, JointCommand]]


class _Sample(NamedTuple):
    """A sample, and whether it is any good.

    Attributes:
      seen: the observation, a neutral one where it is no good.
      joint_vel: (4, 3) joint rates, 0 where they cannot be right [rad/s].
      valid: whether it is good.
    """

    seen: Observation
    joint_vel: Float[Array, "4 3"]
    valid: Bool[Array, ""]


class _LegSettings(NamedTuple):
    """Settings of the gait in use."""

    swing: swing.SwingParams
    lateral: lateral.LateralParams


class _Feet(NamedTuple):
    """Where the feet in the air shall be, and what has been felt.

    Attributes:
      swings: their swings.
      position: (4, 2 or 3) [m].
      velocity: (4, 2 or 3) [m/s].
      contact: state of the contact flags.
    """

    swings: swing.SwingState
    position: Array
    velocity: Array
    contact: contact.ContactState


def build_act(base: Base, act_dt: float) -> Act:
    """``Controller.act`` for a base and the time between two calls [s]."""

    def act(
        tables: Tables, state: ControllerState, observation: Observation
    ) -> tuple[ControllerState, JointCommand]:
        params = tables.params
        sample = _read(observation, params.position_slack.dtype)
        view = base.view(params.robot, facing(state.track), sample.seen)
        own = swing.for_gait(params.swing, state.clock.gait)
        settings = _LegSettings(
            swing.steady_gains(own, params.robot, act_dt),
            lateral.for_gait(params.lateral, state.clock.gait),
        )
        feet = _foot_targets(base, params, settings, state, view, sample, act_dt)  # steps 1, 2
        legs = LegCommand(
            state.stance & ~feet.swings.reaching, state.force, feet.position, feet.velocity
        )
        targets = base.joints(params.robot, *settings, view, legs, sample.seen)
        blind_time = jnp.where(sample.valid, 0.0, state.blind_time + act_dt)
        held = blind_time < params.hold_time + 0.5 * act_dt
        command = _joint_command(
            params, settings.swing, targets, sample, state.torque, held
        )  # step 3

        # Step 4: the local frame moves on with the trunk.
        valid = sample.valid
        base_vel = jnp.where(valid, view.base_vel, state.base_vel)
        motion = act_dt * base_vel
        ground, slope = ground_after(state, motion)
        next_state = state._replace(
            swing=swing.carry_along(feet.swings, motion),
            ground=ground,
            slope=slope,
            feet=jnp.where(valid, view.feet, state.feet) - motion,
            base_vel=base_vel,
            torque=command.torque,
            blind_time=blind_time,
            contact=jax.tree.map(lambda a, b: jnp.where(valid, a, b), feet.contact, state.contact),
        )
        return next_state, command

    return act


def velocity_wanted(state: ControllerState) -> Float[Array, "3"]:
    """References of v_x, v_y and yaw rate, integral action included."""
    corrected = 1 if state.slope is None else 2  # the planar controller's second one is of pitch
    return state.velocity.at[:corrected].add(state.correction[:corrected])


def _ground_at(state: ControllerState, feet: Float[Array, "4 d"]) -> Array:
    """Height of the ground below some feet, or of all of it where it is level [m]."""
    if state.slope is None:
        return state.ground
    return state.ground + rise(state.slope.slope, feet[:, :2])


def ground_after(state: ControllerState, motion: Float[Array, "d"]) -> tuple[Array, Any]:
    """Height and slope of the ground below an origin that has moved on."""
    height = state.ground - motion[-1]
    if state.slope is None:
        return height, None
    return height + rise(state.slope.slope, motion[:2]), moved(state.slope, motion)


def facing(track: Array | None) -> Array | None:
    """The heading to keep, straight ahead where it is not known yet."""
    if track is None:
        return None
    return jnp.where((track == 0.0).all(), jnp.array([1.0, 0.0], track.dtype), track)


def _read(observation: Observation, dtype: jnp.dtype) -> _Sample:
    observation = cast(observation, dtype)
    valid = is_valid(observation)
    known = jnp.abs(observation.joint_vel) <= MAX_JOINT_RATE
    joint_vel = jnp.where(known, observation.joint_vel, 0.0)
    return _Sample(or_neutral(observation, valid), joint_vel, valid)


def _foot_targets(
    base: Base,
    params: ControllerParams,
    settings: _LegSettings,
    state: ControllerState,
    view: View,
    sample: _Sample,
    act_dt: float,
) -> _Feet:
    """Steps 1 and 2: the paths of the swing feet, held where a foot has hit something."""
    robot = params.robot

    # Step 1: where the feet in the air shall be.
    swings = swing.advance(state.swing, ~state.stance, act_dt)
    footing = Footing(
        remaining=jnp.maximum(swings.duration - swings.elapsed, 0.0),
        stance_time=params.schedule.stance_time[state.clock.gait, state.clock.phase],
        velocity=velocity_wanted(state),
        ground=state.ground,
        slope=None if state.slope is None else state.slope.slope,
    )
    target = base.foothold(robot, *settings, view, footing)
    foot, foot_vel = swing.foot_path(settings.swing, swings, target)

    # Step 2: what they have hit meanwhile.
    flags = contact.read_flags(
        state.contact,
        sample.seen.contact & sample.valid,
        contact.LegPhase(state.stance, state.clock.elapsed, swings.elapsed),
        contact.FootMotion(view.feet, view.feet_vel),
        contact.FootMotion(foot, foot_vel),
        _ground_at(state, view.feet) + robot.foot_radius,
        act_dt,
    )
    flags = flags._replace(flicker=flags.flicker & sample.valid)
    swings = swing.hold_feet(settings.swing, swings, flags, view.feet, act_dt)
    foot, foot_vel = swing.held_or_on_path(settings.swing, swings, foot, foot_vel)
    return _Feet(swings, foot, foot_vel, flags.state)


def _joint_command(
    params: ControllerParams,
    settings: swing.SwingParams,
    targets: JointTargets,
    sample: _Sample,
    last_torque: Float[Array, "4 3"],
    held: Bool[Array, ""],
) -> JointCommand:
    """Step 3: torques within the limits, and joint loops that give them for this sample.

    Args:
      params: of the controller.
      settings: of the swing legs, of the gait in use.
      targets: of a valid sample.
      sample: the sample.
      last_torque: (4, 3) the last command [N m].
      held: whether it still holds without a valid sample; joints are damped after that.
    """
    observation, joint_vel, valid = sample
    robot = params.robot
    without = jnp.where(held, last_torque, -params.blind_damping * joint_vel)
    torque = jnp.where(valid, targets.torque, without)
    torque = jnp.clip(torque, -robot.torque_limit, robot.torque_limit)
    tracks, damped = targets.tracks & valid, ~valid & ~held
    q = jnp.where(tracks, targets.q, observation.joint_pos)
    dq = jnp.where(tracks, targets.dq, jnp.where(damped, 0.0, joint_vel))
    kp = jnp.where(tracks, settings.kp, 0.0)
    kd = jnp.where(tracks, settings.kd, jnp.where(damped, params.blind_damping, 0.0))
    pd = kp * (q - observation.joint_pos) + kd * (dq - joint_vel)
    return JointCommand(torque=torque, q=q, dq=dq, kp=kp, kd=kd, feedforward=torque - pd)
