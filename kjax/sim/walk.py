"""One robot of a batch as pure functions of an engine's arrays: sense, plan, act, record.

Both engines vmap these: the C loop calls them once per control tick or physics step, the MJX loop
holds them in its scans.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from kjax.controller import build_controller
from kjax.legs.base import build_base
from kjax.params import Tables
from kjax.robots import Robot
from kjax.sim.episode import FALL_HEIGHT, FALL_TILT
from kjax.sim.excitation import force_row, perturb
from kjax.sim.noise import SENSORS, add_noise, noise_dim, normal_row
from kjax.sim.observe import build_observe, find_addresses
from kjax.sim.resolve import BatchSpec, EpisodeParams
from kjax.state import ControllerState
from kjax.types import Observation, RobotParams


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


class WalkState(NamedTuple):
    """What one robot carries besides its physics.

    Attributes:
      controller: state of the controller.
      track: true heading at the start, ``None`` on the planar base.
      alive: whether it has neither fallen nor left the finite numbers.
    """

    controller: ControllerState
    track: Any
    alive: Bool[Array, ""]


class TickLog(NamedTuple):
    """What is recorded of one control tick, at its beginning; names as in ``Trajectory``."""

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


class Walk(NamedTuple):
    """Functions of one robot.

    Attributes:
      init: (tables, episode, sensed) -> state.
      plan: (tables, episode, state, step, sensed) -> (state, log); at the control rate.
      act: (tables, episode, state, step, sensed) -> (state, torque (12,) in actuator order).
    """

    init: Callable[[Tables, EpisodeParams, Sensed], WalkState]
    plan: Callable[[Tables, EpisodeParams, WalkState, Array, Sensed], tuple[WalkState, TickLog]]
    act: Callable[[Tables, EpisodeParams, WalkState, Array, Sensed], tuple[WalkState, Array]]


def build_walk(robot: Robot, spec: BatchSpec, model: mujoco.MjModel, *, held: bool) -> Walk:
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

    def sense(episode: EpisodeParams, step: Array, sensed: Sensed) -> Observation:
        if not scene.noise:
            return see(sensed)
        row = normal_row(episode.seed, step, SENSORS, noise_dim(scene.base))
        row = row.astype(sensed.qpos.dtype) * episode.noise_scale.astype(sensed.qpos.dtype)
        # Else XLA reads the numbers again for each of their uses.
        return jax.lax.optimization_barrier(add_noise(see(sensed), row))

    def init(tables: Tables, episode: EpisodeParams, sensed: Sensed) -> WalkState:
        first = sense(episode, jnp.zeros((), jnp.int32), sensed)
        return WalkState(
            controller=controller.init(tables, first),
            track=base.track(see(sensed)),
            alive=jnp.ones((), bool),
        )

    def plan(
        tables: Tables, episode: EpisodeParams, state: WalkState, step: Array, sensed: Sensed
    ) -> tuple[WalkState, TickLog]:
        moved, info = controller.plan(tables, state.controller, sense(episode, step, sensed))
        if scene.force_noise:
            added = episode.force_noise * force_row(episode.seed, step)
            moved = moved._replace(force=perturb(moved.force, moved.stance, added))
        true = see(sensed)
        true = true._replace(base_pos=true.base_pos - episode.origin.astype(true.base_pos.dtype))
        body = base.view(tables.params.robot, state.track, true).planar
        log = TickLog(
            x=body.x,
            feet=body.feet,
            foot_force=sensed.sensordata[jnp.asarray(at.foot_force)],
            gait=moved.clock.gait,
            stance=moved.stance,
            force=moved.force,
            velocity_command=moved.command[0],
            velocity_reference=moved.velocity,
            status=info.status,
            residual=info.residual,
            iterations=info.iterations,
        )
        return WalkState(
            moved, state.track, state.alive & standing(tables.params.robot, body.x, true)
        ), log

    def act(
        tables: Tables, episode: EpisodeParams, state: WalkState, step: Array, sensed: Sensed
    ) -> tuple[WalkState, Array]:
        moved, command = controller.act(tables, state.controller, sense(episode, step, sensed))
        torque = jnp.where(state.alive, command.torque, 0.0)
        return state._replace(controller=moved), (jnp.asarray(at.sign) * torque).reshape(-1)[order]

    return Walk(init=init, plan=plan, act=act)


def standing(robot: RobotParams, x: Float[Array, "6"], observation: Observation) -> Bool[Array, ""]:
    """Whether the robot has not fallen; not a number is a fall (``episode.fallen``)."""
    w, i, j, k = observation.base_quat
    roll = jnp.arctan2(2.0 * (w * i + j * k), 1.0 - 2.0 * (i * i + j * j))
    finite = jnp.isfinite(observation.joint_pos).all() & jnp.isfinite(observation.joint_vel).all()
    upright = (jnp.abs(x[2]) < FALL_TILT) & (jnp.abs(roll) < FALL_TILT)
    least = FALL_HEIGHT * (robot.thigh_length + robot.calf_length)
    return finite & (x[1] > least) & upright
