"""Swing legs: Raibert footholds, the foot's path, and the joint PD that follows it."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax.legs import spatial
from kjax.legs.contact import Flags
from kjax.legs.kinematics import PlanarState, inverse, joint_rates
from kjax.types import RobotParams

LEAVING = 0.1  # part of a swing in which a foot may still touch what it stood on
RAISED_TIME = 1.0  # s, in which the further height of swings fades after a foot has hit something
MAX_JOINT_RATE = 20.0  # rad/s; bounds the reference near singular legs
STEADY = 1.0  # largest damping of a leg in the air times the time between torques, over inertia


class SwingParams(NamedTuple):
    """Swing settings; data, so they may differ between the robots of a batch.

    Attributes:
      apex: height above the higher of lift-off and target; (G,) by gait in the controller's
        parameters, one number where it is used [m].
      velocity_gain: foothold gain on the velocity error, likewise by gait [s].
      offset: (4,) foothold ahead of the hip when standing still, likewise by gait [m].
      horizontal_fraction: part of the swing after which the foot is above its foothold [-].
      hold_after: part of the swing after which a contact means an obstacle [-].
      reach_speed: at which a foot feels for the ground when a change of gait has cut its swing
        short; 0: its leg presses at once [m/s].
      lift: further apex after a foot has hit something on its way up; not read where the state's
        ``raised`` is ``None`` [m].
      kp: joint stiffness of (abduction, thigh, calf) [N m/rad].
      kd: joint damping of the same [N m s/rad].
    """

    apex: Float[Array, "*gait"]
    velocity_gain: Float[Array, "*gait"]
    offset: Float[Array, "*gait 4"]
    horizontal_fraction: Float[Array, ""]
    hold_after: Float[Array, ""]
    reach_speed: Float[Array, ""]
    lift: Float[Array, ""]
    kp: Float[Array, "3"]
    kd: Float[Array, "3"]


def for_gait(params: SwingParams, gait: Int[Array, ""]) -> SwingParams:
    """Settings with those that depend on the gait picked for ``gait``."""
    return params._replace(
        apex=params.apex[gait],
        velocity_gain=params.velocity_gain[gait],
        offset=params.offset[gait],
    )


class SwingState(NamedTuple):
    """What a swing remembers.

    Attributes:
      lift_off: (4, d) where the foot left the ground [m]; d = 2 (x, z) on the planar base, 3 on the
        free one. A point of the world, in the frame of the caller: ``carry_along`` where that frame
        moves with the trunk.
      elapsed: (4,) time since then [s].
      duration: (4,) planned length of the swing [s].
      held: (4,) whether an early contact stopped the foot.
      held_at: (4, d) where it did, or where a reaching foot shall be, likewise [m].
      reaching: (4,) whether the leg is due to stand but has not found the ground yet.
      raised: further apex of all swings since a foot has hit something, fading; ``None`` where
        swings do not lift over [m].
    """

    lift_off: Float[Array, "4 d"]
    elapsed: Float[Array, "4"]
    duration: Float[Array, "4"]
    held: Bool[Array, "4"]
    held_at: Float[Array, "4 d"]
    reaching: Bool[Array, "4"]
    raised: Float[Array, ""] | None


def initial_swing(feet: Float[Array, "4 d"], *, lifts: bool = False) -> SwingState:
    """State before the first swing.

    Args:
      feet: (4, d) [m].
      lifts: whether a foot that hits something on its way up lifts over it.
    """
    zeros = jnp.zeros((4,), feet.dtype)
    none = jnp.zeros((4,), bool)
    return SwingState(
        lift_off=feet,
        elapsed=zeros,
        duration=zeros + 1.0,
        held=none,
        held_at=feet,
        reaching=none,
        raised=jnp.zeros((), feet.dtype) if lifts else None,
    )


def begin_swings(
    state: SwingState,
    lifting: Bool[Array, "4"],
    feet: Float[Array, "4 d"],
    duration: Float[Array, "4"],
) -> SwingState:
    """State with new swings of ``duration`` [s] for the legs that are ``lifting`` off now."""
    return state._replace(
        lift_off=jnp.where(lifting[:, None], feet, state.lift_off),
        elapsed=jnp.where(lifting, 0.0, state.elapsed),
        duration=jnp.where(lifting, duration, state.duration),
        held=state.held & ~lifting,
        reaching=state.reaching & ~lifting,
    )


def end_swings(
    params: SwingParams,
    state: SwingState,
    stance: Bool[Array, "4"],
    cut: Bool[Array, "4"],
    contact: Bool[Array, "4"],
    feet: Float[Array, "4 d"],
) -> SwingState:
    """State with the swings of ``stance`` legs over.

    Legs whose swing a change of gait has ``cut`` short are high above the ground. A force has
    nothing to push against there, and would fling the foot along its direction; so the foot sinks
    straight down until it touches.
    """
    above = cut & ~contact & (params.reach_speed > 0)
    return state._replace(
        held=state.held & ~stance,
        held_at=jnp.where(above[:, None], feet, state.held_at),
        reaching=(state.reaching | above) & stance,
    )


def carry_along(state: SwingState, motion: Float[Array, "d"]) -> SwingState:
    """State in a frame whose origin has moved on by ``motion`` (d,) [m]; the points stay."""
    return state._replace(lift_off=state.lift_off - motion, held_at=state.held_at - motion)


def advance(state: SwingState, swinging: Bool[Array, "4"], dt: float) -> SwingState:
    """State with the clocks of the ``swinging`` legs ``dt`` [s] on."""
    return state._replace(elapsed=jnp.where(swinging, state.elapsed + dt, state.elapsed))


def hold_feet(
    params: SwingParams,
    state: SwingState,
    flags: Flags,
    feet: Float[Array, "4 d"],
    dt: float,
) -> SwingState:
    """State with feet that hit something late in their swing held where they are.

    A foot whose contact was over in a moment goes on. A reaching foot sinks, and has arrived with
    its first contact.

    Args:
      params: swing settings.
      state: of the swings.
      flags: what the contact flags tell.
      feet: (4, d) where the feet are [m].
      dt: time step [s].
    """
    if state.raised is not None:
        state = _lift_over(params, state, flags, feet, dt)
    late = state.elapsed > params.hold_after * state.duration
    caught = flags.blocked & late & ~state.held
    reaching = state.reaching & ~flags.contact
    sink = jnp.where(reaching, params.reach_speed * dt, 0.0)
    return state._replace(
        held=(state.held & ~flags.flicker) | caught,
        held_at=jnp.where(caught[:, None], feet, state.held_at.at[:, -1].add(-sink)),
        reaching=reaching,
    )


def _lift_over(
    params: SwingParams, state: SwingState, flags: Flags, feet: Float[Array, "4 d"], dt: float
) -> SwingState:
    """State after feet have hit something on their way up.

    Such a foot goes on from where it is, as if it lifted off there: up first. Where one foot met
    something others will, so all swings are higher for a while.
    """
    assert state.raised is not None
    early = state.elapsed <= params.hold_after * state.duration
    left_ground = state.elapsed > LEAVING * state.duration
    stumbled = flags.blocked & early & left_ground & ~state.held
    raised = jnp.where(stumbled.any(), params.lift, state.raised * (1.0 - dt / RAISED_TIME))
    state = begin_swings(state, stumbled, feet, state.duration - state.elapsed)
    return state._replace(raised=raised)


def foothold(
    robot: RobotParams,
    params: SwingParams,
    body: PlanarState,
    remaining: Float[Array, "4"],
    stance_time: Float[Array, "4"],
    velocity: Float[Array, ""],
) -> Float[Array, "4"]:
    """World x of each leg's next foothold [m]: Raibert's law.

    The hip's place at touchdown, half a stance further, and a correction of the velocity error.

    Args:
      robot: hip positions.
      params: swing settings.
      body: sagittal state.
      remaining: (4,) time to touchdown [s].
      stance_time: (4,) length of the stance to come [s].
      velocity: forward velocity wanted [m/s].
    """
    v = body.x[3]
    hips = body.base[0] + robot.hip_pos[:, ::2] @ body.rotation[0]
    return (
        hips
        + params.offset
        + v * (remaining + 0.5 * stance_time)
        + params.velocity_gain * (v - velocity)
    )


def spatial_foothold(
    robot: RobotParams,
    body: spatial.SpatialState,
    along: Float[Array, "4"],
    remaining: Float[Array, "4"],
    stance_time: Float[Array, "4"],
    gain: Float[Array, ""],
    ground: Float[Array, ""] | float = 0.0,
) -> Float[Array, "4 3"]:
    """Foot centres (4, 3) of the next footholds, track frame [m].

    Sideways, Raibert's law as along the way, with a wanted velocity of zero: from below the thigh
    joint's place when the leg hangs straight.

    Args:
      robot: hip positions and abduction offsets.
      body: the free robot.
      along: (4,) what ``foothold`` says in the sagittal plane [m].
      remaining: (4,) time to touchdown [s].
      stance_time: (4,) length of the stance to come [s].
      gain: foothold per sideways velocity, beyond Raibert's law [s].
      ground: height of the ground [m].
    """
    lever = robot.hip_pos @ body.rotation.T + (body.base - body.com)
    hips = spatial.rotate_back(body.heading, lever)
    across = (
        hips[:, 1]
        + robot.abduction_offset
        + body.com_vel[1] * (remaining + 0.5 * stance_time + gain)
    )
    flat = jnp.stack([along - body.planar.x[0], across, jnp.zeros_like(along)], axis=-1)
    place = spatial.rotate(body.heading, flat) + body.com
    return place.at[:, 2].set(ground + robot.foot_radius)


def foot_path(
    params: SwingParams, state: SwingState, target: Float[Array, "4 d"]
) -> tuple[Float[Array, "4 d"], Float[Array, "4 d"]]:
    """Position [m] and velocity [m/s] (4, d) on the way to ``target``, frame of the state; z last.

    Horizontally a smoothstep that ends at ``horizontal_fraction``; vertically one up to the apex
    in the first half and one down to the target in the second.
    """
    duration = state.duration
    phase = jnp.clip(state.elapsed / duration, 0.0, 1.0)

    across = jnp.minimum(phase / params.horizontal_fraction, 1.0)
    shift, shift_rate = _smoothstep(across)
    shift_rate = shift_rate / (params.horizontal_fraction * duration)
    shift, shift_rate = shift[:, None], shift_rate[:, None]
    along = state.lift_off[:, :-1] + (target[:, :-1] - state.lift_off[:, :-1]) * shift
    along_rate = (target[:, :-1] - state.lift_off[:, :-1]) * shift_rate

    apex = params.apex if state.raised is None else params.apex + state.raised
    top = jnp.maximum(state.lift_off[:, -1], target[:, -1]) + apex
    rising = phase < 0.5
    low = jnp.where(rising, state.lift_off[:, -1], top)
    high = jnp.where(rising, top, target[:, -1])
    climb, climb_rate = _smoothstep(jnp.where(rising, 2.0 * phase, 2.0 * phase - 1.0))
    z = low + (high - low) * climb
    v_z = (high - low) * climb_rate * 2.0 / duration

    position = jnp.concatenate([along, z[:, None]], axis=-1)
    velocity = jnp.concatenate([along_rate, v_z[:, None]], axis=-1)
    return position, velocity


def held_or_on_path(
    params: SwingParams,
    state: SwingState,
    position: Float[Array, "4 d"],
    velocity: Float[Array, "4 d"],
) -> tuple[Float[Array, "4 d"], Float[Array, "4 d"]]:
    """The path's position and velocity, but for feet that are held or sink [m, m/s]."""
    still = (state.held | state.reaching)[:, None]
    sink = (
        jnp.zeros_like(velocity).at[:, -1].set(jnp.where(state.reaching, -params.reach_speed, 0.0))
    )
    return jnp.where(still, state.held_at, position), jnp.where(still, sink, velocity)


def _smoothstep(s: Array) -> tuple[Array, Array]:
    """3 s^2 - 2 s^3 and its derivative, for s in [0, 1]."""
    return s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s)


def joint_reference(
    robot: RobotParams,
    body: PlanarState,
    position: Float[Array, "4 2"],
    velocity: Float[Array, "4 2"],
) -> tuple[Float[Array, "4 2"], Float[Array, "4 2"]]:
    """Thigh and calf angle [rad] and rate [rad/s] (4, 2) for foot references in the world."""
    local = (position - body.base) @ body.rotation  # R^T (p - base): body frame
    drift = (velocity - body.base_vel) @ body.rotation
    # The trunk's own turning moves a point that is fixed in the world by -omega x r.
    drift = drift - body.omega * jnp.stack([-local[:, 1], local[:, 0]], axis=-1)
    q1, q2, trig = inverse(robot, local - robot.hip_pos[:, ::2])
    rates = jnp.clip(joint_rates(robot, trig, drift), -MAX_JOINT_RATE, MAX_JOINT_RATE)
    return jnp.stack([q1, q2], axis=-1), rates


def spatial_joint_reference(
    robot: RobotParams,
    body: spatial.SpatialState,
    position: Float[Array, "4 3"],
    velocity: Float[Array, "4 3"],
) -> tuple[Float[Array, "4 3"], Float[Array, "4 3"]]:
    """Angles [rad] and rates [rad/s] (4, 3) of all joints for foot references, track frame."""
    lever = position - body.base
    omega = spatial.rotate(body.heading, body.omega)
    drift = velocity - body.base_vel - jnp.cross(omega, lever)
    angle, hip, trig = spatial.inverse(robot, lever @ body.rotation - robot.hip_pos)
    rates = spatial.joint_rates(robot, hip, trig, drift @ body.rotation)
    return angle, jnp.clip(rates, -MAX_JOINT_RATE, MAX_JOINT_RATE)


def steady_gains(params: SwingParams, robot: RobotParams, dt: float) -> SwingParams:
    """Settings with gains that a leg's inertia bears when its torques hold for ``dt`` [s].

    A damping of more than twice the inertia over the time between two torques makes a joint
    oscillate from one to the next. Gains scale with the robot's weight, and the legs of some robots
    are light for it. Of the Go1 nothing changes at 1 kHz; with torques held for 5 ms its abduction
    gains are 15 % lower.
    """
    most = STEADY * robot.joint_inertia / dt
    kd = jnp.minimum(params.kd, most)
    ratio = jnp.where(params.kd > most, kd / jnp.maximum(params.kd, 1e-12), 1.0)
    return params._replace(kp=params.kp * ratio, kd=kd)


def swing_torque(
    params: SwingParams,
    joint_pos: Float[Array, "4 3"],
    joint_vel: Float[Array, "4 3"],
    position: Float[Array, "4 n"],
    velocity: Float[Array, "4 n"],
) -> Float[Array, "4 n"]:
    """Torque (4, n) of the joint PD on the last n joints (Eq. 17) [N m]."""
    n = position.shape[1]
    return params.kp[-n:] * (position - joint_pos[:, -n:]) + params.kd[-n:] * (
        velocity - joint_vel[:, -n:]
    )
