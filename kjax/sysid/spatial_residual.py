"""Fit what a rigid body in three dimensions misses of the whole robot, from its own episodes.

What is left of each control tick by the rigid body under the forces that were asked for,

    m (v+ - v_body+) / dt = f,    (L+ - L_body+) / dt = tau,

is explained by ``prediction.residual_wrench``, for each set of standing legs. Only ticks tell about
it in which exactly the scheduled feet touch the ground.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax.dynamics import srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.koopman import regression
from kjax.prediction.residual_wrench import (
    PATTERNS,
    SIZE,
    ResidualWrench,
    features,
    heading_axes,
    pattern,
)


class SpatialEpisode(NamedTuple):
    """One robot, T control ticks; z is counted from the ground.

    Attributes:
      states: (T, ...) at the ticks' beginnings.
      omega: (T, 3) angular velocity, world [rad/s].
      feet: (T, 4, 3) contact points of the feet, world [m].
      force: (T, 4, 3) forces that were asked of the legs over the tick, world [N].
      stance: (T, 4) whether legs shall stand.
      touch: (T, 4) whether they touch the ground.
      phase: (T,) part of the gait's phase that is over in the middle of the tick [-].
    """

    states: BodyState
    omega: Float[Array, "T 3"]
    feet: Float[Array, "T 4 3"]
    force: Float[Array, "T 4 3"]
    stance: Bool[Array, "T 4"]
    touch: Bool[Array, "T 4"]
    phase: Float[Array, "T"]


class ResidualFit(NamedTuple):
    """How well it was determined, by set of standing legs.

    Attributes:
      rows: (16,) rows of the fit.
      rank: (16,) numerical rank of the scaled features.
      columns: (16,) features that are not always 0.
      before: (16, 6) root mean square of the wrench that is missing [N, N m].
      after: (16, 6) the same with the fit.
    """

    rows: Int[np.ndarray, "16"]
    rank: Int[np.ndarray, "16"]
    columns: Int[np.ndarray, "16"]
    before: Float[np.ndarray, "16 6"]
    after: Float[np.ndarray, "16 6"]


def fit(
    episodes: SpatialEpisode,
    body: SpatialBody,
    *,
    dt: float,
    ticks: int = 1,
    ridge: float = 0.0,
    least: int = 200,
) -> tuple[ResidualWrench, ResidualFit]:
    """Weights by least squares.

    With several ``ticks`` the rows are means over so many in a row: what contacts take in one tick
    and give back in the next is then no longer in the way.

    Args:
      episodes: with a leading axis of episodes (E, T, ...).
      body: mass and inertia of the rigid body.
      dt: control tick [s].
      ticks: that a row is the mean of.
      ridge: penalty in scaled columns, ``regression.solve``'s [-].
      least: fewest rows that a set of legs is fitted on.
    """
    phi, missing, sets, use = (np.asarray(a) for a in _rows(episodes, body, dt))
    count = (phi.shape[1] // ticks) * ticks

    def grouped(a: np.ndarray) -> np.ndarray:
        return a[:, :count].reshape(-1, ticks, *a.shape[2:])

    sets, use = grouped(sets), grouped(use)
    alike = (sets == sets[:, :1]).all(axis=1) & use.all(axis=1)
    Z, Y, sets = grouped(phi).mean(axis=1), grouped(missing).mean(axis=1), sets[:, 0]
    W = np.zeros((PATTERNS, 6, SIZE))
    found = ResidualFit(
        rows=np.zeros(PATTERNS, int), rank=np.zeros(PATTERNS, int),
        columns=np.zeros(PATTERNS, int), before=np.full((PATTERNS, 6), np.nan),
        after=np.full((PATTERNS, 6), np.nan),
    )  # fmt: skip
    for one in range(PATTERNS):
        here = alike & (sets == one)
        if here.sum() < least:
            continue
        z, y = Z[here], Y[here]
        solved = regression.solve(regression.of_rows(z, y), SIZE, ridge=ridge)
        W[one] = np.asarray(solved.W).T
        found.rows[one], found.rank[one] = len(z), int(solved.rank)
        found.columns[one] = z.any(axis=0).sum()
        found.before[one] = np.sqrt(np.mean(y**2, axis=0))
        found.after[one] = np.sqrt(np.mean((y - z @ W[one].T) ** 2, axis=0))
    return ResidualWrench(jnp.asarray(W)), found


def phase_over(stance: Bool[np.ndarray, "T 4"]) -> Float[np.ndarray, "T"]:
    """Part of the present phase that is over in each tick's middle, from the legs that stand.

    The phase that the recording's end cuts off counts as long as the one before.
    """
    new = np.r_[True, (stance[1:] != stance[:-1]).any(axis=1)]
    begins = np.flatnonzero(new)
    lasts = np.diff(begins)
    last = max(lasts[-1] if len(lasts) else 0, len(stance) - begins[-1])
    which = np.cumsum(new) - 1
    return (np.arange(len(stance)) + 0.5 - begins[which]) / np.append(lasts, last)[which]


@jax.jit
def _rows(
    episodes: SpatialEpisode, body: SpatialBody, dt: float
) -> tuple[Array, Array, Array, Array]:
    """Features, missing wrench in the heading's axes, set of legs, use: (E, T - 1, ...) each."""

    def one(now: SpatialEpisode, then: SpatialEpisode) -> tuple[Array, Array, Array, Array]:
        contacts = Contacts(now.feet, now.force)
        axes = heading_axes(now.states.R)
        planned = srb_spatial.step(body, now.states, contacts, dt)
        f = body.mass * (then.states.v - planned.v) / dt
        # With that force the feet have other arms.
        pulled = contacts._replace(other=jnp.stack([f, jnp.zeros_like(f)]))
        tau = (then.states.L - srb_spatial.step(body, now.states, pulled, dt).L) / dt
        touch = (now.touch == now.stance).all() & (then.touch == now.stance).all()
        missing = jnp.concatenate([axes.T @ f, axes.T @ tau])
        phi = features(now.states, now.omega, now.force, now.phase)
        return phi, missing, pattern(now.stance), touch

    now = jax.tree.map(lambda a: a[:, :-1], episodes)
    then = jax.tree.map(lambda a: a[:, 1:], episodes)
    return jax.vmap(jax.vmap(one))(now, then)
