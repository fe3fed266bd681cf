"""The horizon of ``mpc.multiphase``: one gait cycle as nodes, and what is expected over it.

A node lies in one phase; a stance is cut into several, a flight is one node without force. The path
of the centre of mass and the footholds are predicted before the QP, from state, command and gait.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax import gait
from kjax.types import GRAVITY, MODE_ALPHA


class MultiPhaseParams(NamedTuple):
    """Parameters of the multi-phase LMPC; weights are per second of the horizon.

    Those with an axis (G,) are by gait in the controller's parameters; ``for_gait`` picks.

    Attributes:
      nodes: (G, P) number of nodes of a whole phase.
      state_weights: (G, 6) diagonal of Q [1/s and the state's units].
      input_weight: (G,) R of every force [1/(N^2 s)].
      mass: [kg].
      inertia: [kg m^2].
      friction: mu of the pyramid [-].
      torque_limit: (2,) of thigh and calf [N m].
      force_x_max: (G,) bound of |F_x| per leg [N].
      force_z: (G, 2) bounds of F_z per leg [N].
      feet: (G, 2) place of the front and rear feet ahead of the centre of mass, standing still [m].
      velocity_gain: (G,) of the footholds on the velocity error [s].
      velocity_time: time in which the velocity is predicted to reach its reference [s].
      height_time: the same of height and pitch [s].
    """

    nodes: Int[Array, "G P"]
    state_weights: Float[Array, "*gait 6"]
    input_weight: Float[Array, "*gait"]
    mass: Float[Array, ""]
    inertia: Float[Array, ""]
    friction: Float[Array, ""]
    torque_limit: Float[Array, "2"]
    force_x_max: Float[Array, "*gait"]
    force_z: Float[Array, "*gait 2"]
    feet: Float[Array, "*gait 2"]
    velocity_gain: Float[Array, "*gait"]
    velocity_time: Float[Array, ""]
    height_time: Float[Array, ""]


def for_gait(params: MultiPhaseParams, gait: Int[Array, ""]) -> MultiPhaseParams:
    """Parameters with those that depend on the gait picked for ``gait``, but for ``nodes``."""
    return params._replace(
        state_weights=params.state_weights[gait],
        input_weight=params.input_weight[gait],
        force_x_max=params.force_x_max[gait],
        force_z=params.force_z[gait],
        feet=params.feet[gait],
        velocity_gain=params.velocity_gain[gait],
    )


class Nodes(NamedTuple):
    """Grid of the horizon, K nodes; unused ones have no length and no force.

    Attributes:
      length: (K,) [s].
      end: (K,) time from now to the node's end [s].
      phase: (K,) index of the gait's phase.
      cycle: (K,) its cycle.
      place: (K,) time from the phase's start to the node's end [s].
      begin: (K,) time from now to the start of the node's phase, 0 for the present one [s].
      present: (K,) whether the node lies in the present phase.
      feet: (K,) number of feet that stand, of the one end that does [-].
      end_index: (K,) which end: 0 front, 1 rear.
    """

    length: Float[Array, "K"]
    end: Float[Array, "K"]
    phase: Int[Array, "K"]
    cycle: Int[Array, "K"]
    place: Float[Array, "K"]
    begin: Float[Array, "K"]
    present: Bool[Array, "K"]
    feet: Float[Array, "K"]
    end_index: Int[Array, "K"]

    @property
    def middle(self) -> Float[Array, "K"]:
        """Time from now to the node's middle [s]."""
        return self.end - 0.5 * self.length


def build_nodes(
    params: MultiPhaseParams,
    schedule: gait.Schedule,
    clock: gait.Clock,
    count: int,
    shortest: float,
) -> Nodes:
    """Grid of one gait cycle from now on.

    Args:
      params: number of nodes per phase.
      schedule: of all gaits; the present one must not have both ends in stance at once.
      clock: now.
      count: number K of nodes, at least one more than the gait's phases have together.
      shortest: least time left of the present phase [s].
    """
    ahead = gait.preview(schedule, clock, shortest)
    wanted = params.nodes[clock.gait, ahead.phase]
    # A sliver of a phase, left over by rounding, is no node.
    number = jnp.where(
        ahead.fraction > 1e-6, jnp.ceil(wanted * ahead.fraction - 1e-6).astype(jnp.int32), 0
    )
    last = jnp.cumsum(number)
    node = jnp.arange(count)
    slot = jnp.minimum(jnp.sum(node[:, None] >= last[None], axis=1), len(last) - 1)
    used = node < last[-1]
    rank = node - (last - number)[slot]
    length = jnp.where(used, (ahead.duration / jnp.maximum(number, 1))[slot], 0.0)
    phase = ahead.phase[slot]
    alpha = jnp.asarray(MODE_ALPHA, length.dtype)[schedule.mode[clock.gait, phase]]
    end = ahead.begin[slot] + (rank + 1) * length
    return Nodes(
        length=length,
        end=jnp.where(used, end, ahead.begin[-1] + ahead.duration[-1]),
        phase=phase,
        cycle=ahead.cycle[slot],
        place=ahead.passed[slot] + (rank + 1) * length,
        begin=ahead.begin[slot],
        present=used & (slot == 0),
        feet=jnp.where(used, alpha.sum(axis=1), 0.0),
        end_index=(alpha[:, 1] > 0).astype(jnp.int32),
    )


class HorizonForecast(NamedTuple):
    """What is predicted before the QP: where the body will be and what it shall do.

    Attributes:
      reference: (K, 6) state wanted at the nodes' ends.
      path: (K, 3) (x, z, theta) expected at the nodes' middles [m, rad].
      foot: (K, 2) contact point of the standing end, world [m].
      ahead: (K,) of a stance to come, its foothold from the centre of mass at touchdown [m],
      by_speed: (K,) and further per velocity v_x at touchdown [s].
      force_z: (K,) vertical force per foot that the gait's reference takes [N].
    """

    reference: Float[Array, "K 6"]
    path: Float[Array, "K 3"]
    foot: Float[Array, "K 2"]
    ahead: Float[Array, "K"]
    by_speed: Float[Array, "K"]
    force_z: Float[Array, "K"]


class HorizonCommand(NamedTuple):
    """What the horizon is to follow.

    Attributes:
      position: reference of p_x now [m].
      velocity: reference of v_x now [m/s].
      target: velocity that the reference is on its way to [m/s].
      slew: at this rate [m/s^2].
      height: of the centre of mass, mean of the stances, above z = 0 [m].
      periodic: (K, 4) the gait's periodic motion (z, theta, v_z, omega) at the nodes' ends.
    """

    position: Float[Array, ""]
    velocity: Float[Array, ""]
    target: Float[Array, ""]
    slew: Float[Array, ""]
    height: Float[Array, ""]
    periodic: Float[Array, "K 4"]


class Stances(NamedTuple):
    """Where and how long the feet stand.

    Attributes:
      ground: height of the ground [m].
      feet: (2, 2) where the front and rear feet are now, world [m].
      duration: (K,) length of the node's phase [s].
      cycle: length of the gait cycle [s].
    """

    ground: Float[Array, ""]
    feet: Float[Array, "2 2"]
    duration: Float[Array, "K"]
    cycle: Float[Array, ""]


def predict(
    params: MultiPhaseParams,
    nodes: Nodes,
    x: Float[Array, "6"],
    command: HorizonCommand,
    stances: Stances,
) -> HorizonForecast:
    """Reference, path of the centre of mass and footholds over the horizon.

    Args:
      params: feet, gains and time constants.
      nodes: of the horizon.
      x: state now.
      command: that the reference follows.
      stances: of the feet.
    """
    velocity, height = command.velocity, command.height
    missing = command.target - velocity
    # s, until it is there; no shorter than what leaves derivatives by it finite.
    ramp = jnp.maximum(jnp.abs(missing) / command.slew, 1e-6)

    def speed(t: Array) -> Array:
        return velocity + missing * jnp.minimum(t / ramp, 1.0)

    def travel(t: Array) -> Array:
        within = jnp.minimum(t, ramp)
        return velocity * t + missing * (0.5 * within * (within / ramp) + t - within)

    z, theta, v_z, omega = command.periodic.T
    reference = jnp.stack(
        [
            command.position + travel(nodes.end),
            height + z,
            theta,
            speed(nodes.end),
            v_z,
            omega,
        ],
        axis=-1,
    )
    lead, tau = x[3] - velocity, params.velocity_time

    def forward(t: Array) -> Array:
        return x[0] + travel(t) + lead * tau * (1.0 - jnp.exp(-t / tau))

    middle = nodes.middle
    fade = jnp.exp(-middle / params.height_time)
    path = jnp.stack(
        [
            forward(middle),
            height + (x[1] - height) * fade,
            theta + (x[2] - theta) * fade,
        ],
        axis=-1,
    )
    error = lead * jnp.exp(-nodes.begin / tau)
    ahead = (
        params.feet[nodes.end_index]
        + 0.5 * stances.duration * (speed(nodes.begin) + error)
        + params.velocity_gain * error
    )
    next_foothold = jnp.stack(
        [forward(nodes.begin) + ahead, jnp.broadcast_to(stances.ground, ahead.shape)], axis=-1
    )
    foot = jnp.where(nodes.present[:, None], stances.feet[nodes.end_index], next_foothold)
    # Vertical impulses that carry the weight over a cycle and leave no net pitch moment.
    lever = jnp.abs(params.feet)
    share = (lever[::-1] / lever.sum())[nodes.end_index]
    load = share * params.mass * GRAVITY * stances.cycle / stances.duration
    standing = nodes.feet > 0
    force_z = jnp.where(standing, load / jnp.maximum(nodes.feet, 1.0), 0.0)
    return HorizonForecast(
        reference=reference,
        path=path,
        foot=foot,
        ahead=params.feet[nodes.end_index] - params.velocity_gain * speed(nodes.begin),
        by_speed=0.5 * stances.duration + params.velocity_gain,
        force_z=force_z,
    )
