"""(1, p, v, H) closes exactly, and EDMD finds the model from 400 samples in every contact mode."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.koopman import momentum

INERTIA = [[0.1273, -0.0004, -0.0144], [-0.0004, 0.3944, -0.0001], [-0.0144, -0.0001, 0.4228]]
BODY = SpatialBody(mass=jnp.asarray(12.743), inertia=jnp.asarray(INERTIA))
HIPS = np.array(
    [[0.19, -0.127, 0.0], [0.19, 0.127, 0.0], [-0.19, -0.127, 0.0], [-0.19, 0.127, 0.0]]
)
MODES = {"trot": (0, 3), "front": (0, 1), "rear": (2, 3), "stand": (0, 1, 2, 3), "one": (2,)}
DT, STEPS = 0.025, 8


exp = jax.jit(rotations.exp)
fit = jax.jit(momentum.fit)
exact_model = jax.jit(momentum.exact_model, static_argnums=3)
rollout = jax.jit(jax.vmap(momentum.rollout, (None, 0, 0)))
angular_momentum = jax.jit(jax.vmap(momentum.angular_momentum, (None, 0, None)))


@jax.jit
@partial(jax.vmap, in_axes=(0, 0, None, None))
def walked(state, force, feet, about):
    """Lifted states and angular momenta along the nonlinear motion."""
    contacts = Contacts(jnp.broadcast_to(feet, force.shape), force)
    length = jnp.full(force.shape[0], DT)
    states = srb_spatial.rollout(BODY, state, contacts, length, substeps=4)
    return jax.vmap(lambda s: momentum.lift(BODY, s, about))(states), states.L


def sample(seed, legs, count, steps, about):
    """Lifted trajectories (count, steps + 1, 10), inputs (count, steps, 3n), of the rigid body."""
    rng = np.random.default_rng(seed)
    feet = HIPS[list(legs)] + about * [1, 1, 0]
    w = rng.uniform(-1, 1, (count, 3)) * [0.3, 0.3, 3.0]  # any heading
    R = np.asarray(exp(w))
    p = about + rng.uniform(-0.1, 0.1, (count, 3)) + [0, 0, 0.27]
    v = rng.uniform(-1, 1, (count, 3)) * [1.0, 0.4, 0.3]
    L = np.einsum("nij,jk,nlk,nl->ni", R, np.array(INERTIA), R, rng.uniform(-3, 3, (count, 3)))
    load = 12.743 * 9.81 / len(legs) * rng.uniform(0.3, 1.7, (count, steps, len(legs)))
    force = np.stack([*(0.4 * load * rng.uniform(-1, 1, (2, *load.shape))), load], axis=-1)
    z, L = walked(BodyState(p, R, v, L), force, feet, about)
    return feet, np.asarray(z), force.reshape(count, steps, -1), np.asarray(L)


@pytest.mark.parametrize("legs", MODES.values(), ids=MODES)
def test_edmd_finds_the_exact_model_from_400_samples(legs):
    about = np.array([0.3, -0.2, 0.0])
    feet, z, u, _ = sample(0, legs, 400, 1, about)
    model, report = fit(z[:, 0], u[:, 0], z[:, 1])
    assert report.rank == report.columns
    _, held_out, u, L = sample(1, legs, 100, STEPS, about)
    predicted = np.asarray(rollout(model, held_out[:, 0], u))
    span = np.ptp(held_out, axis=(0, 1))[1:]
    error = np.abs(predicted - held_out).max(axis=(0, 1))[1:]
    assert (error / span).max() < 1e-12
    exact = exact_model(BODY, feet, about, DT)
    np.testing.assert_allclose(model.B, exact.B, atol=1e-13)
    got = angular_momentum(BODY, predicted[:, -1], about)
    np.testing.assert_allclose(got, L[:, -1], atol=1e-11)


def test_far_from_the_origin_a_point_near_the_robot_keeps_the_digits():
    about = np.array([1000.0, -500.0, 20.0])
    feet, z, u, _ = sample(2, MODES["trot"], 50, STEPS, about)
    model = exact_model(BODY, feet, about, DT)
    predicted = np.asarray(rollout(model, z[:, 0], u))
    np.testing.assert_allclose(predicted[..., momentum.H], z[..., momentum.H], atol=1e-9)
    orbital = 12.743 * np.cross(about, z[..., momentum.V])
    assert np.abs(z[..., momentum.H]).max() < 100.0 < np.abs(orbital).max()


def test_too_few_samples_are_refused():
    z = np.zeros((5, 10))
    with pytest.raises(ValueError, match="snapshots"):
        momentum.fit(z, np.zeros((5, 6)), z)
