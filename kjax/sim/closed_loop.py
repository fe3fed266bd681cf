"""One robot's closed loop as pure functions of an engine's arrays: sense, plan, act, record.

All engines call these: the single one as they are, the batch vmapped, once per control tick or
physics step, and MJX within its scans.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from kjax.controllers.controller import build_controller
from kjax.controllers.params import Tables
from kjax.controllers.state import ControllerState
from kjax.legs.base import build_base
from kjax.robots import Robot
from kjax.sim.episode import BatchSpec, EpisodeParams, SceneSpec
from kjax.sim.excitation import perturb
from kjax.sim.noise import add_noise, force_row, sensor_row
from kjax.sim.observe import build_observe, find_addresses
from kjax.sim.tick_stats import ReadWindow, build_read_window
from kjax.types import Observation, RobotParams

# Height of the centre of mass above the lowest sole, over the leg's length; about the trunk lying
# on the ground, wherever that is.
FALL_HEIGHT = 0.28
FALL_TILT = 1.0  # rad, pitch or roll
# MuJoCo resets a state that is not a number, to joints that no leg can have.
BEYOND_RANGE = 0.3  # rad


class Sensed(NamedTuple):
    """What an engine gives of one robot.

    Attributes:
      qpos: (nq,) positions.
      qvel: (nv,) velocities.
      sensordata: (ns,) sensors.
    """

    qpos: Float[Array | np.ndarray, "nq"]
    qvel: Float[Array | np.ndarray, "nv"]
    sensordata: Float[Array | np.ndarray, "ns"]


class LoopState(NamedTuple):
    """What one robot carries besides its physics.

    Attributes:
      controller: state of the controller.
      track: true heading at the start, ``None`` on the planar base.
      alive: whether it has neither fallen nor a state that is not finite.
    """

    controller: ControllerState
    track: Any
    alive: Bool[Array, ""]


class Noise(NamedTuple):
    """What is added in one physics step; empty where the scene has none.

    Attributes:
      sensors: (n,) for ``noise.add_noise``.
      force: (4,) on the planned forces, at control ticks [N].
    """

    sensors: Any
    force: Any


class TickLog(NamedTuple):
    """What is recorded of one control tick, at its beginning; names as in ``Trajectory``.

    ``alive``: whether the robot has not fallen.
    """

    x: Any
    feet: Any
    foot_force: Any
    gait: Any
    stance: Any
    force: Any
    velocity_command: Any
    velocity_reference: Any
    status: Any
    residual: Any
    iterations: Any
    alive: Any


class ClosedLoop(NamedTuple):
    """Functions of one robot.

    Attributes:
      noise: (episode, step) -> noise.
      init: (tables, noise, sensed) -> state.
      plan: (tables, origin, state, noise, sensed) -> (state, log); at the control rate. ``origin``
        is that of the episode.
      act: (tables, state, noise, sensed) -> (state, torque (12,) in actuator order).
      stats: (robot, track, origin, window, command, reference) -> stats of the tick that a window
        holds; ``tick_stats.build_read_window``.
    """

    noise: Callable[[EpisodeParams, Array], Noise]
    init: Callable[[Tables, Noise, Sensed], LoopState]
    plan: Callable[[Tables, Array, LoopState, Noise, Sensed], tuple[LoopState, TickLog]]
    act: Callable[[Tables, LoopState, Noise, Sensed], tuple[LoopState, Array]]
    stats: ReadWindow


def build_closed_loop(
    robot: Robot, spec: BatchSpec, model: mujoco.MjModel, *, held: bool
) -> ClosedLoop:
    """Functions for all robots with one spec.

    Args:
      robot: theirs.
      spec: theirs.
      model: of the scene; its addresses count.
      held: whether ``act`` is called once per control tick rather than every ``leg.act_dt``.
    """
    # The swing legs move on by one of these times with each call of ``act``.
    own, scene = spec.controller, spec.scene
    controller = build_controller(replace(own, act_dt=own.control_dt) if held else own)
    base = build_base(own.base)
    observe, at = build_observe(robot, model, scene.contact_threshold), find_addresses(robot, model)
    order = np.argsort(at.actuator.reshape(-1))

    def see(sensed: Sensed) -> Observation:
        return observe(
            jnp.asarray(sensed.qpos), jnp.asarray(sensed.qvel), jnp.asarray(sensed.sensordata)
        )

    def noise(episode: EpisodeParams, step: Array) -> Noise:
        return draw_noise(scene, episode, step)

    def sense(noise: Noise, sensed: Sensed) -> Observation:
        if not scene.noise:
            return see(sensed)
        # Else XLA draws the noise again for each of its uses.
        seen = add_noise(see(sensed), noise.sensors.astype(sensed.qpos.dtype))
        return jax.lax.optimization_barrier(seen)

    def init(tables: Tables, noise: Noise, sensed: Sensed) -> LoopState:
        return LoopState(
            controller=controller.init(tables, sense(noise, sensed)),
            track=base.track(see(sensed)),
            alive=jnp.ones((), bool),
        )

    def plan(
        tables: Tables, origin: Array, state: LoopState, noise: Noise, sensed: Sensed
    ) -> tuple[LoopState, TickLog]:
        next_state, info = controller.plan(tables, state.controller, sense(noise, sensed))
        if scene.force_noise:
            next_state = next_state._replace(
                force=perturb(next_state.force, next_state.stance, noise.force)
            )
        true = see(sensed)
        true = true._replace(base_pos=true.base_pos - origin.astype(true.base_pos.dtype))
        body = base.view(tables.params.robot, state.track, true).planar
        alive = state.alive & standing(tables.params.robot, body.x, body.feet, true)
        log = TickLog(
            x=body.x,
            feet=body.feet,
            foot_force=sensed.sensordata[jnp.asarray(at.foot_force)],
            gait=next_state.clock.gait,
            stance=next_state.stance,
            force=next_state.force,
            velocity_command=next_state.command[0],
            velocity_reference=next_state.velocity[0],
            status=info.status,
            residual=info.residual,
            iterations=info.iterations,
            alive=alive,
        )
        return LoopState(next_state, state.track, alive), log

    def act(
        tables: Tables, state: LoopState, noise: Noise, sensed: Sensed
    ) -> tuple[LoopState, Array]:
        next_state, command = controller.act(tables, state.controller, sense(noise, sensed))
        torque = jnp.where(state.alive, command.torque, 0.0)
        torque = jnp.asarray(at.sign) * torque
        return state._replace(controller=next_state), torque.reshape(-1)[order]

    stats = build_read_window(base, observe, at, free=own.base == "free", dt=scene.sim_dt)
    return ClosedLoop(noise=noise, init=init, plan=plan, act=act, stats=stats)


def draw_noise(scene: SceneSpec, episode: EpisodeParams, step: Array) -> Noise:
    """Noise of a physics step of an episode, float32."""
    sensors = force = jnp.zeros(0, jnp.float32)
    if scene.noise:
        sensors = sensor_row(episode.seed, step, scene.base) * episode.noise_scale
    if scene.force_noise:
        force = episode.force_noise * force_row(episode.seed, step)
    return Noise(sensors, force)


def delayed_torque(ring: Any, torque: Any, place: Any, delay: Any) -> tuple[Any, Any]:
    """What reaches the joints, and the ring of torques on their way.

    Args:
      ring: (D, nu) the last torques, D of them; one is no delay at all.
      torque: (nu,) just computed.
      place: number of the call.
      delay: calls that a torque takes, below D.
    """
    count = ring.shape[0]
    if count == 1:
        return ring, torque
    ring = ring.at[place % count].set(torque)
    return ring, ring[(place - delay) % count]


def standing(
    robot: RobotParams, x: Float[Array, "6"], feet: Float[Array, "4 d"], observation: Observation
) -> Bool[Array, ""]:
    """Whether the robot has not fallen; not a number is a fall.

    Args:
      robot: its size.
      x: SRB state.
      feet: (4, d) foot centres, z last, in the same frame [m].
      observation: of the robot.
    """
    w, i, j, k = observation.base_quat
    roll = jnp.arctan2(2.0 * (w * i + j * k), 1.0 - 2.0 * (i * i + j * j))
    finite = jnp.isfinite(observation.joint_pos).all() & jnp.isfinite(observation.joint_vel).all()
    upright = (jnp.abs(x[2]) < FALL_TILT) & (jnp.abs(roll) < FALL_TILT)
    least = FALL_HEIGHT * (robot.thigh_length + robot.calf_length)
    height = x[1] - (jnp.min(feet[:, -1]) - robot.foot_radius)
    low, high = jnp.asarray(robot.joint_range).T
    beyond = jnp.maximum(low[None] - observation.joint_pos, observation.joint_pos - high[None])
    return finite & (height > least) & upright & (beyond < BEYOND_RANGE).all()
