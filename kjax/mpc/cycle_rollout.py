"""Prediction over a gait cycle about the last plan: moment arms that move with body and feet.

The pitch acceleration is bilinear in place and force. About nominal forces F_b, which put the
centre of mass on a path p_b and the feet on places r_b, it is to the first order

    I omega' = (r_b - p_b) x F - (p - p_b) x F_b + (r - r_b) x F_b

The second term is the toppling moment of gravity: sum F_b = m (a_b - g) is what carries the body,
and a body that gets ahead of its path is tipped over by it. The third is its remedy. A foot that
stands stays (r = r_b), one that comes is put down where Raibert's law says, which follows the body:

    r = p(t) + ahead + gain v(t)   along the way, t the touchdown

The nominal forces are those of the last plan, shifted, as in ``mpc.momentum``: what is left out is
a product of two changes since then, and when nothing disturbs, nothing changes. The forces that the
gait's reference takes are further away: about them, pitch is predicted worse than about a plan.

1. Place and velocity under nominal forces, exact: constant force in a node.
2. Their integrals over each node, which the moments of a held force are made of.
3. Pitch and its rate under nominal forces, exact.
4. The derivative of all of it by every node's force, exact too.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.mpc.grid import node_at
from kjax.mpc.horizon import HorizonForecast, MultiPhaseParams, Nodes
from kjax.types import GRAVITY


class CycleMemory(NamedTuple):
    """The last plan over a gait cycle, for the next one to be made about.

    Attributes:
      force: (K, 2) force (x, z) per standing foot in each node, world frame [N].
      end: (K,) time from the last tick to the node's end; not above 0 where none is planned [s].
    """

    force: Float[Array, "K 2"]
    end: Float[Array, "K"]


class Rollout(NamedTuple):
    """States under nominal forces, and how every node's force changes them.

    Attributes:
      states: (K, 6) at the nodes' ends.
      by_force: (K, 6, K, 2) their derivative by the force per standing foot in each node.
      path: (K, 3) mean (x, z, theta) over each node [m, rad].
      foot: (K, 2) contact point of the standing end, world [m].
    """

    states: Float[Array, "K 6"]
    by_force: Float[Array, "K 6 K 2"]
    path: Float[Array, "K 3"]
    foot: Float[Array, "K 2"]


def start_cycle(nodes: int, like: Float[Array, "..."]) -> CycleMemory:
    """Memory without a plan, of ``nodes`` nodes and the type of ``like``."""
    return CycleMemory(
        force=jnp.zeros_like(like, shape=(nodes, 2)), end=jnp.zeros_like(like, shape=(nodes,))
    )


def aged(memory: CycleMemory | None, passed: float) -> CycleMemory | None:
    """Memory after a tick of ``passed`` [s] without a new plan."""
    return None if memory is None else memory._replace(end=memory.end - passed)


def shifted(
    memory: CycleMemory, nodes: Nodes, otherwise: Float[Array, "K"], passed: float
) -> Float[Array, "K 2"]:
    """The last plan's forces (K, 2) in the nodes of a new grid [N].

    Args:
      memory: the last plan.
      nodes: of the new grid.
      otherwise: (K,) vertical force of feet that pressed nothing then, and beyond its end [N].
      passed: time since the last tick [s].
    """
    node, within = node_at(memory.end, passed + nodes.middle)
    force = memory.force[node]
    known = within & (force[:, 1] != 0.0)
    vertical = jnp.stack([jnp.zeros_like(otherwise), otherwise], axis=-1)
    return jnp.where(known[:, None], force, vertical) * (nodes.feet > 0)[:, None]


def roll_out(
    params: MultiPhaseParams,
    nodes: Nodes,
    forecast: HorizonForecast,
    x: Float[Array, "6"],
    nominal: Float[Array, "K 2"],
) -> Rollout:
    """Motion under nominal forces, and its response to changes of them.

    Args:
      params: mass and inertia.
      nodes: grid.
      forecast: where feet stand, and Raibert's law for those to come.
      x: state now.
      nominal: (K, 2) force per standing foot in each node, world frame [N].
    """
    t, h, inertia = nodes.end, nodes.length, params.inertia
    begin = t - h
    eye = jnp.eye(t.shape[0], dtype=t.dtype)
    past = jnp.tril(jnp.ones_like(eye))
    step = (h * nodes.feet / params.mass)[None]  # of the velocity, per force
    total = nominal * nodes.feet[:, None]
    g = jnp.stack([jnp.zeros_like(x[0]), jnp.full_like(x[0], -GRAVITY)])[None]
    H = h[:, None]

    # Step 1. A gain (k, j) says what the force of node j adds to a velocity, a lag to a place.
    def lag(gain: Array, time: Array) -> Array:
        return gain * (time[:, None] - nodes.middle[None])

    def place(gain: Array, time: Array) -> Array:
        s = time[:, None]
        return x[None, :2] + x[None, 3:5] * s + g * s**2 / 2 + lag(gain, time) @ nominal

    def velocity(gain: Array, time: Array) -> Array:
        return x[None, 3:5] + g * time[:, None] + gain @ nominal

    gain, gain_begin = past * step, (past - eye) * step
    # Half the shortest node's length is far beyond rounding.
    gain_touchdown = jnp.where(nodes.middle[None] < nodes.begin[:, None], step, 0.0)
    lag_begin, lag_touchdown = lag(gain_begin, begin), lag(gain_touchdown, nodes.begin)
    p, v, a = place(gain_begin, begin), velocity(gain_begin, begin), total / params.mass + g
    follows = ~nodes.present
    along = place(gain_touchdown, nodes.begin)[:, 0] + forecast.ahead
    along = along + forecast.by_speed * velocity(gain_touchdown, nodes.begin)[:, 0]
    foot = forecast.foot.at[:, 0].set(jnp.where(follows, along, forecast.foot[:, 0]))

    # Step 2: the place over the node, integrated once and twice.
    once = H * p + H**2 / 2 * v + H**3 / 6 * a
    twice = H**2 / 2 * p + H**3 / 6 * v + H**4 / 24 * a
    arm_once, arm_twice = H * foot - once, H**2 / 2 * foot - twice

    # Step 3.
    rate, angle = _moment(arm_once, total) / inertia, _moment(arm_twice, total) / inertia
    left = past * (t[:, None] - t[None])  # time in which a rate of node j turns the body
    omega = x[5] + past @ rate
    theta = x[2] + x[5] * t + left @ rate + past @ angle
    states = jnp.concatenate(
        [place(gain, t), theta[:, None], velocity(gain, t), omega[:, None]], axis=1
    )

    # Step 4. A force acts on its own node's arm, and moves all later arms.
    own = eye * step
    foot_by_force = (lag_touchdown + forecast.by_speed[:, None] * gain_touchdown) * follows[:, None]
    once_by = H * lag_begin + H**2 / 2 * gain_begin + H**2 / 6 * own
    twice_by = H**2 / 2 * lag_begin + H**3 / 6 * gain_begin + H**3 / 24 * own

    def turn(arm: Array, place_by: Array, arm_by: Array) -> Array:
        direct = eye * nodes.feet[:, None]
        by_x = -direct * arm[:, 1:] + arm_by * total[:, 1:]
        by_z = direct * arm[:, :1] + place_by * total[:, :1]
        return jnp.stack([by_x, by_z], axis=-1) / inertia

    rate_by = turn(arm_once, once_by, H * foot_by_force - once_by)
    angle_by = turn(arm_twice, twice_by, H**2 / 2 * foot_by_force - twice_by)
    omega_by = jnp.einsum("ki,ijf->kjf", past, rate_by)
    theta_by = jnp.einsum("ki,ijf->kjf", left, rate_by) + jnp.einsum("ki,ijf->kjf", past, angle_by)
    plane = jnp.eye(2, dtype=t.dtype)
    place_by, velocity_by = (
        jnp.einsum("kj,af->kajf", gains, plane) for gains in (lag(gain, t), gain)
    )
    middle = 0.5 * (jnp.concatenate([x[2:3], theta[:-1]]) + theta)
    return Rollout(
        states=states,
        by_force=jnp.concatenate(
            [place_by, theta_by[:, None], velocity_by, omega_by[:, None]], axis=1
        ),
        path=jnp.concatenate([p + H / 2 * v + H**2 / 6 * a, middle[:, None]], axis=1),
        foot=foot,
    )


def _moment(arm: Float[Array, "K 2"], force: Float[Array, "K 2"]) -> Float[Array, "K"]:
    """Nose-up moment of forces (x, z)."""
    return arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
