"""A tilted, turning body on its feet: what the tests of the spatial LMPC share."""

import jax.numpy as jnp
import numpy as np

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, SpatialBody
from kjax.gait import Clock, Gait, Phase, build_schedule
from kjax.mpc import grid, momentum

INERTIA = [[0.1273, -0.0004, -0.0144], [-0.0004, 0.3944, -0.0001], [-0.0144, -0.0001, 0.4228]]
BODY = SpatialBody(mass=jnp.asarray(12.743), inertia=jnp.asarray(INERTIA))
WEIGHT = 12.743 * 9.81
HIPS = np.array(
    [[0.19, -0.127, 0.0], [0.19, 0.127, 0.0], [-0.19, -0.127, 0.0], [-0.19, 0.127, 0.0]]
)
TROT = Gait("trot", (Phase((1, 0, 0, 1), 0.2), Phase((0, 1, 1, 0), 0.2)))
BOUND = Gait(
    "bound",
    (Phase((1, 1, 0, 0), 0.1), Phase((0,) * 4, 0.06), Phase((0, 0, 1, 1), 0.1),
     Phase((0,) * 4, 0.05)),
)  # fmt: skip
SCHEDULE = build_schedule([TROT, BOUND])


def clock(which, elapsed):
    return Clock(*map(jnp.asarray, (which, 0, 0)), elapsed=jnp.asarray(elapsed))


def nodes(which=0, elapsed=0.05, count=12, horizon=0.25):
    return grid.build_grid(
        SCHEDULE, clock(which, elapsed), count, node_dt=0.025, horizon=horizon, shortest=0.0025
    )


def problem(seed=0, which=0):
    """A tilted, turning body, its grid, feet and forces that share the weight."""
    rng = np.random.default_rng(seed)
    found = nodes(which)
    R = rotations.exp(jnp.asarray(rng.uniform(-0.2, 0.2, 3)))
    omega = rng.uniform(-1, 1, 3)
    start = BodyState(
        jnp.array([0.0, 0.0, 0.27]),
        R,
        jnp.asarray(rng.uniform(-0.4, 0.4, 3)),
        srb_spatial.momentum(BODY, R, jnp.asarray(omega)),
    )
    K = len(found.length)
    feet = jnp.broadcast_to(jnp.asarray(HIPS + rng.uniform(-0.03, 0.03, (4, 3))), (K, 4, 3))
    count = np.maximum(np.asarray(found.stance).sum(1), 1)[:, None, None]
    share = np.asarray(found.stance)[..., None] * np.array([0.0, 0.0, WEIGHT]) / count
    return start, found, feet, jnp.asarray(share)


def targets(found, force):
    K = len(found.length)
    return momentum.Targets(
        R=jnp.broadcast_to(jnp.eye(3), (K, 3, 3)),
        p=jnp.stack([0.3 * found.end, 0.0 * found.end, 0.27 + 0.0 * found.end], axis=-1),
        omega=jnp.zeros((K, 3)),
        v=jnp.broadcast_to(jnp.array([0.3, 0.0, 0.0]), (K, 3)),
        heading=jnp.broadcast_to(jnp.array([0.8, 0.6]), (K, 2)),
        force=force,
    )
