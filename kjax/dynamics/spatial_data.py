"""Random roll-outs of the rigid body in three dimensions: data for EDMD, and to test on."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.types import GRAVITY, RobotParams

HEIGHT = 0.27  # m, of the centre of mass above the feet


class Data(NamedTuple):
    """Roll-outs of the rigid body, (N, ...).

    Attributes:
      feet: (N, 4, 3) contact points, world [m].
      force: (N, K, 4, 3) forces, 0 in the air, world [N].
      states: (N, K + 1, ...) at the nodes' ends, the first one the start.
      omega: (N, K + 1, 3) angular velocity, world [rad/s].
    """

    feet: Float[Array, "N 4 3"]
    force: Float[Array, "N K 4 3"]
    states: BodyState
    omega: Float[Array, "N K_plus_1 3"]


def footholds(robot: RobotParams) -> Float[np.ndarray, "4 3"]:
    """Where the feet of a robot should stand, from the centre of mass, level [m]."""
    side = np.sign(np.asarray(robot.hip_pos)[:, 1]) * np.abs(np.asarray(robot.abduction_offset))
    hips = np.asarray(robot.hip_pos, float).copy()
    hips[:, 1] += side
    hips[:, 2] = 0.0
    return hips


def draw(
    body: SpatialBody,
    hips: Float[np.ndarray, "4 3"],
    seed: Sequence[int],
    legs: Sequence[int],
    *,
    count: int,
    nodes: int,
    dt: float,
    anywhere: bool,
) -> Data:
    """Roll-outs that stay within 4.5 rad/s and 0.6 rad of tilt.

    They tilt by up to 0.3 rad and turn by up to 3 rad/s; F_z is 0.3 to 1.7 of its share, horizontal
    forces up to 0.4 of F_z, feet up to 8 cm from where they should stand.

    Args:
      body: whose.
      hips: (4, 3) where its feet should stand, from the centre of mass, level [m].
      seed: of the draw.
      legs: that stand.
      count: number of roll-outs.
      nodes: of each, with a force of their own.
      dt: length of a node [s].
      anywhere: with a heading of up to 0.7 rad and a place of up to 0.3 m, not at the origin.
    """
    rng = np.random.default_rng(seed)
    parts, missing = [], count
    while missing > 0:
        n = 3 * missing + 100
        tilt, yaw = rng.uniform(-0.3, 0.3, (n, 2)), rng.uniform(-0.7, 0.7, n) * anywhere
        p = rng.uniform(-0.3, 0.3, (n, 3)) * anywhere
        omega = rng.uniform(-3.0, 3.0, (n, 3))
        v = rng.uniform(-1.0, 1.0, (n, 3)) * [1.0, 0.4, 0.3]
        feet = hips[None] + rng.uniform(-1.0, 1.0, (n, 4, 3)) * [0.08, 0.05, 0.0]
        feet[:, :, 2] = -HEIGHT + rng.uniform(-0.03, 0.03, (n, 1))
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        turned = [c * feet[..., 0] - s * feet[..., 1], s * feet[..., 0] + c * feet[..., 1]]
        feet = np.stack([*turned, feet[..., 2]], axis=-1) + p[:, None]
        force = np.zeros((n, nodes, 4, 3))
        load = float(body.mass) * GRAVITY / len(legs) * rng.uniform(0.3, 1.7, (n, nodes, len(legs)))
        sides = 0.4 * rng.uniform(-1.0, 1.0, (2, *load.shape)) * load
        force[:, :, list(legs)] = np.stack([*sides, load], axis=-1)
        drawn = _roll_out(body, p, tilt, yaw, omega, v, feet, force, dt=dt)
        up = np.asarray(drawn.states.R)[..., 2, 2]
        fair = (np.abs(drawn.omega).max(axis=(1, 2)) < 4.5) & (up.min(axis=1) > np.cos(0.6))
        kept = np.flatnonzero(fair)[:missing]
        parts.append(jax.tree.map(lambda a, i=kept: np.asarray(a)[i], drawn))
        missing -= len(kept)
    return jax.tree.map(lambda *a: jnp.asarray(np.concatenate(a)), *parts)


@partial(jax.jit, static_argnames="dt")
def _roll_out(
    body: SpatialBody, p: Array, tilt: Array, yaw: Array, omega: Array, v: Array, feet: Array,
    force: Array, *, dt: float,
) -> Data:  # fmt: skip
    """Truth: steps exact in place, velocity and momentum, attitude in ten substeps."""

    def one(p: Array, tilt: Array, yaw: Array, w: Array, v: Array, feet: Array, F: Array) -> Data:
        about_z = rotations.exp(jnp.append(jnp.zeros(2), yaw))
        about_y = rotations.exp(jnp.array([0.0, 1.0, 0.0]) * tilt[1])
        about_x = rotations.exp(jnp.array([1.0, 0.0, 0.0]) * tilt[0])
        R = about_z @ about_y @ about_x
        start = BodyState(p, R, v, srb_spatial.momentum(body, R, w))
        K = F.shape[0]
        contacts = Contacts(jnp.broadcast_to(feet, (K, 4, 3)), F)
        states = srb_spatial.rollout(body, start, contacts, jnp.full(K, dt), substeps=10)
        return Data(feet, F, states, angular_velocities(body, states))

    return jax.vmap(one)(p, tilt, yaw, omega, v, feet, force)


def angular_velocities(body: SpatialBody, states: BodyState) -> Float[Array, "K 3"]:
    """Of several states, world [rad/s]."""
    return jax.vmap(srb_spatial.angular_velocity, (None, 0, 0))(body, states.R, states.L)
