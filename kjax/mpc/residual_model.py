"""The momentum form with what the whole robot does besides, as a ``Response``.

``prediction.residual_wrench`` adds a force and a moment to each node, from the state at its
beginning and its forces. Their own dependence on both goes into A and B.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts
from kjax.mpc.momentum import node_response, read_outputs
from kjax.mpc.response import PredictionTask, Response
from kjax.prediction.residual_wrench import ResidualWrench, wrench


def residual(task: PredictionTask) -> Response:
    """Roll out, and linearise along the way."""
    body, model = task.body, task.learned
    assert isinstance(model, ResidualWrench)
    assert task.phase is not None

    def missing(state: BodyState, force: Array, phase: Array) -> Array:
        omega = srb_spatial.angular_velocity(body, state.R, state.L)
        return wrench(model, state, omega, force, phase)

    def roll(
        state: BodyState, now: tuple[Array, Array, Array, Array]
    ) -> tuple[BodyState, tuple[BodyState, Array]]:
        feet, force, h, phase = now
        other = missing(state, force, phase)
        then = srb_spatial.step(body, state, Contacts(feet, force, other), h)
        return then, (then, other)

    given = (task.feet, task.nominal, task.length, task.phase)
    _, (then, other) = jax.lax.scan(roll, task.start, given)
    states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), task.start, then)
    now = jax.tree.map(lambda a: a[:-1], states)

    def node(
        now: BodyState, then: BodyState, h: Array, phase: Array, contacts: Contacts
    ) -> tuple[Array, Array]:
        A, B, P = node_response(body, now, then, h, contacts)

        def changed(x: Array, u: Array) -> Array:
            """The wrench after changes of the state and of the forces; Lam changes as L does."""
            d, p, L, v = x.reshape(4, 3)
            state = BodyState(now.p + p, rotations.exp(d) @ now.R, now.v + v, now.L + L)
            return missing(state, contacts.force + u, phase)

        nothing = jnp.zeros((A.shape[0],), A.dtype)
        by_x, by_u = jax.jacfwd(changed, argnums=(0, 1))(nothing, jnp.zeros_like(contacts.force))
        A = A + jnp.einsum("wnf,wfx->nx", P, by_x)
        return A, B + jnp.einsum("wnf,wflc->lnc", P, by_u)

    contacts = Contacts(task.feet, task.nominal, other)
    A, B = jax.vmap(node)(now, then, task.length, task.phase, contacts)
    omega, outputs = jax.vmap(read_outputs, (None, 0))(body, then)
    return Response(states, omega, A, B, outputs)
