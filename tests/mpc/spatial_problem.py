"""A tilted, turning body on its feet: what the tests of the spatial LMPC share."""

import jax
import jax.numpy as jnp
import numpy as np

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, SpatialBody
from kjax.gait import Clock, Gait, Phase, build_schedule
from kjax.mpc import grid
from kjax.mpc.response import Targets

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


@jax.jit
def _grid(clock):
    return grid.build_grid(SCHEDULE, clock, 12, node_dt=0.025, horizon=0.25, shortest=0.0025)


@jax.jit
def _body(rotation, omega, v):
    R = rotations.exp(rotation)
    return BodyState(jnp.array([0.0, 0.0, 0.27]), R, v, srb_spatial.momentum(BODY, R, omega))


rollout = jax.jit(srb_spatial.rollout, static_argnames="substeps")


def nodes(which=0, elapsed=0.05):
    return jax.tree.map(np.asarray, _grid(clock(which, elapsed)))


def problem(seed=0, which=0):
    """A tilted, turning body, its grid, feet and forces that share the weight."""
    rng = np.random.default_rng(seed)
    found = nodes(which)
    rotation, omega, v = (rng.uniform(-most, most, 3) for most in (0.2, 1.0, 0.4))
    start = jax.tree.map(np.asarray, _body(rotation, omega, v))
    feet = np.tile(HIPS + rng.uniform(-0.03, 0.03, (4, 3)), (len(found.length), 1, 1))
    count = np.maximum(found.stance.sum(1), 1)[:, None, None]
    share = found.stance[..., None] * np.array([0.0, 0.0, WEIGHT]) / count
    return start, found, feet, share


def targets(found, force):
    K = len(found.length)
    return Targets(
        R=np.tile(np.eye(3), (K, 1, 1)),
        p=np.stack([0.3 * found.end, 0.0 * found.end, 0.27 + 0.0 * found.end], axis=-1),
        omega=np.zeros((K, 3)),
        v=np.tile([0.3, 0.0, 0.0], (K, 1)),
        heading=np.tile([0.8, 0.6], (K, 1)),
        force=force,
    )
