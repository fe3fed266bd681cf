"""Models on SO(3) observables that EDMD has found, as a ``Response``.

The lifted state z (28 of them, ``koopman.so3``) is rolled out under the nominal forces, and the
node's map z+ = f(z, F) is linearised along it. Learned for headings near zero, a model works in the
axes of the targets' heading. The linear one takes its moments about the path that is wanted, as a
fixed input map needs; the bilinear one about the place that it predicts.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.dynamics import srb_spatial
from kjax.dynamics.srb_spatial import BodyState
from kjax.koopman import so3
from kjax.mpc.response import PredictionTask, Response

SUBSTEPS = 2  # of a node: its longest is two of the model's own steps


def edmd(task: PredictionTask) -> Response:
    """Linear: every moment turns the body as it did on average."""
    return _predict(task, bilinear=False)


def bilinear(task: PredictionTask) -> Response:
    """With the products of attitude and wrench."""
    return _predict(task, bilinear=True)


def _predict(task: PredictionTask, *, bilinear: bool) -> Response:
    """Roll out, and linearise along the way."""
    model = task.learned
    assert isinstance(model, so3.So3Model)
    c, s = task.targets.heading[0]
    zero = jnp.zeros_like(c)
    Rz = jnp.stack(
        [jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.stack([zero, zero, zero + 1.0])]
    )
    origin = task.start.p * jnp.array([1.0, 1.0, 0.0], task.start.p.dtype)
    feet, nominal = (task.feet - origin[None, None]) @ Rz, task.nominal @ Rz
    targets = task.targets
    before = jnp.concatenate([targets.p[:1] - task.length[0] * targets.v[:1], targets.p[:-1]])
    middle = (0.5 * (before + targets.p) - origin[None]) @ Rz

    def node(z: Array, force: Array, feet: Array, about: Array, h: Array) -> Array:
        for _ in range(SUBSTEPS):
            place = z[so3.P] if bilinear else about
            u = so3.wrench(feet, force, place)
            z = so3.step(model, z, u, h / SUBSTEPS, bilinear=bilinear)
        return z

    def roll(z: Array, now: tuple[Array, ...]) -> tuple[Array, tuple[Array, Array]]:
        then = node(z, *now)
        return then, (z, then)

    omega = srb_spatial.angular_velocity(task.body, task.start.R, task.start.L)
    start = task.start
    first = so3.lift((start.p - origin) @ Rz, start.v @ Rz, Rz.T @ start.R, omega @ Rz)
    given = (nominal, feet, middle, task.length)
    _, (z, z_next) = jax.lax.scan(roll, first, given)
    A, B = jax.vmap(jax.jacfwd(node, argnums=(0, 1)))(z, *given)
    rate = z_next[:, so3.OMEGA] @ Rz.T
    states, outputs = jax.vmap(partial(_outputs, Rz))(z_next)
    inertia = states.R @ task.body.inertia[None] @ jnp.swapaxes(states.R, 1, 2)
    states = BodyState(
        p=states.p + origin[None], R=states.R, v=states.v, L=jnp.einsum("kij,kj->ki", inertia, rate)
    )
    states = jax.tree.map(lambda now, later: jnp.concatenate([now[None], later]), start, states)
    # Forces are given in the world's axes.
    B = jnp.einsum("knlf,gf->klng", B, Rz)
    return Response(states, rate, A, B, outputs)


def _outputs(
    Rz: Float[Array, "3 3"], z: Float[Array, "28"]
) -> tuple[BodyState, Float[Array, "12 28"]]:
    """State of a lifted one in the world's axes (no momentum yet), and how both change."""
    R = so3.nearest_rotation(z[so3.ROTATION].reshape(3, 3))

    def rotation_from(entries: Array) -> Array:
        """Turn from R to the rotation nearest to others, to first order."""
        D = so3.nearest_rotation(entries.reshape(3, 3)) @ R.T
        return 0.5 * jnp.stack([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])

    outputs = jnp.zeros((12, so3.SIZE), z.dtype)
    outputs = outputs.at[:3, so3.ROTATION].set(Rz @ jax.jacfwd(rotation_from)(z[so3.ROTATION]))
    outputs = outputs.at[3:6, so3.P].set(Rz).at[6:9, so3.OMEGA].set(Rz).at[9:, so3.V].set(Rz)
    p, v = Rz @ z[so3.P], Rz @ z[so3.V]
    return BodyState(p=p, R=Rz @ R, v=v, L=jnp.zeros_like(p)), outputs
