"""The rigid body in momentum form against SciPy's integrator, closed forms and invariants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody

INERTIA = np.array(
    [[0.1273, -0.0004, -0.0144], [-0.0004, 0.3944, -0.0001], [-0.0144, -0.0001, 0.4228]]
)
BODY = SpatialBody(mass=jnp.asarray(12.743), inertia=jnp.asarray(INERTIA))
G = np.array([0.0, 0.0, -9.81])
step = jax.jit(srb_spatial.step, static_argnames="substeps")
rollout = jax.jit(srb_spatial.rollout, static_argnames="substeps")
exp, log = jax.jit(rotations.exp), jax.jit(rotations.log)
angular_velocity = jax.jit(srb_spatial.angular_velocity)


def case(seed, feet=2):
    """A tilted body that turns at 3 rad/s, and forces that keep it about where it is."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
    L = R @ INERTIA @ R.T @ rng.uniform(-3, 3, 3)
    state = BodyState(rng.normal(size=3), R, rng.normal(size=3), L)
    force = rng.uniform(-20, 20, (feet, 3)) + np.array([0, 0, 12.743 * 9.81 / feet])
    points = state.p + rng.uniform(-0.25, 0.25, (feet, 3)) - [0, 0, 0.27]
    return state, Contacts(points, force)


def integrated(state, contacts, t):
    """SciPy's integrator on quaternion and angular velocity: Euler's equations in the body."""
    feet, force, _ = contacts

    def rate(_, y):
        p, v, quat, w = y[:3], y[3:6], y[6:10], y[10:]
        R = Rotation.from_quat(quat / np.linalg.norm(quat)).as_matrix()
        moment = R.T @ np.cross(feet - p, force).sum(0)
        w_rate = np.linalg.solve(INERTIA, moment - np.cross(w, INERTIA @ w))
        x, y_, z, s = quat
        dq = 0.5 * np.array(
            [s * w[0] + y_ * w[2] - z * w[1], s * w[1] + z * w[0] - x * w[2],
             s * w[2] + x * w[1] - y_ * w[0], -x * w[0] - y_ * w[1] - z * w[2]]
        )  # fmt: skip
        return np.concatenate([v, G + force.sum(0) / 12.743, dq, w_rate])

    w = np.linalg.solve(INERTIA, state.R.T @ state.L)
    start = np.concatenate([state.p, state.v, Rotation.from_matrix(state.R).as_quat(), w])
    y = solve_ivp(rate, (0, t), start, rtol=1e-12, atol=1e-12, method="DOP853").y[:, -1]
    R = Rotation.from_quat(y[6:10]).as_matrix()
    return y[:3], R, y[3:6], R @ (INERTIA @ y[10:])


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_that_of_an_integrator(seed):
    state, contacts = case(seed)
    got = step(BODY, state, contacts, 0.2, substeps=200)
    for ours, theirs in zip(got, integrated(state, contacts, 0.2), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_place_and_momentum_are_exact_in_one_step_and_the_attitude_of_fourth_order():
    state, contacts = case(5)
    p, R, v, L = integrated(state, contacts, 0.2)
    one = step(BODY, state, contacts, 0.2)
    for ours, theirs in ((one.p, p), (one.v, v), (one.L, L)):
        np.testing.assert_allclose(ours, theirs, atol=2e-11)
    error = [
        np.linalg.norm(np.asarray(step(BODY, state, contacts, 0.2, substeps=n).R) - R)
        for n in (2, 4, 8)
    ]
    assert error[0] / error[1] > 12
    assert error[1] / error[2] > 12


def test_a_free_body_keeps_momentum_and_energy():
    state, contacts = case(7)
    free = contacts._replace(force=np.zeros_like(contacts.force))
    got = jax.tree.map(np.asarray, step(BODY, state, free, 0.5, substeps=50))
    np.testing.assert_allclose(got.L, state.L, atol=1e-15)

    def energy(s):
        return 0.5 * s.L @ np.asarray(angular_velocity(BODY, s.R, s.L))

    np.testing.assert_allclose(energy(got), energy(state), rtol=1e-9)
    np.testing.assert_allclose(got.R @ got.R.T, np.eye(3), atol=1e-13)


def test_the_planar_body_is_the_same_motion_in_its_plane():
    from kjax.dynamics.srb_planar import SrbParams, planted_dynamics, rk4

    state = BodyState(
        np.array([0.1, 0.0, 0.27]),
        exp(np.array([0.0, -0.1, 0.0])),  # nose up
        np.array([0.4, 0.0, 0.1]),
        np.array([0.0, -0.3 * 0.3944, 0.0]),
    )
    feet = np.array([[0.3, 0.0, 0.0], [-0.1, 0.0, 0.0]])
    force = np.array([[5.0, 0.0, 60.0], [-8.0, 0.0, 70.0]])
    body = SpatialBody(BODY.mass, np.diag([0.13, 0.3944, 0.42]))
    got = step(body, state, Contacts(feet, force), 0.1, substeps=10)

    @jax.jit
    def planar_step(x, feet, force):
        planar = SrbParams(mass=BODY.mass, inertia=jnp.asarray(0.3944), feet=jnp.zeros((2, 2)))
        return rk4(
            lambda x: planted_dynamics(planar, jnp.ones(2), feet, x, force, world_forces=True),
            x,
            0.001,
        )

    x = np.array([0.1, 0.27, 0.1, 0.4, 0.1, 0.3])
    for _ in range(100):
        x = planar_step(x, feet[:, ::2], force[:, ::2].reshape(4))
    rate = -np.asarray(angular_velocity(body, got.R, got.L))[1]
    pitch, p, v = -np.asarray(log(got.R))[1], np.asarray(got.p), np.asarray(got.v)
    ours = [p[0], p[2], pitch, v[0], v[2], rate]
    np.testing.assert_allclose(np.array(ours), x, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.5, 2.0, 3.14])
def test_exp_and_log_are_scipys(angle):
    axis = np.array([0.6, -0.48, 0.64])
    R = exp(angle * axis)
    np.testing.assert_allclose(R, Rotation.from_rotvec(angle * axis).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(log(R), angle * axis, atol=1e-12)


back_and_forth = jax.jit(jax.jacobian(lambda w: rotations.log(rotations.exp(w))))


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.0099, 0.0101, 1.0])
def test_derivatives_of_exp_and_log_are_finite_and_right(angle):
    back = back_and_forth(angle * np.array([0.6, -0.48, 0.64]))
    np.testing.assert_allclose(back, np.eye(3), atol=1e-9)


def test_a_rollout_is_its_steps():
    state, contacts = case(3)
    pieces = jax.tree.map(lambda a: np.tile(a, (3, 1, 1)), contacts)
    states = rollout(BODY, state, pieces, np.array([0.05, 0.1, 0.05]), substeps=80)
    whole = step(BODY, state, contacts, 0.2, substeps=320)
    for ours, theirs in zip(states, whole, strict=True):
        np.testing.assert_allclose(np.asarray(ours)[-1], theirs, atol=1e-8)
