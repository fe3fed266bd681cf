"""A residual wrench from episodes: what was put in is found, and what it predicts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.prediction.residual_wrench import SHAPE, ResidualWrench, wrench
from kjax.studies.spatial_residual import prediction
from kjax.sysid import spatial_residual
from kjax.sysid.spatial_residual import SpatialEpisode

BODY = SpatialBody(jnp.asarray(12.7), jnp.diag(jnp.array([0.13, 0.39, 0.42])))
DT = 0.005
FEET = np.array([[0.2, -0.13, 0.0], [0.2, 0.13, 0.0], [-0.2, -0.13, 0.0], [-0.2, 0.13, 0.0]])
SETS = {9: (1, 0, 0, 1), 6: (0, 1, 1, 0)}  # pattern: legs of a diagonal


@jax.jit
@jax.vmap
def tick(W, state, omega, force, phase):
    """One tick of a rigid body that a residual pushes as well."""
    state = state._replace(L=srb_spatial.momentum(BODY, state.R, omega))
    other = wrench(ResidualWrench(W), state, omega, force, phase)
    then = srb_spatial.step(BODY, state, Contacts(jnp.asarray(FEET), force, other), DT)
    return state, then, srb_spatial.angular_velocity(BODY, then.R, then.L)


def weights():
    W = np.zeros(SHAPE)
    W[list(SETS)] = np.random.default_rng(1).normal(size=(2, *SHAPE[1:]))
    # No foot in the air presses: its columns are not told.
    for one, legs in SETS.items():
        air = np.repeat(np.array(legs) == 0, 3)
        W[one][:, 10:22][:, air] = 0.0
    return W


def pairs(count=300):
    """Episodes of two ticks, each a start of its own."""
    rng = np.random.default_rng(0)
    stance = np.array([SETS[9] if i % 2 else SETS[6] for i in range(count)], bool)
    draw = [rng.uniform(-1.0, 1.0, (count, 3)) for _ in range(4)]
    R = jax.vmap(rotations.exp)(0.2 * draw[0])
    state = BodyState(draw[1] * 0.1, R, draw[2], jnp.zeros((count, 3)))
    force = stance[..., None] * rng.uniform([-20, -20, 20], [20, 20, 100], (count, 4, 3))
    phase = rng.uniform(0.0, 1.0, count)
    W = np.broadcast_to(weights(), (count, *SHAPE))
    now, then, omega = tick(W, state, draw[3], force, phase)

    def both(a, b):
        return np.stack([a, b], axis=1)

    return SpatialEpisode(
        states=jax.tree.map(both, now, then), omega=both(draw[3], omega),
        feet=np.broadcast_to(FEET, (count, 2, 4, 3)), force=both(force, force),
        stance=both(stance, stance), touch=both(stance, stance), phase=both(phase, phase),
    )  # fmt: skip


def test_a_fit_finds_the_wrench_that_was_there():
    model, how = spatial_residual.fit(pairs(), BODY, dt=DT, least=100)
    np.testing.assert_allclose(model.W, weights(), atol=1e-7)
    assert (how.rows[[6, 9]] == 150).all()
    assert how.rows.sum() == 300
    # 1 or 2 columns of a foot in the air are always 0, each of three axes.
    assert (how.columns[[6, 9]] == 26).all()
    assert (how.rank[[6, 9]] == 26).all()
    assert (how.after[[6, 9]] < 1e-8).all()
    assert (how.before[[6, 9]] > 1.0).all()


def test_ticks_with_a_foot_too_many_on_the_ground_tell_nothing():
    episodes = pairs()
    touch = np.array(episodes.touch)
    touch[::3, 1] = True
    _, how = spatial_residual.fit(episodes._replace(touch=touch), BODY, dt=DT, least=100)
    assert how.rows.sum() == 200
    none, _ = spatial_residual.fit(
        episodes._replace(touch=np.ones_like(touch)), BODY, dt=DT, least=100
    )
    assert not none.W.any()


@pytest.mark.parametrize(
    ("stance", "phase"),
    [
        ([1, 1, 0, 0, 0, 0, 1, 1], [0.25, 0.75, 0.125, 0.375, 0.625, 0.875, 0.125, 0.375]),
        ([1, 1, 1], [1 / 6, 1 / 2, 5 / 6]),
    ],
)
def test_phase_is_that_of_the_stance(stance, phase):
    legs = np.repeat(np.array(stance, bool)[:, None], 4, axis=1)
    np.testing.assert_allclose(spatial_residual.phase_over(legs), phase)


def test_a_constant_wrench_is_predicted_with_it_and_missed_without():
    """A robot that stands on a diagonal and is pulled ahead by 6.35 N: 0.5 m/s^2."""
    W = np.zeros(SHAPE)
    W[9, 0, 0] = 6.35
    ticks, count = 81, 1
    force = np.array(SETS[9])[:, None] * np.array([0.0, 0.0, 12.7 * 9.81 / 2])
    state = BodyState(np.array([0.0, 0.0, 0.27]), np.eye(3), np.zeros(3), np.zeros(3))
    rows = []
    for _ in range(ticks):
        one = jax.tree.map(lambda a: a[None], (W, state, np.zeros(3), force, np.array(0.5)))
        _, then, _ = tick(*one)
        # Held upright, so that only place and velocity move.
        rows.append(state)
        state = jax.tree.map(lambda a: np.asarray(a[0]), then)._replace(R=np.eye(3), L=np.zeros(3))
    states = jax.tree.map(lambda *a: np.stack(a)[None], *rows)
    legs = np.broadcast_to(np.array(SETS[9], bool), (count, ticks, 4))
    episodes = SpatialEpisode(
        states, np.zeros((1, ticks, 3)), np.broadcast_to(FEET, (1, ticks, 4, 3)),
        np.broadcast_to(force, (1, ticks, 4, 3)), legs, legs, np.full((1, ticks), 0.5),
    )  # fmt: skip
    found = {
        name: prediction.of_episodes(
            prediction.errors(episodes, BODY, model, DT, ticks=40, every=20)
        )[0]
        for name, model in (("body", None), ("residual", ResidualWrench(jnp.asarray(W))))
    }
    t = DT * prediction.NODE * np.arange(1, 9)
    np.testing.assert_allclose(found["body"][:, 3], 0.5 * t, rtol=1e-6)
    np.testing.assert_allclose(found["body"][:, 1], 1e3 * 0.25 * t**2, rtol=1e-6)
    assert found["residual"][:, [1, 3]].max() < 1e-9
