"""The models that others predict with, against the nonlinear roll-out."""

from functools import cache

import jax
import numpy as np
import pytest
from spatial_problem import BODY, HIPS, problem, rollout, targets

from kjax.dynamics import rotations, spatial_data, srb_spatial
from kjax.dynamics.srb_spatial import Contacts
from kjax.koopman import so3
from kjax.mpc.response import PredictionTask
from kjax.mpc.rigid_models import PREDICTIONS
from kjax.prediction import residual_wrench
from kjax.prediction.residual_wrench import ResidualWrench

NAMES = sorted(PREDICTIONS)
MODELS = {name: jax.jit(predict) for name, predict in PREDICTIONS.items()}
log = jax.jit(rotations.log)
# EDMD's mean over tilted bodies is not what a level one does; with products it is nearly so.
ROUGH = {"edmd": 0.5, "bilinear": 0.2}


@cache
def learned(name):
    """What EDMD finds of the body, of the models that learn; of a residual, that there is none."""
    if name == "residual":
        return ResidualWrench(np.zeros(residual_wrench.SHAPE))
    if name not in ("edmd", "bilinear"):
        return None
    data = spatial_data.draw(
        BODY, HIPS, [0], range(4), count=1500, nodes=1, dt=0.0125, anywhere=True
    )
    return so3.fit_body(data, 0.0125, bilinear=name == "bilinear")


@jax.jit
def tilted(start, tilt):
    R = rotations.exp(tilt * rotations.log(start.R))
    return start._replace(R=R, L=tilt * start.L, v=tilt * start.v)


@jax.jit
def turn(start, contacts, length):
    """Attitudes and angular velocities of the nonlinear roll-out."""
    states = srb_spatial.rollout(BODY, start, contacts, length)
    rate = jax.vmap(srb_spatial.angular_velocity, (None, 0, 0))(BODY, states.R, states.L)
    return states.R, rate


def setting(seed=0, tilt=1.0):
    """A body, its nodes and feet; with no ``tilt`` level, still, and with level feet."""
    start, found, feet, nominal = problem(seed)
    start = tilted(start, tilt)
    wanted = targets(found, nominal)
    states = rollout(BODY, start, Contacts(feet, nominal), found.length)
    ahead = np.tile([1.0, 0.0], (len(found.length), 1))
    wanted = wanted._replace(p=np.asarray(states.p)[1:], v=np.asarray(states.v)[1:], heading=ahead)
    return start, found, feet, nominal, wanted


def response(name, start, found, feet, nominal, wanted, own=None):
    phase = (found.end - found.length / 2 - found.begin) / 0.2
    known = learned(name) if own is None else own
    predicted = MODELS[name](
        PredictionTask(BODY, start, found.length, feet, nominal, wanted, known, phase)
    )
    return jax.tree.map(np.asarray, predicted)


def moved(found, predicted, change):
    """Changes (K, 12) that a response predicts for changes of the forces."""
    x, out = np.zeros(predicted.A.shape[1]), []
    for k, (A, B) in enumerate(zip(predicted.A, predicted.B, strict=True)):
        x = A @ x + np.einsum("lsf,lf->s", B, change[k])
        out.append(predicted.outputs[k] @ x)
    return np.array(out)


@pytest.mark.parametrize("name", NAMES)
def test_place_and_velocity_are_exact_in_every_model(name):
    start, found, feet, nominal, wanted = setting(1)
    predicted = response(name, start, found, feet, nominal, wanted)
    change = 30.0 * np.random.default_rng(2).normal(size=nominal.shape)
    change *= found.stance[..., None]
    contacts = Contacts(feet, nominal + change)
    true = jax.tree.map(np.asarray, rollout(BODY, start, contacts, found.length))
    x = moved(found, predicted, change)
    np.testing.assert_allclose(predicted.states.p[1:] + x[:, 3:6], true.p[1:], atol=1e-12)
    np.testing.assert_allclose(predicted.states.v[1:] + x[:, 9:], true.v[1:], atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_near_a_level_body_at_rest_all_models_turn_as_the_rigid_body_does(name):
    start, found, feet, nominal, wanted = setting(3, tilt=0.0)
    predicted = response(name, start, found, feet, nominal, wanted)
    # Couples: the convex model does not see that a body pushed aside topples.
    change = 0.01 * np.random.default_rng(4).normal(size=nominal.shape)
    stance = found.stance[..., None]
    change -= (change * stance).sum(axis=1, keepdims=True) / np.maximum(stance.sum(1), 1)[:, None]
    change *= stance

    (R, rate), (R_moved, rate_moved) = (
        map(np.asarray, turn(start, Contacts(feet, force), found.length))
        for force in (nominal, nominal + change)
    )
    x = moved(found, predicted, change)[:10]
    wanted_turn = np.asarray(log(R_moved @ np.swapaxes(R, 1, 2)))[1:11]
    scale = np.abs(wanted_turn).max()
    close = ROUGH.get(name, 0.1)
    np.testing.assert_allclose(x[:, :3], wanted_turn, atol=close * scale)
    missed = np.abs(x[:, 6:9] - (rate_moved - rate)[1:11]).max()
    assert missed < close * np.abs(rate_moved - rate).max()


@pytest.mark.parametrize(
    ("name", "worst"), [("momentum", 1e-9), ("residual", 1e-9), ("present", 0.05)]
)
def test_a_nominal_motion_of_a_turning_body_is_predicted(name, worst):
    start, found, feet, nominal, wanted = setting(5)
    predicted = response(name, start, found, feet, nominal, wanted)
    true = np.asarray(rollout(BODY, start, Contacts(feet, nominal), found.length, substeps=4).R)
    missed = np.asarray(log(predicted.states.R @ np.swapaxes(true, 1, 2)))
    turned = log(true[4] @ true[0].T)
    assert np.abs(missed[4]).max() < max(worst * np.abs(turned).max(), 1e-6)  # after 100 ms


def test_the_convex_model_neglects_roll_and_pitch_and_the_gyroscopic_moment():
    start, found, feet, nominal, wanted = setting(6)
    K = len(found.length)
    heading = np.array([np.cos(0.4), np.sin(0.4)])
    wanted = wanted._replace(heading=np.tile(heading, (K, 1)))
    predicted = response("convex", start, found, feet, nominal, wanted)
    Rz = np.array([[heading[0], -heading[1], 0], [heading[1], heading[0], 0], [0, 0, 1]])
    W = np.linalg.inv(Rz @ np.asarray(BODY.inertia) @ Rz.T)
    middle = (wanted.p[2] + wanted.p[3]) / 2
    moment = np.cross(feet[3] - middle, nominal[3]).sum(axis=0)
    step = predicted.omega[3] - predicted.omega[2]
    np.testing.assert_allclose(step, found.length[3] * W @ moment, rtol=1e-9)


@pytest.mark.parametrize("name", ["edmd", "bilinear"])
def test_learned_models_are_linearised_about_their_own_roll_out(name):
    """Any heading: small changes of the forces change the roll-out as A, B and outputs say."""
    start, found, feet, nominal, wanted = setting(7)
    ahead = np.tile([np.cos(2.0), np.sin(2.0)], (len(found.length), 1))
    wanted = wanted._replace(heading=ahead)
    predicted = response(name, start, found, feet, nominal, wanted)
    change = 1e-3 * np.random.default_rng(8).normal(size=nominal.shape) * found.stance[..., None]
    moved_up, moved_down = (
        response(name, start, found, feet, nominal + sign * change, wanted) for sign in (1, -1)
    )
    x = moved(found, predicted, change)
    turned = np.asarray(log(moved_up.states.R @ np.swapaxes(moved_down.states.R, 1, 2)))[1:] / 2
    for columns, true in (
        (slice(0, 3), turned),
        (slice(3, 6), (moved_up.states.p - moved_down.states.p)[1:] / 2),
        (slice(6, 9), (moved_up.omega - moved_down.omega) / 2),
        (slice(9, 12), (moved_up.states.v - moved_down.states.v)[1:] / 2),
    ):
        np.testing.assert_allclose(x[:, columns], true, atol=1e-5 * np.abs(true).max())


@pytest.mark.parametrize("name", ["edmd", "bilinear"])
def test_learned_models_turn_with_the_robot(name):
    """The whole problem turned about the vertical gives the whole response turned."""
    start, found, feet, nominal, wanted = setting(9)
    Rz = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    one = response(name, start, found, feet, nominal, wanted)
    turned = start._replace(p=Rz @ start.p, R=Rz @ start.R, v=Rz @ start.v, L=Rz @ start.L)
    aside = wanted._replace(
        R=Rz @ wanted.R, p=wanted.p @ Rz.T, v=wanted.v @ Rz.T, omega=wanted.omega @ Rz.T,
        heading=wanted.heading @ Rz[:2, :2].T,
    )  # fmt: skip
    other = response(name, turned, found, feet @ Rz.T, nominal @ Rz.T, aside)
    np.testing.assert_allclose(other.states.R, Rz @ one.states.R, atol=1e-9)
    np.testing.assert_allclose(other.states.p, one.states.p @ Rz.T, atol=1e-9)
    np.testing.assert_allclose(other.omega, one.omega @ Rz.T, atol=1e-8)
    change = np.random.default_rng(1).normal(size=nominal.shape) * found.stance[..., None]
    x, y = moved(found, one, change), moved(found, other, change @ Rz.T)
    np.testing.assert_allclose(y.reshape(-1, 4, 3), x.reshape(-1, 4, 3) @ Rz.T, atol=1e-8)


def some_residual(seed=0):
    """Weights whose wrench is a tenth of the robot's weight, and moments of a few N m."""
    rng = np.random.default_rng(seed)
    W = rng.normal(size=residual_wrench.SHAPE)
    W[..., 10:22] *= 0.02  # forces of the legs
    return ResidualWrench(W * np.array([3.0, 3.0, 3.0, 1.0, 1.0, 1.0])[:, None])


def residual_states(start, found, feet, nominal, model):
    """The roll-out with the wrench, by small steps of forces and wrench that are held."""
    phase = (found.end - found.length / 2 - found.begin) / 0.2
    state, out = start, []
    for k, h in enumerate(found.length):
        omega = srb_spatial.angular_velocity(BODY, state.R, state.L)
        other = wrench(model, state, omega, nominal[k], phase[k])
        state = step(BODY, state, Contacts(feet[k], nominal[k], other), h)
        out.append(jax.tree.map(np.asarray, (state.p, state.R, state.v)))
    return [np.array(parts) for parts in zip(*out, strict=True)]


wrench = jax.jit(residual_wrench.wrench)
step = jax.jit(lambda *given: srb_spatial.step(*given, substeps=4))


def test_a_residual_changes_with_state_and_forces_as_its_roll_out_does():
    start, found, feet, nominal, wanted = setting(11)
    model = some_residual()
    predicted = response("residual", start, found, feet, nominal, wanted, own=model)
    bare = response("momentum", start, found, feet, nominal, wanted)
    change = 1e-3 * np.random.default_rng(8).normal(size=nominal.shape) * found.stance[..., None]
    up, down = (
        residual_states(start, found, feet, nominal + sign * change, model) for sign in (1, -1)
    )
    x = moved(found, predicted, change)
    turned = np.asarray(log(up[1] @ np.swapaxes(down[1], 1, 2))) / 2
    for columns, true in (
        (slice(0, 3), turned),
        (slice(3, 6), (up[0] - down[0]) / 2),
        (slice(9, 12), (up[2] - down[2]) / 2),
    ):
        # The attitude is by the implicit midpoint rule, as without one: 0.2 % after 150 ms.
        np.testing.assert_allclose(x[:6, columns], true[:6], atol=3e-3 * np.abs(true).max())
        without = moved(found, bare, change)[:, columns]
        assert np.abs(without - true).max() > 0.05 * np.abs(true).max()
