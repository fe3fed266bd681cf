"""The closed loop in three dimensions: gradients against differences, and the laws of its plant."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig, load_config
from kjax.dynamics import rotations
from kjax.qp import Status, block_rows
from kjax.robots import go1
from kjax.tuning import loop
from kjax.tuning.space import build_space
from kjax.types import GRAVITY

# A trot with flights, as short as touchdowns, flights and a command of all columns allow.
CONFIG = load_config(
    RunConfig,
    None,
    {
        "controller": "spatial",
        "sim.base": "free",
        "duration": 0.16,
        "gait.also": [],
        "gaits.trot.period": 0.2,
        "gaits.trot.duty": [0.4, 0.4, 0.4, 0.4],
        "spatial.horizon": 0.1,
        "spatial.node_dt": 0.05,
    },
)
KEYS = ("spatial.attitude", "spatial.omega", "spatial.velocity", "spatial.force",
        "spatial.velocity_time", "leg.foothold_gain", "lateral.foothold_gain")  # fmt: skip
TICKS = 32
STEP = 1e-4  # of the differences: truncation of its square, rounding of 1e-13 over it

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def runs():
    """Start and its neighbours in every direction of a few, with cost, gradient and trace."""
    space = build_space(CONFIG, KEYS)
    # Kept whole: a segment that is computed again is compiled again as well.
    run, plant = loop.build_loop(CONFIG, segment=TICKS), loop.plant_of(CONFIG)

    def objective(variables, scenario):
        trace = run(space.params(variables), scenario)
        return loop.cost(go1.PARAMS, trace, plant=plant), trace

    rng = np.random.default_rng(3)
    ways = [jax.tree.map(lambda a: rng.normal(size=a.shape), space.start) for _ in range(3)]
    ways += [jax.tree.map(jnp.zeros_like, space.start) | {key: jnp.ones_like(space.start[key])}
             for key in KEYS[3:]]  # fmt: skip
    points = [space.start]
    for way in ways:
        points += [jax.tree.map(lambda a, w, s=s: a + s * STEP * w, space.start, way)
                   for s in (1.0, -1.0)]  # fmt: skip
    points = jax.tree.map(lambda *a: jnp.stack(a), *points)
    speeds = ((0.3, 0.1, 0.5), (0.5, 0.2, 1.0))
    (scenario,) = [jax.tree.map(lambda a: a[0], loop.draw_scenarios(CONFIG, 0, 1, speeds=speeds))]
    with pytest.MonkeyPatch.context() as patch:
        # No row is active here, see the test of it: the active set need not be compiled.
        patch.setattr(block_rows, "where_needed", lambda needed, function, value, *args: value)
        slope_of = jax.value_and_grad(objective, has_aux=True)
        slopes = jax.jit(lambda zs, one: jax.lax.map(lambda z: slope_of(z, one), zs))
        (costs, trace), slope = slopes(points, scenario)
    return SimpleNamespace(
        ways=ways,
        costs=np.asarray(costs),
        slope=jax.tree.map(lambda a: np.asarray(a[0]), slope),
        trace=jax.tree.map(lambda a: np.asarray(a[0]), trace),
        plant=jax.tree.map(np.asarray, scenario.plant),
    )


def test_gradients_are_those_of_finite_differences(runs):
    up, down = runs.costs[1::2], runs.costs[2::2]
    wanted = (up - down) / (2 * STEP)
    got = [sum((runs.slope[key] * way[key]).sum() for key in KEYS) for way in runs.ways]
    assert (np.abs(wanted) > 1e-6).all()  # each of the keys matters
    np.testing.assert_allclose(got, wanted, rtol=1e-5)


def test_feet_that_stand_stay_and_others_come_down_on_the_ground(runs):
    trace, radius = runs.trace, float(go1.PARAMS.foot_radius)
    assert trace.alive.all()
    assert (trace.status == Status.SOLVED).all()
    stance, way = trace.stance, np.diff(trace.feet, axis=0)
    assert (way[stance[1:] & stance[:-1]] == 0.0).all()
    np.testing.assert_allclose(trace.feet[stance][:, 2], radius, atol=1e-12)
    assert {tuple(row) for row in stance.tolist()} == {
        (True, False, False, True), (False, True, True, False), (False,) * 4
    }  # fmt: skip
    assert trace.feet[~stance][:, 2].max() > radius + 0.03
    # Just before it lands a foot is where it will stand, but for what the target still moves.
    landed = stance[1:] & ~stance[:-1]
    assert np.abs(way[landed]).max() < 0.02


def test_the_body_moves_as_newton_and_euler_say(runs):
    trace, body, dt = runs.trace, runs.plant.body, CONFIG.lmpc.control_dt
    yaw = trace.x[:, 2]
    about_z = rotations.exp(jnp.stack([0 * yaw, 0 * yaw, yaw], axis=-1))
    omega, v = (np.einsum("tij,tj->ti", about_z, trace.x[:, i : i + 3]) for i in (6, 9))
    R = np.asarray(about_z @ tilted(-trace.x[:, 1], 1) @ tilted(trace.x[:, 0], 0))
    L = np.einsum("tij,jk,tlk,tl->ti", R, body.inertia, R, omega)
    force, p = trace.force, trace.x[:, 3:6]
    assert (force[~trace.stance] == 0.0).all()
    push = force.sum(axis=1) - [0.0, 0.0, float(body.mass) * GRAVITY]
    np.testing.assert_allclose(np.diff(v, axis=0), push[:-1] * dt / body.mass, atol=1e-12)
    # The centre of mass moves during a tick: levers are those of its mean place, exactly.
    mean = p + dt / 2 * v + dt**2 / 6 * push / body.mass
    soles = trace.feet - [0.0, 0.0, float(go1.PARAMS.foot_radius)]
    moment = np.cross(soles - mean[:, None], force).sum(axis=1)
    np.testing.assert_allclose(np.diff(L, axis=0), moment[:-1] * dt, atol=1e-12)
    flying = ~trace.stance[:-1].any(axis=1)
    assert flying.sum() >= 4
    assert np.abs(L[:-1][flying]).max() > 1e-3


def tilted(angle, axis):
    return rotations.exp(jnp.asarray(angle)[:, None] * jnp.eye(3)[axis])


def test_forces_keep_to_the_plans_pyramid(runs):
    """Its corners lie at 1 / cos(pi / 8) times the friction that is planned with."""
    force = runs.trace.force[runs.trace.stance]
    most = 0.6 / np.cos(np.pi / 8)
    assert (np.hypot(force[:, 0], force[:, 1]) < (most + 1e-3) * force[:, 2]).all()
