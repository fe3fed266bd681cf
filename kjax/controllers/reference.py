"""From command and clock to what the body is to do: reference velocity, lag, corrections."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax import gait
from kjax.controllers.command import HEIGHT, V_X
from kjax.controllers.params import ControllerParams
from kjax.controllers.planning import periodic_motion
from kjax.controllers.state import ControllerState
from kjax.legs.kinematics import PlanarState


class Reference(NamedTuple):
    """What the body is to do.

    Attributes:
      lag: reference of p_x less p_x [m].
      command: (6,) in force, order of ``types.COMMAND_NAMES``.
      velocity: reference of v_x, on its way to the command [m/s].
      height: reference of the height above the gait's own, likewise [m].
      correction: (2,) added to the references of velocity and pitch [m/s, rad].
    """

    lag: Float[Array, ""]
    command: Float[Array, "6"]
    velocity: Float[Array, ""]
    height: Float[Array, ""]
    correction: Float[Array, "2"]


def next_reference(
    params: ControllerParams,
    state: ControllerState,
    clock: gait.Clock,
    body: PlanarState,
    control_dt: float,
) -> Reference:
    """Reference velocity, its integral, and the slow corrections, one control tick on.

    Args:
      params: command, slew, rates and limits of the integral action.
      state: before.
      clock: gait, phase and time in it, now.
      body: as it is now.
      control_dt: of a tick [s].
    """
    command = command_now(params, state)
    change, climb = params.command_slew * control_dt, params.height_slew * control_dt
    velocity = state.velocity[0] + jnp.clip(command[V_X] - state.velocity[0], -change, change)
    height = state.height + jnp.clip(command[HEIGHT] - state.height, -climb, climb)
    periodic_ref = periodic_motion(params, clock.gait, clock.phase, clock.cycle, clock.elapsed)
    error = jnp.stack([velocity - body.x[3], periodic_ref[1] - body.x[2]])
    rate, limit = params.integral
    # Errors beyond the limit are a step on its way, not a bias.
    correction = state.correction + rate * control_dt * jnp.clip(error, -limit, limit)
    # What one gait's model misses says nothing about another's.
    switched = clock.gait != state.clock.gait
    correction = jnp.where(switched, 0.0, jnp.clip(correction, -limit, limit))
    slack = params.position_slack
    lag = state.lag[0] + (velocity + correction[0] - body.x[3]) * control_dt
    return Reference(jnp.clip(lag, -slack, slack), command, velocity, height, correction)


def command_now(params: ControllerParams, state: ControllerState) -> Float[Array, "6"]:
    """The command in force; the last one where it is not finite."""
    command = params.command.values[_piece(params.command.times, state.time)]
    return jnp.where(jnp.isfinite(command), command, state.command)


def next_clock(params: ControllerParams, state: ControllerState, control_dt: float) -> gait.Clock:
    """Place in the gait at the next plan, ``control_dt`` [s] after the last one."""
    wanted = params.gaits[_piece(params.gait_times, state.time)]
    return gait.advance(params.schedule, state.clock, control_dt, wanted)


def _piece(times: Float[Array, "K"], time: Float[Array, ""]) -> Int[Array, ""]:
    """Index of the piece that ``time`` lies in; it begins at its start time, within rounding."""
    return jnp.maximum(jnp.sum(time >= times - 1e-5) - 1, 0)
