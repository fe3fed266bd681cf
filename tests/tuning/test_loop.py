import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig, load_config
from kjax.robots import go1
from kjax.tuning import loop
from kjax.tuning import plant as body_plant
from kjax.tuning.optimise import build_objective
from kjax.tuning.space import build_space
from kjax.types import GRAVITY, Mode

# One trot stance, then a bound with short flights: mode switches, touchdowns and active bounds.
CONFIG = load_config(
    RunConfig,
    None,
    {
        "duration": 0.5,
        "sim.base": "planar",
        "gait.names": ["trot", "bound"],
        "gait.times": [0.0, 0.1],
        "gaits.trot.period": 0.2,
        "gaits.bound.period": 0.25,
        "gaits.bound.offset": [0.0, 0.0, 0.6, 0.6],
        "gaits.bound.duty": [0.4, 0.4, 0.2, 0.2],
        "gaits.bound.ramp_cycles": 2,
        # Over 6 ms at the bound's own weights the loop is chaotic: see the benchmark's README row.
        "gaits.bound.R": 0.07814,
    },
)
KEYS = (
    "lmpc.Q",
    "gaits.bound.Q",
    "gaits.bound.foothold_front",
    "gaits.bound.force_edge",
    "gaits.bound.grf_z_min",
    "gaits.bound.foothold_gain",
)
COUNT = 4

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def space():
    return build_space(CONFIG, KEYS)


@pytest.fixture(scope="module")
def run(space):
    """Compiled: (variables, scenarios) -> traces."""
    one = loop.build_loop(CONFIG)
    return jax.jit(lambda z, s: jax.vmap(one, (None, 0))(space.params(z), s))


@pytest.fixture(scope="module")
def slopes(space):
    """Compiled: (variables, scenarios) -> cost and gradient of each."""
    objective = build_objective(CONFIG, space)
    return jax.jit(jax.vmap(jax.value_and_grad(objective), (None, 0)))


@pytest.fixture(scope="module")
def scenarios():
    return loop.draw_scenarios(CONFIG, 0, COUNT, speeds=(0.0, 0.6))


def costs_of(trace):
    return np.asarray(jax.vmap(lambda t: loop.cost(go1.PARAMS, t))(trace))


def test_gradients_are_those_of_finite_differences_through_bounds_and_switches(
    space, run, slopes, scenarios
):
    costs, slope = slopes(space.start, scenarios)
    trace = run(space.start, scenarios)
    np.testing.assert_allclose(costs, costs_of(trace), rtol=1e-9)
    assert set(np.unique(trace.mode)) == {Mode.TROT, Mode.FRONT, Mode.REAR, Mode.FLIGHT}
    pressing = np.asarray(trace.stance).any(axis=2)
    # Forces lag: at the bound of 51.5 N but for what is left of it.
    assert (np.abs(trace.force + trace.missing)[..., 0].max(axis=2)[pressing] >= 51.4).any()
    errors = []
    for key, one in space.start.items():
        for index in np.ndindex(np.shape(one)):
            # Rounding of 1e-13 over the step of 1e-6, truncation of the step's square.
            step = 1e-6
            up, down = (
                costs_of(run({**space.start, key: one.at[index].add(sign * step)}, scenarios))
                for sign in (1.0, -1.0)
            )
            wanted = (up - down) / (2 * step)
            own = np.asarray(slope[key])[(slice(None), *index)]
            errors.append(np.abs(own - wanted) / np.maximum(np.abs(wanted), 1e-4))
    # The cost has kinks where active sets change: at a few of the points one lies within the step.
    assert np.median(errors) < 1e-6
    assert np.quantile(errors, 0.9) < 1e-4


def test_the_scheduled_feet_carry_and_stay_where_they_are(space, run, scenarios):
    trace = run(space.start, scenarios)
    assert bool(trace.alive.all())
    assert trace.x.shape == (COUNT, 100, 6)
    force, stance = np.asarray(trace.force), np.asarray(trace.stance)
    assert (force[~stance] == 0.0).all()
    displacement = np.diff(np.asarray(trace.feet), axis=1)
    assert (displacement[stance[:, 1:] & stance[:, :-1]] == 0.0).all()
    landed = stance[:, 1:] & ~stance[:, :-1]
    assert (np.abs(displacement[landed][:, 0]) > 1e-4).any()
    assert (np.asarray(trace.status) == 0).all()


def test_in_flight_the_body_falls_freely(space, run, scenarios):
    massless = scenarios.plant._replace(spin=jnp.zeros_like(scenarios.plant.spin))
    trace = run(space.start, scenarios._replace(plant=massless))
    flying = np.asarray(trace.mode)[:, :-1] == Mode.FLIGHT
    change = np.diff(np.asarray(trace.x), axis=1)[flying]
    assert len(change) > 10
    np.testing.assert_allclose(change[:, 4], -GRAVITY * CONFIG.lmpc.control_dt, rtol=1e-9)
    np.testing.assert_allclose(change[:, [3, 5]], 0.0, atol=1e-12)


def test_in_flight_swinging_legs_turn_the_trunk_and_angular_momentum_stays(space, run, scenarios):
    trace = jax.tree.map(np.asarray, run(space.start, scenarios))
    dt, turned = CONFIG.lmpc.control_dt, []
    for robot in range(COUNT):
        plant = jax.tree.map(lambda a, i=robot: a[i], scenarios.plant)
        rate = np.gradient(trace.feet[robot], dt, axis=0)  # of the feet as recorded

        def momentum(x, feet, rate, plant=plant):
            body = body_plant.view(go1.PARAMS, plant.com, x, feet).planar
            legs = body_plant.leg_momentum(go1.PARAMS, plant, body, feet, rate)
            return jnp.stack([plant.inertia * x[5], legs])

        parts = np.asarray(jax.jit(jax.vmap(momentum))(trace.x[robot], trace.feet[robot], rate))
        flying = trace.mode[robot] == Mode.FLIGHT
        inner = flying[1:-1] & flying[:-2] & flying[2:]  # whose differences lie in the flight
        both = inner[1:] & inner[:-1]
        turned.append(np.diff(parts[1:-1], axis=0)[both])
    body, legs = np.concatenate(turned).T
    assert len(body) > 10
    assert np.abs(body).max() > 0.01  # kg m^2/s in a tick: 5 rad/s^2
    # Differences over two ticks of a swing of ten: a tenth.
    assert np.abs(body + legs).max() < 0.2 * np.abs(body).max()


def test_a_foot_lands_where_raiberts_law_says(space, run, scenarios):
    trace = run(space.start, scenarios._replace(noise=jnp.zeros_like(scenarios.noise)))
    one = jax.tree.map(lambda a: np.asarray(a[0]), trace)
    # The second touchdown of the front right foot, in the bound; without noise it is exact.
    tick = int(np.flatnonzero(one.stance[1:, 0] & ~one.stance[:-1, 0])[-1]) + 1
    x, com, hip = one.x[tick], scenarios.plant.com[0], go1.PARAMS.hip_pos[0, ::2]
    c, s = np.cos(x[2]), np.sin(x[2])
    along = float(x[0]) + c * (hip[0] - com[0]) - s * (hip[1] - com[1])
    along += 0.426 * CONFIG.gaits.bound.foothold_front - hip[0] + x[3] * 0.5 * 0.1
    gain = (0.426 / 9.81) ** 0.5 * CONFIG.gaits.bound.foothold_gain
    along += gain * (x[3] - one.wanted[tick - 1, 0])
    assert one.feet[tick, 0, 0] == pytest.approx(float(along), abs=1e-12)


def test_keeping_other_states_changes_neither_value_nor_gradient(space, slopes, scenarios):
    other = loop.build_loop(CONFIG, segment=33)

    def objective(z, scenario):
        return loop.cost(go1.PARAMS, other(space.params(z), scenario))

    costs, slope = jax.jit(jax.vmap(jax.value_and_grad(objective), (None, 0)))(
        space.start, scenarios
    )
    wanted, wanted_slope = slopes(space.start, scenarios)
    np.testing.assert_allclose(costs, wanted, rtol=1e-9)
    for key, one in slope.items():
        scale = np.abs(wanted_slope[key]).max()
        np.testing.assert_allclose(one / scale, wanted_slope[key] / scale, atol=1e-6)


def test_a_body_that_falls_is_held_and_its_cost_and_gradient_are_finite(
    space, run, slopes, scenarios
):
    tipped = scenarios._replace(x=scenarios.x.at[0, 5].set(15.0))  # turns over
    costs, slope = slopes(space.start, tipped)
    trace = run(space.start, tipped)
    assert not trace.alive[0, -1]
    assert trace.alive[1:].all()
    assert costs[0] > 3.0 * costs[1]
    assert np.isfinite(costs).all()
    assert all(np.isfinite(one).all() for one in slope.values())
    fallen = ~np.asarray(trace.alive[0])
    assert np.ptp(np.asarray(trace.x[0])[fallen], axis=0).max() == 0.0
    # The others are what they are without it.
    np.testing.assert_allclose(costs[1:], slopes(space.start, scenarios)[0][1:], rtol=1e-9)


def test_a_free_base_is_refused():
    config = load_config(RunConfig, None, {"sim.base": "free"})
    with pytest.raises(ValueError, match=r"sim\.base must be 'planar'"):
        loop.build_loop(config)
