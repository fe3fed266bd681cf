"""Every family of models against closed forms, finite differences and plain integration."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kjax.dynamics import srb_planar
from kjax.koopman import edmd, observables
from kjax.koopman.dataset import SampleRanges, Snapshots, sample
from kjax.koopman.models import input_map
from kjax.prediction import evaluation, families, features
from kjax.types import GRAVITY, MODE_ALPHA, Mode

DT = 1e-3
# Outside jit each operation is a program of its own.
rollout = jax.jit(families.rollout, static_argnums=0)
operating_point = jax.jit(families.operating_point, static_argnums=0, static_argnames="steps")
trajectory = jax.jit(srb_planar.trajectory, static_argnums=(0, 5))
linearised_srb = jax.jit(families.linearised_srb, static_argnums=(2, 3))
EXACT, LONG_EXACT = families.exact(DT), families.exact(100 * DT)
X0 = np.array([0.3, 0.27, 0.2, 0.4, -0.1, 0.8])


@pytest.fixture(params=[Mode.TROT, Mode.FRONT, Mode.REAR, Mode.FLIGHT], ids=lambda m: m.name)
def params(request, body):
    return families.BodyModel(body, jnp.asarray(MODE_ALPHA[request.param], float))


@pytest.fixture
def start(body):
    return families.Start(jnp.asarray(X0), body.feet)


def forces(steps, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform([-30, 20, -30, 20], [30, 110, 30, 110], (steps, 4))


def integrated(params, feet, inputs, world):
    """The planted body in plain NumPy, by an adaptive integrator at tight tolerances."""
    alpha, mass = np.asarray(params.alpha), float(params.body.mass)
    inertia = float(params.body.inertia)

    def turn(angle):
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    ground = X0[:2] + np.asarray(feet) @ turn(X0[2]).T

    def slope(_, x, u):
        force = alpha[:, None] * u.reshape(2, 2) @ turn(X0[2] if world else x[2]).T
        arm = ground - x[:2]
        moment = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]).sum()
        accel = force.sum(0) / mass - np.array([0.0, GRAVITY])
        return np.r_[x[3:], accel, moment / inertia]

    x, out = X0, [X0]
    for u in inputs:
        x = solve_ivp(slope, (0, DT), x, args=(u,), rtol=1e-12, atol=1e-13).y[:, -1]
        out.append(x)
    return np.array(out)


@pytest.mark.parametrize("plant", ["planted", "space"])
def test_planted_bodies_move_as_an_adaptive_integrator_says(params, start, plant):
    inputs = forces(20)
    wanted = integrated(params, start.feet, inputs, world=plant == "space")
    got = trajectory(plant, params.body, params.alpha, start.x, inputs, DT)
    # Runge-Kutta at 1 ms: dt^5 / 120 times fifth derivatives of up to 1e5 (a force on one end turns
    # the body at 100 rad/s^2) over 20 steps; the reference is good to 1e-12.
    np.testing.assert_allclose(got, wanted, rtol=0, atol=2e-9)


def test_the_exact_model_is_exact(params, start):
    inputs = forces(500)
    wanted = trajectory("space", params.body, params.alpha, start.x, inputs, DT)
    got = rollout(EXACT, params, start, inputs)
    # Runge-Kutta integrates these polynomials exactly: rounding over 500 steps is left.
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-11)


def test_one_exact_step_of_100_ms_equals_100_of_one(params, start):
    u = forces(1)
    long = rollout(LONG_EXACT, params, start, u)
    short = rollout(EXACT, params, start, np.tile(u, (100, 1)))
    np.testing.assert_allclose(np.asarray(long)[-1], np.asarray(short)[-1], rtol=0, atol=1e-12)


def test_edmd_finds_the_exact_model_by_itself(body):
    """World-frame forces, world-fixed feet: (1, x) with its products is closed."""
    alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    ground = jnp.array([[0.2, 0.0], [-0.18, 0.0]])
    rng = np.random.default_rng(0)
    x0 = jnp.asarray(rng.normal(size=(60, 6)) * [0.1, 0.05, 0.3, 0.5, 0.5, 2.0])
    inputs = jnp.asarray(forces(60 * 20).reshape(60, 20, 4))

    def one(x0, inputs):
        def step(x, u):
            x = srb_planar.rk4(
                lambda x: srb_planar.planted_dynamics(body, alpha, ground, x, u, world_forces=True),
                x,
                DT,
            )
            return x, x

        return jnp.concatenate([x0[None], jax.lax.scan(step, x0, inputs)[1]])

    states = jax.jit(jax.vmap(one))(x0, inputs)
    data = Snapshots(states, inputs, jnp.zeros((60, 2, 2)))
    dictionary = observables.states_only()
    model, report = jax.jit(lambda d: edmd.fit_bilinear(dictionary, d))(data)
    assert report.rank == report.columns == 7 + 28
    # The whole of the increments is explained: rounding times the condition, 1e3.
    assert (np.asarray(report.residual_rms) < 1e-14).all()
    # d omega / (p_z F_x) = dt / I: the moment of the height, which no linear model holds.
    np.testing.assert_allclose(model.B[2, 6, 0], DT / body.inertia, rtol=1e-9)


@pytest.fixture(scope="module")
def every_family(body):
    alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    known = families.BodyModel(body, alpha)
    ranges = SampleRanges(
        jnp.array([0.0, 0.27, 0.0, 0.0, 0.0, 0.0]),
        jnp.array([0.5, 0.1, 0.3, 1.0, 0.5, 2.0]),
        jnp.array([-40.0, 0.0] * 2),
        jnp.array([40.0, 120.0] * 2),
        jnp.array([0.05, 0.05]),
    )
    draw = jax.jit(lambda key: sample(key, body, alpha, ranges, rollouts=60, steps=20, dt=DT))
    data = draw(jax.random.key(0))
    dictionary = observables.paper(2, constant_rotation=True)
    weights = np.zeros((6, 17))
    weights[3, 5] = 1e-5
    one, two = jax.jit(
        lambda data: [
            fit(dictionary, data, feet_terms=True)[0] for fit in (edmd.fit, edmd.fit_bilinear)
        ]
    )(data)
    return {
        "linear": (families.linear(dictionary, DT), one),
        "bilinear": (families.bilinear(dictionary, DT), two),
        "srb_hover": (
            families.linear(observables.states_only(), DT, "srb_hover"),
            linearised_srb(body, alpha, 0.27, DT),
        ),
        "srb": (families.rigid_body(DT), known),
        "planted": (families.planted(DT), known),
        "exact": (families.exact(DT), known),
        "residual": (
            families.residual(DT, features.affine, remembers=False),
            families.ResidualModel(known, weights),
        ),
    }  # fmt: skip


NAMES = ("linear", "bilinear", "srb_hover", "srb", "planted", "exact", "residual")


@pytest.mark.parametrize("name", NAMES)
def test_a_lifted_state_begins_with_one_and_the_state(every_family, start, name):
    family, params = every_family[name]
    z = jax.jit(family.lift)(params, start)
    assert z.shape == (family.size,)
    np.testing.assert_array_equal(z[:7], np.r_[1.0, X0])
    assert family.name == name


@pytest.mark.parametrize("name", NAMES)
def test_the_operating_point_is_the_tangent(every_family, start, name):
    family, params = every_family[name]
    u = forces(1)[0]
    z = np.asarray(jax.jit(family.lift)(params, start))
    run = jax.jit(family.step)

    def step(z, u):
        return np.asarray(run(params, start, z, u))

    here = jax.tree.map(np.asarray, operating_point(family, params, start, u))
    np.testing.assert_allclose(here.A @ z + here.B @ u, step(z, u), rtol=0, atol=1e-13)
    rng = np.random.default_rng(1)
    dz, du = rng.normal(size=z.shape), rng.normal(size=4)
    dz[0], h = 0.0, 1e-4  # the constant stays one
    ahead, behind = (step(z + s * h * dz, u + s * h * du) for s in (1.0, -1.0))
    wanted = (ahead - behind) / (2 * h)
    # Central differences: h^2 times third derivatives below 1e-1, and rounding over h.
    np.testing.assert_allclose(here.A @ dz + here.B @ du, wanted, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_many_steps_at_once_are_the_steps_one_after_another(every_family, start, name):
    family, params = every_family[name]
    u = forces(1)[0]
    one, five = (
        jax.tree.map(np.asarray, operating_point(family, params, start, u, **more))
        for more in ({}, {"steps": 5})
    )
    z = np.asarray(jax.jit(family.lift)(params, start))
    wanted = z
    for _ in range(5):
        wanted = one.A @ wanted + one.B @ u
    np.testing.assert_allclose(five.A @ z + five.B @ u, wanted, rtol=0, atol=1e-13)


def test_the_hovering_model_holds_the_lever_arms(body):
    alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    model = linearised_srb(body, alpha, 0.27, DT)
    feet = np.array([[0.25, -0.3], [-0.1, -0.2]])
    B = np.asarray(jax.jit(input_map)(model, feet))
    arms = np.array([0.3, 0.25, 0.2, -0.1]) * np.repeat(MODE_ALPHA[Mode.TROT], 2)
    np.testing.assert_allclose(B[6], DT * arms / body.inertia, rtol=0, atol=1e-15)
    # Pitching nose up turns the lift backwards: d v_x / d theta = -g dt when hovering.
    np.testing.assert_allclose(np.asarray(model.A)[4, 3], -GRAVITY * DT, rtol=1e-6)


def test_a_residual_adds_what_its_weights_say(body, start):
    alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    known = families.BodyModel(body, alpha)
    family = families.residual(DT, features.affine, remembers=False)
    u = forces(1)[0]
    z = jax.jit(lambda start: family.lift(None, start))(start)
    plain = jax.jit(families.planted(DT).step)(known, start, z, u)
    W = np.zeros((6, 17))
    W[5, 0], W[3, 5] = 0.01, -1e-4
    got = jax.jit(family.step)(families.ResidualModel(known, W), start, z, u)
    got = np.asarray(got) - np.asarray(plain)
    wanted = np.zeros(7)
    wanted[6], wanted[4] = 0.01, -1e-4 * float(u[0])
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-16)


def test_bootstrap_covers_the_mean_of_a_known_distribution():
    rng = np.random.default_rng(0)
    hits = 0
    run = jax.jit(lambda key, e: evaluation.bootstrap(key, e, lambda a: a.mean(), draws=200))
    for trial in range(40):
        # 25 episodes whose 10 rows are the same number: only episodes are independent.
        errors = np.repeat(rng.normal(1.0, 0.5, (25, 1)), 10, axis=1)
        low, high = run(jax.random.key(trial), jnp.asarray(errors))
        assert low < high
        hits += bool(low < 1.0 < high)
    assert 33 <= hits <= 40  # 95 %, less what 25 episodes cost a percentile interval


def test_bootstrap_needs_episodes():
    with pytest.raises(ValueError, match="at least 2 episodes, got 1"):
        evaluation.bootstrap(jax.random.key(0), jnp.zeros((1, 3)), jnp.mean)


def test_the_response_to_forces_of_the_linearised_body_is_its_own(body):
    """0.1 s ahead; and a wrong entry of B is reported as what it is."""
    alpha = MODE_ALPHA[Mode.TROT]
    model = linearised_srb(body, jnp.asarray(alpha, float), 0.27, DT)
    judge = partial(
        evaluation.force_response_error, body=body, alpha=alpha, steps=100, duration=0.1
    )
    assert judge(model) < 0.02  # the step of 1 ms against the closed form
    B = np.array(model.B)
    B[4, 0] += 0.5 * DT / float(body.mass)
    wrong = model._replace(B=B)
    pushed = 0.1 / float(body.mass)
    lever = np.asarray(body.feet)[:, 1] / float(body.inertia)
    own = pushed + GRAVITY * lever * 0.1**3 / 6  # tilting under gravity
    np.testing.assert_allclose(judge(wrong), 0.5 * pushed / own.max(), rtol=0.03)
