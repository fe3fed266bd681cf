"""The models that others predict with, against the nonlinear roll-out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from spatial_problem import BODY, problem, targets

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import Contacts
from kjax.mpc.rigid_models import PREDICTIONS

NAMES = sorted(PREDICTIONS)


def setting(seed=0, tilt=1.0):
    """A body, its nodes and feet; with no ``tilt`` level, still, and with level feet."""
    start, found, feet, nominal = problem(seed)
    start = start._replace(
        R=rotations.exp(tilt * rotations.log(start.R)), L=tilt * start.L, v=tilt * start.v
    )
    wanted = targets(found, nominal)
    states = srb_spatial.rollout(BODY, start, Contacts(feet, nominal), found.length)
    ahead = jnp.broadcast_to(jnp.array([1.0, 0.0]), wanted.heading.shape)
    wanted = wanted._replace(p=states.p[1:], v=states.v[1:], heading=ahead)
    return start, found, feet, nominal, wanted


def response(name, start, found, feet, nominal, wanted):
    return jax.jit(PREDICTIONS[name])(BODY, start, found.length, feet, nominal, wanted)


def moved(found, predicted, change):
    """Changes (K, 12) that a response predicts for changes of the forces."""
    x, out = np.zeros(predicted.A.shape[1]), []
    for k, (A, B) in enumerate(zip(np.asarray(predicted.A), np.asarray(predicted.B), strict=True)):
        x = A @ x + np.einsum("lsf,lf->s", B, change[k])
        out.append(np.asarray(predicted.outputs[k]) @ x)
    return np.array(out)


@pytest.mark.parametrize("name", NAMES)
def test_place_and_velocity_are_exact_in_every_model(name):
    start, found, feet, nominal, wanted = setting(1)
    predicted = response(name, start, found, feet, nominal, wanted)
    change = 30.0 * np.random.default_rng(2).normal(size=nominal.shape)
    change *= np.asarray(found.stance)[..., None]
    contacts = Contacts(feet, nominal + change)
    true = srb_spatial.rollout(BODY, start, contacts, found.length)
    x = moved(found, predicted, change)
    np.testing.assert_allclose(predicted.states.p[1:] + x[:, 3:6], true.p[1:], atol=1e-12)
    np.testing.assert_allclose(predicted.states.v[1:] + x[:, 9:], true.v[1:], atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_near_a_level_body_at_rest_all_models_turn_as_the_rigid_body_does(name):
    start, found, feet, nominal, wanted = setting(3, tilt=0.0)
    predicted = response(name, start, found, feet, nominal, wanted)
    # Couples: the convex model does not see that a body pushed aside topples.
    change = 0.01 * np.random.default_rng(4).normal(size=nominal.shape)
    stance = np.asarray(found.stance)[..., None]
    change -= (change * stance).sum(axis=1, keepdims=True) / np.maximum(stance.sum(1), 1)[:, None]
    change *= stance

    def turn(force):
        states = srb_spatial.rollout(BODY, start, Contacts(feet, force), found.length)
        rate = jax.vmap(srb_spatial.angular_velocity, (None, 0, 0))(BODY, states.R, states.L)
        return states.R, rate

    (R, rate), (R_moved, rate_moved) = turn(nominal), turn(nominal + change)
    x = moved(found, predicted, change)[:10]
    wanted_turn = rotations.log(R_moved @ jnp.swapaxes(R, 1, 2))[1:11]
    scale = np.abs(np.asarray(wanted_turn)).max()
    np.testing.assert_allclose(x[:, :3], wanted_turn, atol=0.1 * scale)
    missed = np.abs(x[:, 6:9] - (rate_moved - rate)[1:11]).max()
    assert missed < 0.1 * np.abs(rate_moved - rate).max()


@pytest.mark.parametrize(("name", "worst"), [("momentum", 1e-9), ("present", 0.05)])
def test_a_nominal_motion_of_a_turning_body_is_predicted(name, worst):
    start, found, feet, nominal, wanted = setting(5)
    predicted = response(name, start, found, feet, nominal, wanted)
    true = srb_spatial.rollout(BODY, start, Contacts(feet, nominal), found.length, substeps=4)
    missed = rotations.log(predicted.states.R @ jnp.swapaxes(true.R, 1, 2))
    turned = rotations.log(true.R[4] @ true.R[0].T)
    assert np.abs(missed[4]).max() < max(worst * np.abs(turned).max(), 1e-6)  # after 100 ms


def test_the_convex_model_neglects_roll_and_pitch_and_the_gyroscopic_moment():
    start, found, feet, nominal, wanted = setting(6)
    K = len(found.length)
    heading = np.array([np.cos(0.4), np.sin(0.4)])
    wanted = wanted._replace(heading=jnp.broadcast_to(jnp.asarray(heading), (K, 2)))
    predicted = response("convex", start, found, feet, nominal, wanted)
    Rz = np.array([[heading[0], -heading[1], 0], [heading[1], heading[0], 0], [0, 0, 1]])
    W = np.linalg.inv(Rz @ np.asarray(BODY.inertia) @ Rz.T)
    middle = (np.asarray(wanted.p[2]) + np.asarray(wanted.p[3])) / 2
    levers = np.asarray(feet[3]) - middle
    moment = np.cross(levers, np.asarray(nominal[3])).sum(axis=0)
    step = np.asarray(predicted.omega[3] - predicted.omega[2])
    np.testing.assert_allclose(step, found.length[3] * W @ moment, rtol=1e-9)
