"""LMPC over a horizon that crosses contact modes: one gait cycle, flights and next stances in it.

The model is the SRB with forces in the *world* frame on feet that are fixed in the world. Its
zero-order-hold step is exactly bilinear in the lifted state (1, p, v, theta, omega): p and v are
linear in the forces, and only theta and omega carry the products (p_foot - p) x F. With the path
of p predicted first, the moment arms are known and the model is linear and time-varying:

    v_k     = v_0 - g t_k             + sum_{j<=k} h_j alpha_j F_j / m
    omega_k = omega_0                 + sum_{j<=k} h_j alpha_j (r_j x F_j) / I
    p_k     = p_0 + v_0 t_k - g t_k^2/2 + sum_{j<=k} h_j (t_k - t_j) alpha_j F_j / m,   theta alike,

t_k the end of node k, t_j the middle of node j, h_j its length. A node lies in one phase; a stance
is cut into several, a flight is one node without force. Besides a box the forces keep to rows: the
friction pyramid |F_x| <= mu F_z and joint torque limits |J^T F| <= tau in the predicted posture.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax import gait, qp
from kjax.legs.kinematics import LegTrig, foot_jacobian, inverse
from kjax.spec import CycleSpec
from kjax.types import GRAVITY, MODE_ALPHA, RobotParams


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
    slot = jnp.minimum(jnp.sum(node[:, None] >= last, axis=1), len(last) - 1)
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
      force_z: (K,) vertical force per foot that the gait's reference takes [N].
    """

    reference: Float[Array, "K 6"]
    path: Float[Array, "K 3"]
    foot: Float[Array, "K 2"]
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
    return HorizonForecast(reference=reference, path=path, foot=foot, force_z=force_z)


class MultiPhasePlan(NamedTuple):
    """Result of ``solve``.

    Attributes:
      force: (K, 2) force (x, z) per standing foot in each node, world frame [N].
      states: (K, 6) predicted states at the nodes' ends.
      status: a ``qp.Status``.
      residual: largest of primal and dual residual and gap [-].
      iterations: of the solver.
    """

    force: Float[Array, "K 2"]
    states: Float[Array, "K 6"]
    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]


def solve(
    params: MultiPhaseParams,
    robot: RobotParams,
    nodes: Nodes,
    forecast: HorizonForecast,
    x: Float[Array, "6"],
    lever: Float[Array, "2"],
    spec: CycleSpec,
) -> MultiPhasePlan:
    """Forces over the horizon.

    Args:
      params: weights and limits.
      robot: for the joint torque limits.
      nodes: grid.
      forecast: from ``predict``.
      x: state now.
      lever: (2,) centre of mass in the trunk frame [m].
      spec: tolerance and limit of the QP.
    """
    K = nodes.length.shape[0]
    free, forced = response(params, nodes, forecast, x)
    weight = params.state_weights * nodes.length[:, None]
    B = forced.reshape(6 * K, 2 * K)
    weighted = B * weight.reshape(-1)[:, None]
    R = jnp.repeat(params.input_weight * nodes.length, 2)
    u_ref = jnp.stack([jnp.zeros_like(forecast.force_z), forecast.force_z], axis=-1).reshape(-1)
    standing = nodes.feet > 0
    H = 2.0 * (weighted.T @ B + jnp.diag(R))
    q = 2.0 * (weighted.T @ (free - forecast.reference).reshape(-1) - R * u_ref)

    low = jnp.stack([-params.force_x_max, params.force_z[0]])
    high = jnp.stack([params.force_x_max, params.force_z[1]])
    lower, upper = (jnp.where(standing[:, None], b, 0.0).reshape(-1) for b in (low, high))
    rows, limit = force_rows(params, robot, nodes, forecast, lever)
    # Node k's rows act on node k's force alone.
    C = jnp.einsum("krf,kl->krlf", rows, jnp.eye(K, dtype=rows.dtype)).reshape(-1, 2 * K)
    limit = jnp.broadcast_to(limit, (K, 4))
    one_sided = jnp.array([True, True, False, False])
    solution = qp.solve_rows(
        H,
        q,
        C,
        jnp.where(one_sided, -jnp.inf, -limit).reshape(-1),
        limit.reshape(-1),
        lower,
        upper,
        method="active_set",
        tolerance=spec.tolerance,
        max_iterations=spec.max_iterations,
    )
    return MultiPhasePlan(
        force=solution.x.reshape(K, 2),
        states=free + (B @ solution.x).reshape(K, 6),
        status=solution.status,
        residual=jnp.maximum(jnp.maximum(solution.primal, solution.dual), solution.gap),
        iterations=solution.iterations,
    )


def response(
    params: MultiPhaseParams, nodes: Nodes, forecast: HorizonForecast, x: Float[Array, "6"]
) -> tuple[Float[Array, "K 6"], Float[Array, "K 6 K 2"]]:
    """States at the nodes' ends without forces, and their derivative by every node's force."""
    t = nodes.end
    zero, one = jnp.zeros_like(t), jnp.ones_like(t)
    drop = jnp.stack([zero, -0.5 * GRAVITY * t**2, zero], axis=-1)
    sink = jnp.stack([zero, -GRAVITY * t, zero], axis=-1)
    free = jnp.concatenate([x[:3] + x[3:] * t[:, None] + drop, x[3:] + sink], axis=-1)

    K = t.shape[0]
    past = jnp.tril(jnp.ones((K, K), t.dtype))
    gain = past * (nodes.length * nodes.feet)  # (k, j)
    lag = gain * (t[:, None] - nodes.middle)
    arm = forecast.foot - forecast.path[:, :2]
    # Acceleration (x, z, theta) by (F_x, F_z) of node j; a force ahead of the body lifts the nose.
    by_force = jnp.stack(
        [
            jnp.stack([one / params.mass, zero], -1),
            jnp.stack([zero, one / params.mass], -1),
            jnp.stack([-arm[:, 1], arm[:, 0]], -1) / params.inertia,
        ],
        axis=1,
    )
    position = jnp.einsum("kj,jaf->kajf", lag, by_force)
    velocity = jnp.einsum("kj,jaf->kajf", gain, by_force)
    return free, jnp.concatenate([position, velocity], axis=1)


def force_rows(
    params: MultiPhaseParams,
    robot: RobotParams,
    nodes: Nodes,
    forecast: HorizonForecast,
    lever: Float[Array, "2"],
) -> tuple[Float[Array, "K 4 2"], Float[Array, "4"]]:
    """Rows on each node's force and their limits: two of friction, thigh and calf torque.

    The posture is the one that puts a foot on its contact point with the trunk where ``forecast``
    expects it.
    """
    theta = forecast.path[:, 2]
    c, s = jnp.cos(theta), jnp.sin(theta)
    to_body = jnp.stack([jnp.stack([c, s], -1), jnp.stack([-s, c], -1)], axis=-2)
    foot_centre = forecast.foot + jnp.stack([jnp.zeros_like(robot.foot_radius), robot.foot_radius])
    local = jnp.einsum("kij,kj->ki", to_body, foot_centre - forecast.path[:, :2]) + lever
    hip = robot.hip_pos[::2, ::2][nodes.end_index]
    trig: LegTrig = jax.lax.optimization_barrier(inverse(robot, local - hip)[2])
    torque = jnp.einsum("kij,kil->kjl", foot_jacobian(robot, trig), to_body)  # J^T R^T
    mu = params.friction
    pyramid = jnp.stack([jnp.stack([jnp.ones_like(mu), -mu]), jnp.stack([-jnp.ones_like(mu), -mu])])
    pyramid = jnp.broadcast_to(pyramid, (theta.shape[0], 2, 2))
    zero = jnp.zeros_like(params.torque_limit)
    return jnp.concatenate([pyramid, torque], axis=1), jnp.concatenate([zero, params.torque_limit])
