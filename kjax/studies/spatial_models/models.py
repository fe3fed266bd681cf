"""The rigid body's data, and what each model predicts of it."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.rotations import skew
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.koopman import regression
from kjax.mpc.momentum import Response, Targets
from kjax.mpc.rigid_models import PREDICTIONS
from kjax.robots import get_robot
from kjax.types import GRAVITY

NODE, NODES = 0.025, 8  # s
AT = (2, 4, 8)  # nodes after which errors are taken
LEGS = {"trot": (0, 3), "stand": (0, 1, 2, 3)}
HEIGHT = 0.27  # m, of the centre of mass above the feet
FORCE_ERROR = 0.2  # of the plan that the last model is linearised about
# Names and titles of the models, in the order of the table.
TITLES = {
    "hold": "hold the state",
    "convex": "Di Carlo 2018: yaw only, no gyroscopic term",
    "present": "rigid body linearised at the present state",
    "edmd_forces": "linear EDMD, SO(3) observables, forces of the legs",
    "edmd_wrench": "the same, wrench of the measured feet",
    "bilinear": "bilinear EDMD, vec(R) times wrench",
    "momentum": "momentum, attitude about the roll-out of the mean forces",
    "momentum_plan": "the same about a plan with 20 % force error",
}


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


def rigid_body() -> SpatialBody:
    """The Go1's."""
    robot = get_robot("go1").params
    return SpatialBody(mass=jnp.asarray(float(robot.mass)), inertia=jnp.asarray(robot.inertia))


def draw(
    body: SpatialBody,
    seed: Sequence[int],
    legs: Sequence[int],
    count: int,
    nodes: int,
    anywhere: bool,
) -> Data:
    """Roll-outs that stay within 4.5 rad/s and 0.6 rad of tilt.

    Args:
      body: whose.
      seed: of the draw.
      legs: that stand.
      count: number of roll-outs.
      nodes: of each.
      anywhere: with a heading of up to 0.7 rad and a place of up to 0.3 m, not at the origin.
    """
    rng, hips = np.random.default_rng(seed), _hips()
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
        drawn = _roll_out(body, p, tilt, yaw, omega, v, feet, force)
        up = np.asarray(drawn.states.R)[..., 2, 2]
        fair = (np.abs(drawn.omega).max(axis=(1, 2)) < 4.5) & (up.min(axis=1) > np.cos(0.6))
        kept = np.flatnonzero(fair)[:missing]
        parts.append(jax.tree.map(lambda a, i=kept: np.asarray(a)[i], drawn))
        missing -= len(kept)
    return jax.tree.map(lambda *a: jnp.asarray(np.concatenate(a)), *parts)


def _hips() -> np.ndarray:
    """Where the feet should stand (4, 3), from the centre of mass [m]."""
    robot = get_robot("go1").params
    side = np.sign(np.asarray(robot.hip_pos)[:, 1]) * np.abs(np.asarray(robot.abduction_offset))
    hips = np.asarray(robot.hip_pos, float).copy()
    hips[:, 1] += side
    hips[:, 2] = 0.0
    return hips


@jax.jit
def _roll_out(
    body: SpatialBody, p: Array, tilt: Array, yaw: Array, omega: Array, v: Array, feet: Array,
    force: Array,
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
        states = srb_spatial.rollout(body, start, contacts, jnp.full(K, NODE), substeps=10)
        return Data(feet, F, states, _omegas(body, states))

    return jax.vmap(one)(p, tilt, yaw, omega, v, feet, force)


def _omegas(body: SpatialBody, states: BodyState) -> Float[Array, "K 3"]:
    return jax.vmap(srb_spatial.angular_velocity, (None, 0, 0))(body, states.R, states.L)


def predicted(seed: int, mode: str, train: int, test: int) -> dict[str, list[tuple[float, float]]]:
    """RMS errors of attitude [deg] and its rate [rad/s] of each model after ``AT`` nodes."""
    body, legs = rigid_body(), LEGS[mode]
    held_out = draw(body, [seed, 1, len(legs)], legs, test, NODES, anywhere=False)
    steps = draw(body, [seed, 2, len(legs)], legs, train, 1, anywhere=True)
    guesses = analytic(body, held_out, legs, seed) | learned(held_out, steps, legs)
    out = {}
    for name in TITLES:
        R, omega = guesses[name]
        off = jax.vmap(jax.vmap(rotations.log))(R @ jnp.swapaxes(held_out.states.R[:, 1:], -1, -2))
        wrong = omega - held_out.omega[:, 1:]
        out[name] = [
            (float(np.degrees(_rms(off[:, k - 1]))), float(_rms(wrong[:, k - 1]))) for k in AT
        ]
    return out


def _rms(vectors: Float[Array, "N 3"]) -> Any:
    return np.sqrt(np.mean(np.sum(np.asarray(vectors) ** 2, axis=-1)))


Guess = tuple[Float[Array, "N K 3 3"], Float[Array, "N K 3"]]


def analytic(body: SpatialBody, data: Data, legs: Sequence[int], seed: int) -> dict[str, Guess]:
    """Attitude and rate at the nodes' ends by the models that need no data."""
    K = data.force.shape[1]
    share = np.zeros((4, 3))
    share[list(legs), 2] = float(body.mass) * GRAVITY / len(legs)
    mean = jnp.broadcast_to(jnp.asarray(share), data.force.shape)
    rng = np.random.default_rng([seed, 3])
    plan = data.force * (1.0 + FORCE_ERROR * jnp.asarray(rng.standard_normal(data.force.shape)))
    start = jax.tree.map(lambda a: a[:, 0], data.states)
    held = (
        jnp.repeat(start.R[:, None], K, axis=1), jnp.repeat(data.omega[:, :1], K, axis=1),
    )  # fmt: skip
    out: dict[str, Guess] = {"hold": held}
    for name, model, nominal in (
        ("convex", "convex", mean), ("present", "present", mean), ("momentum", "momentum", mean),
        ("momentum_plan", "momentum", plan),
    ):  # fmt: skip
        out[name] = _by_response(body, model, start, data.feet, data.force, nominal)
    return out


@partial(jax.jit, static_argnames="model")
def _by_response(
    body: SpatialBody, model: str, start: BodyState, feet: Array, force: Array, nominal: Array
) -> Guess:
    """What the LMPC predicts with: a nominal roll-out, and its change by the forces' changes."""
    K = force.shape[1]
    length, time = jnp.full(K, NODE), NODE * jnp.arange(1, K + 1)

    def one(start: BodyState, feet: Array, force: Array, nominal: Array) -> Guess:
        heading = start.R[:2, 0] / jnp.linalg.norm(start.R[:2, 0])
        targets = Targets(
            R=jnp.broadcast_to(jnp.eye(3), (K, 3, 3)),
            p=start.p + time[:, None] * start.v,
            omega=jnp.zeros((K, 3)),
            v=jnp.broadcast_to(start.v, (K, 3)),
            heading=jnp.broadcast_to(heading, (K, 2)),
            force=nominal,
        )
        contacts = jnp.broadcast_to(feet, (K, 4, 3))
        response = PREDICTIONS[model](body, start, length, contacts, nominal, targets)
        change = _changes(response, force - nominal)
        R = jax.vmap(rotations.exp)(change[:, :3]) @ response.states.R[1:]
        return R, response.omega + change[:, 6:9]

    return jax.vmap(one)(start, feet, force, nominal)


def _changes(response: Response, u: Float[Array, "K 4 3"]) -> Float[Array, "K 12"]:
    """Changes of attitude, place, rate and velocity at the nodes' ends by changes of the forces."""

    def node(x: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
        A, B, outputs, u = now
        x = A @ x + jnp.einsum("lnf,lf->n", B, u)
        return x, outputs @ x

    first = jnp.zeros(response.A.shape[-1])
    return jax.lax.scan(node, first, (response.A, response.B, response.outputs, u))[1]


def lift(p: Array, v: Array, R: Array, omega: Array) -> Float[Array, "28"]:
    """SO(3) observables: (1, p, v, vec(R), omega, vec(R [omega_b]))."""
    turning = R @ skew(R.T @ omega)
    return jnp.concatenate([jnp.ones(1), p, v, R.reshape(-1), omega, turning.reshape(-1)])


def learned(data: Data, steps: Data, legs: tuple[int, ...]) -> dict[str, Guess]:
    """The same by models that EDMD finds from single steps."""
    return {name: _by_edmd(data, steps, name, legs) for name in REGRESSORS}


def _wrench(feet: Array, force: Array, about: Array) -> Float[Array, "6"]:
    """Sum of the forces, and of their moments about a point."""
    return jnp.concatenate([force.sum(axis=0), jnp.cross(feet - about, force).sum(axis=0)])


def _forces(z: Array, legs: tuple[int, ...], feet: Array, force: Array, path: Array) -> Array:
    return jnp.concatenate([z, force[jnp.asarray(legs)].reshape(-1)])


def _wrenches(z: Array, legs: tuple[int, ...], feet: Array, force: Array, path: Array) -> Array:
    return jnp.concatenate([z, _wrench(feet, force, path)])


def _products(z: Array, legs: tuple[int, ...], feet: Array, force: Array, path: Array) -> Array:
    wrench = _wrench(feet, force, z[1:4])  # about its own place
    return jnp.concatenate([z, wrench, jnp.outer(z[7:16], wrench).reshape(-1)])


# Regressors of a step: lifted state, legs that stand, feet, forces, a point of the expected path.
REGRESSORS: dict[str, Callable[..., Array]] = {
    "edmd_forces": _forces, "edmd_wrench": _wrenches, "bilinear": _products,
}  # fmt: skip


def _lifted(drawn: Data, k: int) -> Float[Array, "N 28"]:
    now = jax.tree.map(lambda a: a[:, k], drawn.states)
    return jax.vmap(lift)(now.p, now.v, now.R, drawn.omega[:, k])


@partial(jax.jit, static_argnames=("name", "legs"))
def _edmd(data: Data, steps: Data, name: str, legs: tuple[int, ...]) -> Float[Array, "N K 28"]:
    """Fit increments of one step, and roll the lifted states out."""
    z, z_next = _lifted(steps, 0), _lifted(steps, 1)

    def regressors(z: Array, feet: Array, force: Array, path: Array) -> Array:
        return REGRESSORS[name](z, legs, feet, force, path)

    Z = jax.vmap(regressors)(z, steps.feet, steps.force[:, 0], steps.states.p[:, 0])
    W = regression.solve(regression.of_rows(Z, z_next - z), Z.shape[1]).W
    K = data.force.shape[1]

    def roll(z: Array, feet: Array, force: Array, p: Array, v: Array) -> Array:
        def node(z: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            z = z + regressors(z, feet, *now) @ W
            return z, z

        path = p + NODE * jnp.arange(K)[:, None] * v  # at the nodes' beginnings
        return jax.lax.scan(node, z, (force, path))[1]

    p, v = data.states.p[:, 0], data.states.v[:, 0]
    return jax.vmap(roll)(_lifted(data, 0), data.feet, data.force, p, v)


def _by_edmd(data: Data, steps: Data, name: str, legs: tuple[int, ...]) -> Guess:
    found = np.asarray(_edmd(data, steps, name, legs))
    # The nearest rotation.
    U, _, V = np.linalg.svd(found[..., 7:16].reshape(*found.shape[:2], 3, 3))
    U[..., 2] *= np.sign(np.linalg.det(U @ V))[..., None]
    return jnp.asarray(U @ V), jnp.asarray(found[..., 16:19])
