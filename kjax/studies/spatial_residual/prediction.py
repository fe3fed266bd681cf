"""How far the rigid body, with and without its residual, predicts a recorded episode."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.prediction.residual_wrench import ResidualWrench, wrench
from kjax.sysid.spatial_residual import SpatialEpisode

QUANTITIES = ("attitude", "place", "rate", "velocity")
UNITS = ("deg", "mm", "rad/s", "m/s")
NODE = 5  # ticks that a prediction takes in one step, as the LMPC's nodes of 25 ms


@partial(jax.jit, static_argnames=("ticks", "every"))
def errors(
    episodes: SpatialEpisode,
    body: SpatialBody,
    model: ResidualWrench | None,
    dt: float,
    *,
    ticks: int,
    every: int,
) -> Float[Array, "E S nodes 4"]:
    """Errors after each node of predictions from many starts, under recorded forces and feet.

    Forces, feet and footholds of a node are means over its ticks: what an LMPC plans with.

    Args:
      episodes: (E, T, ...).
      body: mass and inertia.
      model: residual, ``None`` for the rigid body alone.
      dt: control tick [s].
      ticks: length of the prediction, a multiple of ``NODE``.
      every: ticks from one start to the next.
    """

    def ahead(state: BodyState, now: tuple[Array, ...]) -> tuple[BodyState, BodyState]:
        feet, force, phase = now
        other = None
        if model is not None:
            omega = srb_spatial.angular_velocity(body, state.R, state.L)
            other = wrench(model, state, omega, force, phase)
        state = srb_spatial.step(body, state, Contacts(feet, force, other), NODE * dt)
        return state, state

    def of_episode(episode: SpatialEpisode) -> Array:
        starts = jnp.arange(0, episode.omega.shape[0] - ticks - 1, every)

        def of_start(start: Array) -> Array:
            def cut(a: Array) -> Array:
                return jax.lax.dynamic_slice_in_dim(a, start, ticks + 1)

            own = jax.tree.map(cut, episode)
            first = jax.tree.map(lambda a: a[0], own.states)
            feet, force = (
                a[:-1].reshape(-1, NODE, 4, 3).mean(axis=1) for a in (own.feet, own.force)
            )
            phase = own.phase[:-1].reshape(-1, NODE).mean(axis=1)
            _, states = jax.lax.scan(ahead, first, (feet, force, phase))
            true = jax.tree.map(lambda a: a[NODE::NODE], own.states)
            return jax.vmap(partial(_error, body))(states, true, own.omega[NODE::NODE])

        return jax.vmap(of_start)(starts)

    return jax.vmap(of_episode)(episodes)


def _error(body: SpatialBody, state: BodyState, true: BodyState, omega: Array) -> Array:
    rate = srb_spatial.angular_velocity(body, state.R, state.L)
    return jnp.stack(
        [
            jnp.degrees(jnp.linalg.norm(rotations.log(state.R @ true.R.T))),
            1e3 * jnp.linalg.norm(state.p - true.p),
            jnp.linalg.norm(rate - omega),
            jnp.linalg.norm(state.v - true.v),
        ]
    )


def of_episodes(found: Any) -> Float[np.ndarray, "E nodes 4"]:
    """Root mean square over the starts of each episode."""
    return np.sqrt(np.mean(np.asarray(found) ** 2, axis=1))
