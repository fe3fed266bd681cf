"""The rigid body's data, and what each model predicts of it."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.dynamics import rotations, spatial_data
from kjax.dynamics.spatial_data import Data, footholds
from kjax.dynamics.srb_spatial import BodyState, SpatialBody
from kjax.koopman import so3
from kjax.mpc.response import PredictionTask, Response, Targets
from kjax.mpc.rigid_models import PREDICTIONS
from kjax.robots import get_robot
from kjax.types import GRAVITY

NODE, NODES = 0.025, 8  # s
AT = (2, 4, 8)  # nodes after which errors are taken
LEGS = {"trot": (0, 3), "stand": (0, 1, 2, 3)}
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
    """Roll-outs of the Go1's body, nodes of ``NODE``; arguments as of ``spatial_data.draw``."""
    hips = footholds(get_robot("go1").params)
    return spatial_data.draw(
        body, hips, seed, legs, count=count, nodes=nodes, dt=NODE, anywhere=anywhere
    )


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
        response = PREDICTIONS[model](
            PredictionTask(body, start, length, contacts, nominal, targets)
        )
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


def learned(data: Data, steps: Data, legs: tuple[int, ...]) -> dict[str, Guess]:
    """The same by models that EDMD finds from single steps."""
    return {name: _by_edmd(data, steps, name, legs) for name in EDMD}


def _forces(legs: tuple[int, ...], feet: Array, force: Array, about: Array) -> Array:
    del feet, about
    return force[jnp.asarray(legs)].reshape(-1)


def _wrench(legs: tuple[int, ...], feet: Array, force: Array, about: Array) -> Array:
    del legs
    return so3.wrench(feet, force, about)


# Inputs of a step (legs that stand, feet, forces, a point of the path), and whether it is bilinear.
EDMD: dict[str, tuple[Callable[..., Array], bool]] = {
    "edmd_forces": (_forces, False), "edmd_wrench": (_wrench, False), "bilinear": (_wrench, True),
}  # fmt: skip


@partial(jax.jit, static_argnames=("name", "legs"))
def _edmd(data: Data, steps: Data, name: str, legs: tuple[int, ...]) -> Float[Array, "N K 28"]:
    """Fit increments of one step, and roll the lifted states out."""
    inputs, bilinear = EDMD[name]
    used = jax.vmap(partial(inputs, legs))(steps.feet, steps.force[:, 0], steps.states.p[:, 0])
    model = so3.fit(so3.lifted(steps, 0), used, so3.lifted(steps, 1), NODE, bilinear=bilinear)
    K = data.force.shape[1]

    def roll(z: Array, feet: Array, force: Array, p: Array, v: Array) -> Array:
        def node(z: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            about = z[so3.P] if bilinear else now[1]  # its own place, or that on the path
            u = inputs(legs, feet, now[0], about)
            z = so3.step(model, z, u, NODE, bilinear=bilinear)
            return z, z

        path = p + NODE * jnp.arange(K)[:, None] * v  # at the nodes' beginnings
        return jax.lax.scan(node, z, (force, path))[1]

    p, v = data.states.p[:, 0], data.states.v[:, 0]
    return jax.vmap(roll)(so3.lifted(data, 0), data.feet, data.force, p, v)


def _by_edmd(data: Data, steps: Data, name: str, legs: tuple[int, ...]) -> Guess:
    found = np.asarray(_edmd(data, steps, name, legs))
    # The nearest rotation.
    U, _, V = np.linalg.svd(found[..., so3.ROTATION].reshape(*found.shape[:2], 3, 3))
    U[..., 2] *= np.sign(np.linalg.det(U @ V))[..., None]
    return jnp.asarray(U @ V), jnp.asarray(found[..., so3.OMEGA])
