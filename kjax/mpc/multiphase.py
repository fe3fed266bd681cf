"""LMPC over a horizon that crosses contact modes: one gait cycle, flights and next stances in it.

The model is the SRB with forces in the *world* frame on feet that are fixed in the world. Its
zero-order-hold step is exactly bilinear in the lifted state (1, p, v, theta, omega): p and v are
linear in the forces, and only theta and omega carry the products (p_foot - p) x F. With the path
of p predicted first, the moment arms are known and the model is linear and time-varying:

    v_k     = v_0 - g t_k             + sum_{j<=k} h_j alpha_j F_j / m
    omega_k = omega_0                 + sum_{j<=k} h_j alpha_j (r_j x F_j) / I
    p_k     = p_0 + v_0 t_k - g t_k^2/2 + sum_{j<=k} h_j (t_k - t_j) alpha_j F_j / m,   theta alike,

t_k the end of node k, t_j the middle of node j, h_j its length (``mpc.horizon``). That leaves out
how the arms change where p leaves its path; ``mpc.cycle_rollout`` has it, and is used in place of
``response`` where nominal forces are given. Besides a box the
forces keep to rows: the friction pyramid |F_x| <= mu F_z and joint torque limits |J^T F| <= tau in
the predicted posture.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from kjax import qp
from kjax.legs.kinematics import LegTrig, foot_jacobian, inverse
from kjax.mpc.cycle_rollout import roll_out
from kjax.mpc.horizon import HorizonForecast, MultiPhaseParams, Nodes
from kjax.spec import CycleSpec
from kjax.types import GRAVITY, RobotParams


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
    nominal: Float[Array, "K 2"] | None = None,
) -> MultiPhasePlan:
    """Forces over the horizon. Eight arguments: the problem's data, each of another origin.

    Args:
      params: weights and limits.
      robot: for the joint torque limits.
      nodes: grid.
      forecast: from ``horizon.predict``.
      x: state now.
      lever: (2,) centre of mass in the trunk frame [m].
      spec: tolerance and limit of the QP.
      nominal: (K, 2) forces whose roll-out the prediction is made about in place of the forecast's
        path, world frame [N].
    """
    K = nodes.length.shape[0]
    if nominal is None:
        free, forced = response(params, nodes, forecast, x)
    else:
        about = roll_out(params, nodes, forecast, x, nominal)
        forced = about.by_force
        free = about.states - jnp.einsum("kajf,jf->ka", forced, nominal)
        forecast = forecast._replace(path=about.path, foot=about.foot)
    weight = params.state_weights[None] * nodes.length[:, None]
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
    free = jnp.concatenate(
        [x[None, :3] + x[None, 3:] * t[:, None] + drop, x[None, 3:] + sink], axis=-1
    )

    K = t.shape[0]
    past = jnp.tril(jnp.ones((K, K), t.dtype))
    gain = past * (nodes.length * nodes.feet)[None]  # (k, j)
    lag = gain * (t[:, None] - nodes.middle[None])
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
    up = jnp.stack([jnp.zeros_like(robot.foot_radius), robot.foot_radius])
    foot_centre = forecast.foot + up[None]
    local = jnp.einsum("kij,kj->ki", to_body, foot_centre - forecast.path[:, :2]) + lever[None]
    hip = robot.hip_pos[::2, ::2][nodes.end_index]
    legs = robot._replace(knee=robot.knee[::2][nodes.end_index])
    trig: LegTrig = jax.lax.optimization_barrier(inverse(legs, local - hip)[2])
    torque = jnp.einsum("kij,kil->kjl", foot_jacobian(legs, trig), to_body)  # J^T R^T
    mu = params.friction
    pyramid = jnp.stack([jnp.stack([jnp.ones_like(mu), -mu]), jnp.stack([-jnp.ones_like(mu), -mu])])
    pyramid = jnp.broadcast_to(pyramid, (theta.shape[0], 2, 2))
    zero = jnp.zeros_like(params.torque_limit)
    return jnp.concatenate([pyramid, torque], axis=1), jnp.concatenate([zero, params.torque_limit])
