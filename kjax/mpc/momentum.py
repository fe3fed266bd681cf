"""LMPC in three dimensions on the momentum form of the rigid body, over a horizon of nodes.

About a path (p_b, v_b, a_b) the momentum ``Lam = L + m (p - p_b) x (v - v_b)`` is exactly linear in
the forces, as (1, p, v, H) is about a fixed point (``koopman.momentum``):

    Lam' = sum (r_i - p_b) x F_i + m (p - p_b) x (g - a_b),   m (g - a_b) = -sum F_b

The attitude alone is linearised: R = exp(d) R_b, d' = W_b (Lam - L_b + L_b x d), with W_b the
inverse of the inertia I_w(R_b). The path is the roll-out of nominal forces F_b from the present
state: those of the last plan. So the QP is in the changes u = F - F_b, and the prediction is that
of x = (d, p - p_b, Lam - L_b, v - v_b):

    x_{k+1} = A_k x_k + sum over the standing feet of B_kf u_kf,   x_0 = 0
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax import qp
from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.rotations import skew
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.mpc.grid import FootNodes, Grid, node_at
from kjax.mpc.response import STATE, Response, Targets

# Of the pyramid in place of the friction cone. At a corner it allows 1 / cos(pi / SIDES) times the
# cone's friction: 1.08, where that with four sides allows 1.41 and the feet slip on a diagonal.
SIDES = 8


class Weights(NamedTuple):
    """Weights per second of the horizon; axes of the heading: ahead, left, up.

    Attributes:
      attitude: (3,) about these axes [1/(rad^2 s)].
      position: (3,) [1/(m^2 s)].
      omega: (3,) [s/rad^2].
      velocity: (3,) [s/m^2].
      force: of every force's change from its target [1/(N^2 s)].
    """

    attitude: Float[Array, "3"]
    position: Float[Array, "3"]
    omega: Float[Array, "3"]
    velocity: Float[Array, "3"]
    force: Float[Array, ""]


class Limits(NamedTuple):
    """What a foot may press, and a leg's joints may bear.

    Attributes:
      friction: mu of the cone [-].
      force_z: (2,) bounds of F_z [N].
      torque: (3,) bounds of the joints' torques [N m].
    """

    friction: Float[Array, ""]
    force_z: Float[Array, "2"]
    torque: Float[Array, "3"]


class FootRows(NamedTuple):
    """Bounds of each foot's force in each node: low <= matrix F <= high.

    Attributes:
      matrix: (K, 4, r, 3) rows.
      low: (r,) their lower bounds.
      high: (r,) their upper bounds.
      force_z: (2,) bounds of F_z [N].
    """

    matrix: Float[Array, "K 4 r 3"]
    low: Float[Array, "r"]
    high: Float[Array, "r"]
    force_z: Float[Array, "2"]


class MomentumMemory(NamedTuple):
    """The last plan, for the next one to begin from.

    Attributes:
      force: (K, 4, 3) force of each leg in each node, axes of the local frame [N].
      end: (K,) time from then to the node's end [s].
      planned: whether there is one.
    """

    force: Float[Array, "K 4 3"]
    end: Float[Array, "K"]
    planned: Bool[Array, ""]


class MomentumPlan(NamedTuple):
    """Result of ``solve``.

    Attributes:
      force: (K, 4, 3) force of each leg in each node, world [N].
      status: a ``qp.Status``.
      residual: largest of primal and dual residual and gap [-].
      iterations: of the solver.
    """

    force: Float[Array, "K 4 3"]
    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]


def linearise(
    body: SpatialBody,
    start: BodyState,
    length: Float[Array, "K"],
    feet: Float[Array, "K 4 3"],
    nominal: Float[Array, "K 4 3"],
) -> Response:
    """Roll out nominal forces, and the response to changes of them.

    Args:
      body: mass and inertia.
      start: now.
      length: of the nodes [s].
      feet: contact points of each leg in each node, world [m].
      nominal: force of each leg in each node, 0 in the air, world [N].
    """
    states = srb_spatial.rollout(body, start, Contacts(feet, nominal), length)
    now, then = (
        jax.tree.map(lambda a, s=s: a[s], states) for s in (slice(None, -1), slice(1, None))
    )
    A, B, _ = jax.vmap(node_response, (None, 0, 0, 0, 0))(
        body, now, then, length, Contacts(feet, nominal)
    )
    omega, outputs = jax.vmap(read_outputs, (None, 0))(body, then)
    return Response(states, omega, A, B, outputs)


def read_outputs(
    body: SpatialBody, state: BodyState
) -> tuple[Float[Array, "3"], Float[Array, "12 12"]]:
    """Angular velocity of a state; attitude, place, angular velocity and velocity by x."""
    W = state.R @ rotations.inverse(body.inertia) @ state.R.T
    omega = W @ state.L
    turning = W @ skew(state.L) - skew(omega)
    outputs = jnp.eye(STATE, dtype=omega.dtype).at[6:9].set(0.0)
    return omega, outputs.at[6:9, :3].set(turning).at[6:9, 6:9].set(W)


def node_response(
    body: SpatialBody,
    now: BodyState,
    then: BodyState,
    h: Float[Array, ""],
    contacts: Contacts,
) -> tuple[Float[Array, "12 12"], Float[Array, "4 12 3"], Float[Array, "2 12 3"]]:
    """A and B of one node, and the response to another force at the centre of mass and moment.

    Exact but for d, which is by the implicit midpoint rule.

    Args:
      body: mass and inertia.
      now: nominal state.
      then: the same at the node's end.
      h: length of the node [s].
      contacts: in the node, with nominal forces.
    """
    m, total = body.mass, contacts.force.sum(axis=0)
    eye, zero = jnp.eye(3, dtype=h.dtype), jnp.zeros((3, 3), h.dtype)
    a = srb_spatial.gravity(h.dtype) + total / m
    if contacts.other is not None:
        a = a + contacts.other[0] / m
    mean = now.p + h / 2 * now.v + h**2 / 6 * a  # of the path over the node
    pull = h * skew(total)
    R_mid = rotations.exp(h / 2 * srb_spatial.angular_velocity(body, now.R, now.L)) @ now.R
    W = R_mid @ rotations.inverse(body.inertia) @ R_mid.T
    half = h / 2 * W @ skew((now.L + then.L) / 2)
    back = rotations.inverse(eye - half)
    by_L = h / 2 * back @ W  # of d by the sum of Lam before and after

    # Rows: d, p, Lam, v. d sees the mean of Lam before and after the node.
    L_row = jnp.concatenate([zero, pull, eye, h / 2 * pull], axis=1)
    L_now = jnp.concatenate([zero, zero, eye, zero], axis=1)
    d_row = jnp.concatenate([back @ (eye + half), zero, zero, zero], axis=1)
    d_row = d_row + by_L @ (L_row + L_now)
    A = jnp.concatenate(
        [
            d_row,
            jnp.concatenate([zero, eye, zero, h * eye], axis=1),
            L_row,
            jnp.concatenate([zero, zero, zero, eye], axis=1),
        ]
    )
    L_by_force = h**2 / (6 * m) * pull  # at the centre of mass
    L_by_foot = h * skew(contacts.feet - mean[None]) + L_by_force[None]
    place = jnp.broadcast_to(h**2 / (2 * m) * eye, (4, 3, 3))
    speed = jnp.broadcast_to(h / m * eye, (4, 3, 3))
    B = jnp.concatenate([by_L[None] @ L_by_foot, place, L_by_foot, speed], axis=1)
    by_force = jnp.concatenate([by_L @ L_by_force, place[0], L_by_force, speed[0]])
    by_moment = jnp.concatenate([h * by_L, zero, h * eye, zero])
    return A, B, jnp.stack([by_force, by_moment])


def shifted(
    memory: MomentumMemory,
    grid: Grid,
    otherwise: Float[Array, "K 4 3"],
    passed: float,
) -> Float[Array, "K 4 3"]:
    """The last plan's forces in the nodes of a new grid: what the prediction is made about.

    Args:
      memory: the last plan.
      grid: new nodes.
      otherwise: forces of legs that pressed nothing then, and beyond the plan's end [N].
      passed: time since the plan [s].
    """
    node, within = node_at(memory.end, passed + grid.end - 0.5 * grid.length)
    force = memory.force[node]
    known = (within & memory.planned)[:, None] & (force[..., 2] != 0.0)
    force = jnp.where(known[..., None], force, otherwise)
    return jnp.where(grid.stance[..., None], force, 0.0)


def errors(
    response: Response, targets: Targets
) -> tuple[Float[Array, "K 12"], Float[Array, "K 12 n"]]:
    """Errors of the nominal states (attitude, position, omega, velocity), and how x changes them.

    In the axes of the targets' heading.

    Args:
      response: with the nominal states.
      targets: at the nodes' ends.
    """

    def one(state: BodyState, omega: Array, outputs: Array, target: Targets) -> Any:
        e = rotations.log(state.R @ target.R.T)
        K = skew(e)
        by_turn = jnp.eye(3, dtype=e.dtype) - K / 2 + K @ K / 12
        error = jnp.stack([e, state.p - target.p, omega - target.omega, state.v - target.v])
        c, s = target.heading
        o = jnp.zeros_like(c)
        to_heading = jnp.stack(
            [jnp.stack([c, s, o]), jnp.stack([-s, c, o]), jnp.stack([o, o, o + 1])]
        )
        rows = jnp.concatenate([(by_turn @ outputs[:3]), outputs[3:]]).reshape(4, 3, -1)
        C = jnp.einsum("ij,gjn->gin", to_heading, rows).reshape(STATE, -1)
        return (error @ to_heading.T).reshape(-1), C

    then = jax.tree.map(lambda a: a[1:], response.states)
    return jax.vmap(one)(then, response.omega, response.outputs, targets)


def foot_rows(
    limits: Limits,
    axes: Float[Array, "3 3"],
    torques: Float[Array, "K 4 3 3"],
) -> FootRows:
    """Rows of friction cones, pyramids of ``SIDES`` sides about the circle, and of joint torques.

    Args:
      limits: of both.
      axes: of the cones in its columns, the third one the ground's normal [-].
      torques: (K, 4, 3, 3) torque of each joint per force of its foot, world [m].
    """
    mu = limits.friction
    angles = np.arange(SIDES) * 2 * np.pi / SIDES
    sides = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    cone = jnp.concatenate(
        [jnp.asarray(sides, mu.dtype), jnp.broadcast_to(-mu, (SIDES, 1))], axis=-1
    )
    most = jnp.concatenate([jnp.zeros_like(mu, shape=(SIDES,)), limits.torque])
    cones = jnp.broadcast_to(cone @ axes.T, (*torques.shape[:2], SIDES, 3))
    return FootRows(
        matrix=jnp.concatenate([cones, torques], axis=2),
        low=jnp.concatenate([jnp.full_like(mu, -jnp.inf, shape=(SIDES,)), -limits.torque]),
        high=most,
        force_z=limits.force_z,
    )


def solve(
    response: Response,
    grid: Grid,
    nominal: Float[Array, "K 4 3"],
    targets: Targets,
    weights: Weights,
    rows: FootRows,
    listed: FootNodes,
    *,
    tolerance: float = 1e-6,
    max_iterations: int = 200,
) -> MomentumPlan:
    """Forces over the horizon. Nine arguments: the problem's data, each of another origin.

    Args:
      response: of the body to changes of the nominal forces.
      grid: nodes.
      nominal: forces that the prediction is made about, 0 in the air, world [N].
      targets: at the nodes' ends.
      weights: of their errors.
      rows: that the forces keep to.
      listed: feet that press.
      tolerance: at which the QP counts as solved [-].
      max_iterations: of the QP.
    """
    error, C = errors(response, targets)
    G = _condensed(response, listed)  # (K, 12, 3F)
    Y = C @ G
    weight = jnp.concatenate([weights.attitude, weights.position, weights.omega, weights.velocity])
    weight = grid.length[:, None] * weight[None]
    n = Y.shape[-1]
    weighted = (Y * weight[..., None]).reshape(-1, n)
    used = jnp.repeat(listed.used, 3)
    cost = jnp.where(used, jnp.repeat(weights.force * grid.length[listed.node], 3), 1.0)
    where = (listed.node, listed.leg)
    base = nominal[where]
    H = 2.0 * (weighted.T @ Y.reshape(-1, n) + jnp.diag(cost))
    away = jnp.where(used, (base - targets.force[where]).reshape(-1), 0.0)
    q = 2.0 * (weighted.T @ error.reshape(-1) + cost * away)

    solution = qp.solve_block_rows(
        H, q, *_row_problem(rows, listed, base),
        tolerance=tolerance, max_iterations=max_iterations,
    )  # fmt: skip
    change = jnp.where(used, solution.x, 0.0).reshape(-1, 3)
    force = nominal.at[where].add(change)
    return MomentumPlan(
        force=force,
        status=solution.status,
        residual=jnp.maximum(jnp.maximum(solution.primal, solution.dual), solution.gap),
        iterations=solution.iterations,
    )


def _condensed(response: Response, listed: FootNodes) -> Float[Array, "K n forces"]:
    """How x at each node's end depends on the changes of the listed forces."""
    own = response.B[listed.node, listed.leg] * listed.used[:, None, None]  # (F, n, 3)
    own = jnp.moveaxis(own, 0, 1)

    def one(G: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        A, k = now
        here = jnp.where((listed.node == k)[None, :, None], own, 0.0)
        G = jnp.einsum("ij,jfc->ifc", A, G) + here
        return G, G

    K, n = response.A.shape[:2]
    _, G = jax.lax.scan(one, jnp.zeros_like(own), (response.A, jnp.arange(K)))
    return G.reshape(K, n, -1)


def _row_problem(
    rows: FootRows, listed: FootNodes, base: Float[Array, "F 3"]
) -> tuple[qp.BlockRows, Array, Array]:
    """Rows, and the box, of the changes of the listed forces."""
    own = rows.matrix[listed.node, listed.leg] * listed.used[:, None, None]  # (F, r, 3)
    value = jnp.einsum("frc,fc->fr", own, base)
    free = jnp.full_like(base[:, :2], jnp.inf)
    low = jnp.concatenate([-free, (rows.force_z[0] - base[:, 2])[:, None]], axis=1)
    high = jnp.concatenate([free, (rows.force_z[1] - base[:, 2])[:, None]], axis=1)
    low, high = (jnp.where(listed.used[:, None], a, 0.0).reshape(-1) for a in (low, high))
    return qp.BlockRows(own, rows.low[None] - value, rows.high[None] - value), low, high
