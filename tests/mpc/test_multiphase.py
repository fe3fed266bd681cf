"""The multi-phase LMPC against integrated rigid-body motion, C MuJoCo's leg and closed forms."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kjax import gait
from kjax.config import RunConfig, load_config
from kjax.config.units import in_si
from kjax.controllers.resolve import multiphase_params
from kjax.controllers.walkable import build_gaits, cycle_nodes
from kjax.mpc import cycle_rollout, horizon, multiphase
from kjax.robots import go1
from kjax.spec import CycleSpec
from kjax.types import GRAVITY, Leg

COUNT = 15
WEIGHT, LENGTH = float(go1.PARAMS.mass) * GRAVITY, 0.426  # N, m
BOUND = 1  # index of the gait
FRONT, FIRST_FLIGHT, REAR, SECOND_FLIGHT = range(4)
DURATION = (0.1, 0.1, 0.05, 0.1)  # s


predict = jax.jit(horizon.predict)
preview = jax.jit(gait.preview, static_argnums=2)
build_nodes = jax.jit(horizon.build_nodes, static_argnums=(3, 4))
response = jax.jit(multiphase.response)
roll_out = jax.jit(cycle_rollout.roll_out)
shifted = jax.jit(cycle_rollout.shifted, static_argnums=3)
force_rows = jax.jit(multiphase.force_rows)


@pytest.fixture(scope="module")
def config():
    keys = {
        "sim.base": "planar",
        "gait.also": ["trot", "bound_multiphase"],
        "multiphase.friction": 0.6,
        "multiphase.torque_fraction": 0.95,
        "multiphase.inertia_scale": 0.87,
        "multiphase.velocity_time": 0.3,
        "multiphase.height_time": 0.05,
    }
    own = {
        "Q": [2.9, 27.4, 13.8, 160.0, 11.2, 3.34],
        "R": 0.02657,
        "grf_x_max": 135.0 / WEIGHT,
        "grf_z_min": 10.0 / WEIGHT,
        "grf_z_max": 250.0 / WEIGHT,
        "foothold_front": 0.05 / LENGTH,
        "foothold_rear": 0.1 / LENGTH,
        "foothold_gain": 0.075 / (LENGTH / 9.81) ** 0.5,
        "body_height": 0.27 / LENGTH,
    }
    keys |= {f"gaits.bound_multiphase.{key}": value for key, value in own.items()}
    return load_config(RunConfig, None, keys)


@pytest.fixture(scope="module")
def params(config):
    params = multiphase_params(build_gaits(config), in_si(config, go1.PARAMS), go1.PARAMS)
    return horizon.for_gait(params, jnp.asarray(BOUND))


@pytest.fixture(scope="module")
def schedule(config):
    return gait.build_schedule(build_gaits(config))


def clock_at(phase, elapsed, cycle=10):
    index = [np.asarray(i, np.int32) for i in (BOUND, phase, cycle)]
    return gait.Clock(*index, elapsed=np.asarray(elapsed, float))


def nodes_at(params, schedule, phase, elapsed, cycle=10):
    clock = clock_at(phase, elapsed, cycle)
    return jax.tree.map(np.asarray, build_nodes(params, schedule, clock, COUNT, 0.0025))


@pytest.fixture(scope="module")
def forecast_of(params):
    """Forecast for given nodes, state and command, on flat ground."""

    def build(nodes, x, velocity=0.0, command=0.0, slew=2.0, contact=((0.05, 0.0), (-0.1, 0.0))):
        return predict(
            params,
            nodes,
            x,
            horizon.HorizonCommand(
                position=x[0],
                velocity=velocity,
                target=command,
                slew=np.asarray(slew),
                height=np.asarray(0.27),
                periodic=np.zeros((COUNT, 4)),
            ),
            horizon.Stances(
                ground=np.asarray(0.0),
                feet=np.asarray(contact),
                duration=np.asarray(DURATION)[nodes.phase],
                cycle=np.asarray(0.35),
            ),
        )

    return build


@pytest.mark.parametrize(
    ("phase", "elapsed"),
    [(FRONT, 0.0), (FRONT, 0.03), (FRONT, 0.099), (FIRST_FLIGHT, 0.05), (REAR, 0.013)],
)
def test_the_preview_holds_one_cycle_that_ends_where_it_began(schedule, phase, elapsed):
    ahead = preview(schedule, clock_at(phase, elapsed), 0.0)
    np.testing.assert_allclose(ahead.duration.sum(), 0.35, atol=1e-12)
    np.testing.assert_allclose(ahead.duration[0], DURATION[phase] - elapsed, atol=1e-12)
    np.testing.assert_allclose(ahead.duration[-1], elapsed, atol=1e-12)
    assert ahead.phase.tolist() == [(phase + k) % 4 for k in range(5)]
    np.testing.assert_allclose(ahead.begin[1:], np.cumsum(ahead.duration)[:-1], atol=1e-12)


def test_the_preview_of_a_ramp_takes_the_next_cycles_longer_flights(schedule):
    # The flights are at 0.3 of their length in cycle 0 and grow by 0.07 per cycle.
    ahead = preview(schedule, clock_at(SECOND_FLIGHT, 0.01, cycle=0), 0.0)
    np.testing.assert_allclose(ahead.duration[:4], [0.02, 0.1, 0.037, 0.05], atol=1e-12)
    assert ahead.cycle.tolist() == [0, 1, 1, 1, 1]


@pytest.mark.parametrize("elapsed", [0.0, 0.0125, 0.03, 0.0999, 0.1024, -0.002])
@pytest.mark.parametrize("phase", range(4))
def test_nodes_tile_the_cycle_and_never_cross_a_phase(params, schedule, phase, elapsed):
    if elapsed > DURATION[phase] + 0.0025:
        elapsed = DURATION[phase] / 3
    nodes = nodes_at(params, schedule, phase, elapsed)
    used = np.asarray(nodes.length) > 0
    begin, end = np.asarray(nodes.end - nodes.length)[used], np.asarray(nodes.end)[used]
    np.testing.assert_allclose(begin, np.r_[0.0, end[:-1]], atol=1e-12)
    np.testing.assert_allclose(end[-1], 0.35, atol=0.0026)
    # Each node's middle, mapped to the cycle by hand, lies in the phase that it names.
    starts = np.r_[0.0, np.cumsum(DURATION)]
    place = (
        starts[phase] + np.clip(elapsed, 0, DURATION[phase] - 0.0025) + 0.5 * (begin + end)
    ) % 0.35
    expected = np.searchsorted(starts, place, side="right") - 1
    assert np.asarray(nodes.phase)[used].tolist() == expected.tolist()
    assert np.asarray(nodes.length)[used & (nodes.feet > 0)].max() <= 0.0125 + 1e-9
    standing = np.isin(expected, [FRONT, REAR])
    np.testing.assert_array_equal(np.asarray(nodes.feet)[used], 2.0 * standing)
    np.testing.assert_array_equal(
        np.asarray(nodes.end_index)[used & (nodes.feet > 0)], (expected == REAR)[standing]
    )
    np.testing.assert_array_equal(np.asarray(nodes.feet)[~used], 0.0)


def test_the_predicted_motion_is_the_rigid_bodys_under_the_same_moments(
    params, schedule, forecast_of
):
    # Independent integration of the body with forces in the world frame, the moment arm of each
    # node taken from the forecast's path: the linear response must be exact.
    nodes = nodes_at(params, schedule, FRONT, 0.04)
    x = np.array([0.3, 0.26, 0.1, 0.5, -0.3, 1.2])
    forecast = forecast_of(nodes, x, velocity=0.4, contact=((0.36, 0.0), (0.2, 0.01)))
    free, forced = map(np.asarray, response(params, nodes, forecast, x))
    force = np.random.default_rng(0).normal(size=(COUNT, 2)) * [40, 100]
    states = free + np.einsum("kajf,jf->ka", forced, force)

    m, inertia = float(go1.PARAMS.mass), float(go1.PARAMS.pitch_inertia) * 0.87
    now = np.asarray(x)
    for k in np.flatnonzero(np.asarray(nodes.length) > 0):
        total = force[k] * float(nodes.feet[k])
        r = np.asarray(forecast.foot[k] - forecast.path[k, :2])
        alpha = (r[0] * total[1] - r[1] * total[0]) / inertia
        a = np.r_[total / m - [0, GRAVITY], alpha]
        solved = solve_ivp(
            lambda t, s, a=a: np.r_[s[3:], a], (0, float(nodes.length[k])), now, rtol=1e-10
        )
        now = solved.y[:, -1]
        np.testing.assert_allclose(states[k], now, atol=1e-8)


@pytest.mark.parametrize("slew", [2.0, np.inf])
def test_the_reference_follows_the_command_at_its_slew(params, schedule, forecast_of, slew):
    nodes = nodes_at(params, schedule, FRONT, 0.0)
    x = np.array([0.0, 0.27, 0.0, 0.1, 0.0, 0.0])
    forecast = forecast_of(nodes, x, velocity=0.1, command=0.5, slew=slew)
    t = np.asarray(nodes.end)
    wanted = np.minimum(0.1 + slew * t, 0.5)
    np.testing.assert_allclose(forecast.reference[:, 3], wanted, atol=1e-12)
    # Its position is the integral of its velocity.
    fine = np.linspace(0, t[-1], 20001)
    path = np.r_[0, np.cumsum(np.minimum(0.1 + slew * fine[1:], 0.5)) * (fine[1] - fine[0])]
    np.testing.assert_allclose(forecast.reference[:, 0], np.interp(t, fine, path), atol=2e-5)


def test_feet_in_stance_are_where_they_were_measured_and_coming_ones_at_raiberts(
    params, schedule, forecast_of
):
    nodes = nodes_at(params, schedule, FRONT, 0.05)
    x = np.array([1.0, 0.27, 0.0, 0.6, 0.0, 0.0])
    contact = ((1.07, 0.02), (0.9, 0.0))
    forecast = forecast_of(nodes, x, velocity=0.6, command=0.6, contact=contact)
    foot, phase, present = (np.asarray(a) for a in (forecast.foot, nodes.phase, nodes.present))
    np.testing.assert_allclose(foot[present], [contact[0]] * present.sum())
    # The rear touches down after 0.05 s of stance and 0.1 s of flight, 0.6 m/s all the while.
    rear = foot[phase == REAR]
    np.testing.assert_allclose(rear[:, 0], 1.0 + 0.15 * 0.6 - 0.1 + 0.5 * 0.05 * 0.6, atol=1e-9)
    later = foot[(phase == FRONT) & ~present & (np.asarray(nodes.length) > 0)]
    np.testing.assert_allclose(later[:, 0], 1.0 + 0.3 * 0.6 + 0.05 + 0.5 * 0.1 * 0.6, atol=1e-9)


@pytest.mark.parametrize("end", [0, 1])
def test_torque_rows_are_c_mujocos_jacobian(params, schedule, forecast_of, planar_go1, end):
    phase = REAR if end else FRONT
    nodes = nodes_at(params, schedule, phase, 0.0)
    x = np.array([0.0, 0.25, 0.1, 0.0, 0.0, 0.0])
    forecast = forecast_of(nodes, x, contact=((0.15, 0.0), (-0.2, 0.0)))
    lever = np.array([0.01, -0.02])
    rows, limit = force_rows(params, go1.PARAMS, nodes, forecast, lever)
    np.testing.assert_allclose(limit, [0, 0, 0.95 * 23.7, 0.95 * 35.55], rtol=1e-12)

    # Put MuJoCo's trunk where node 0 expects it and turn the joints until the foot is there.
    leg = Leg.RR if end else Leg.FR
    px, pz, theta = np.asarray(forecast.path[0])
    R = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    data = mujoco.MjData(planar_go1)
    base = [px, pz] - R @ np.asarray(lever)
    data.qpos[[0, 1, 2]] = base[0], base[1], -theta
    joints = [planar_go1.joint(f"{leg.name}_{name}").qposadr[0] for name in ("thigh", "calf")]
    dofs = [planar_go1.joint(f"{leg.name}_{name}").dofadr[0] for name in ("thigh", "calf")]
    data.qpos[joints] = 0.8, -1.6
    geom = planar_go1.geom(f"{leg.name}_foot").id
    target = np.asarray(forecast.foot[0]) + np.array([0, go1.FOOT_RADIUS])
    jacobian = np.zeros((3, planar_go1.nv))
    for _ in range(60):
        mujoco.mj_kinematics(planar_go1, data)
        mujoco.mj_comPos(planar_go1, data)
        point = data.geom_xpos[geom]
        mujoco.mj_jac(planar_go1, data, jacobian, None, point, planar_go1.geom_bodyid[geom])
        J = jacobian[[0, 2]][:, dofs]
        error = target - point[[0, 2]]
        data.qpos[joints] += np.linalg.solve(J, np.clip(error, -0.02, 0.02))
    assert np.abs(error).max() < 1e-9
    np.testing.assert_allclose(rows[0, 2:], J.T, atol=1e-6)


@pytest.fixture(scope="module")
def plan(params, schedule, forecast_of):
    """A solved plan of a moving robot in front stance, with all that went in."""
    nodes = nodes_at(params, schedule, FRONT, 0.02)
    x = np.array([0.0, 0.262, -0.08, 0.3, -0.1, -0.3])
    forecast = forecast_of(nodes, x, velocity=0.3, command=1.0)
    lever = np.array([0.0, -0.018])

    spec = CycleSpec(nodes=COUNT - 1, tolerance=1e-9, max_iterations=40)

    @jax.jit
    def run(params, robot, nodes, forecast, x, lever):
        return multiphase.solve(params, robot, nodes, forecast, x, lever, spec)

    def solve(params):
        return run(params, go1.PARAMS, nodes, forecast, x, lever)

    rows, limit = force_rows(params, go1.PARAMS, nodes, forecast, lever)
    return solve, nodes, forecast, rows, limit


def test_the_plan_keeps_to_friction_torque_and_box(params, plan):
    solve, nodes, _, rows, limit = plan
    solved = solve(params)
    assert solved.status == 0
    force = np.asarray(solved.force)
    standing = np.asarray(nodes.feet) > 0
    np.testing.assert_array_equal(force[~standing], 0.0)
    assert (np.abs(force[:, 0]) <= 0.6 * force[:, 1] + 1e-4)[standing].all()
    assert (force[standing, 1] >= 10.0 - 1e-4).all()
    torque = np.einsum("krf,kf->kr", np.asarray(rows)[:, 2:], force)
    assert (np.abs(torque) <= np.asarray(limit)[2:] + 1e-4).all()


def test_the_plan_makes_use_of_the_flight_it_foresees(params, plan):
    # To speed up, both stances push forwards, though the rear one comes after a flight.
    solve, nodes, *_ = plan
    force, feet = np.asarray(solve(params).force), np.asarray(nodes.feet * nodes.length)
    rear = np.asarray(nodes.phase) == REAR
    impulse = feet * force[:, 0]
    assert impulse.sum() > 0.5
    assert impulse[rear].sum() > 0.1
    # And the vertical impulses carry the weight over the cycle within what pitch leaves free.
    assert feet @ force[:, 1] == pytest.approx(12.743 * GRAVITY * 0.35, rel=0.15)


def test_a_tighter_torque_limit_binds(params, plan):
    solve, _, _, rows, _ = plan
    tight = params._replace(torque_limit=0.6 * params.torque_limit)
    torque = np.einsum("krf,kf->kr", np.asarray(rows)[:, 2:], np.asarray(solve(tight).force))
    assert np.abs(torque[:, 1]).max() == pytest.approx(0.6 * 0.95 * 35.55, rel=1e-3)


def test_only_a_bound_with_that_horizon_has_nodes(config):
    gaits = build_gaits(config)
    nodes = cycle_nodes(gaits, config)
    assert nodes[BOUND].tolist() == [8, 1, 4, 1]
    assert nodes.sum() == nodes[BOUND].sum()
    assert cycle_nodes(build_gaits(RunConfig()), RunConfig()).sum() == 0
    assert gaits[BOUND].phases[1].flies


@pytest.mark.parametrize("slew", [2.0, np.inf])
def test_an_outlook_has_derivatives_where_the_reference_has_arrived(
    params, schedule, forecast_of, slew
):
    """Reverse mode by velocity and command, against differences; at the kink from one side."""
    nodes = nodes_at(params, schedule, FRONT, 0.03)
    x = np.array([0.1, 0.27, 0.02, 0.35, -0.1, 0.4])

    @jax.jit
    def total(velocity, command):
        out = forecast_of(nodes, x, velocity, command, slew)
        return jnp.sum(out.path) + 0.3 * jnp.sum(out.reference) + 0.7 * jnp.sum(out.foot)

    both = jax.jit(jax.grad(total, argnums=(0, 1)))
    assert np.isfinite(both(0.3, 0.3)).all()
    for velocity, command in ((0.3, 0.3001), (0.3, 0.9)):
        slopes = both(velocity, command)
        h = 1e-6
        wanted = (
            (total(velocity + h, command) - total(velocity - h, command)) / (2 * h),
            (total(velocity, command + h) - total(velocity, command - h)) / (2 * h),
        )
        np.testing.assert_allclose(slopes, wanted, rtol=1e-6, atol=1e-7)


def rigid_body_motion(nodes, forecast, x, force):
    """States at the nodes' ends of the nonlinear body, with feet that Raibert's law puts down.

    One Runge-Kutta step per node is exact: under a held force pitch is a polynomial of degree 4.
    """
    nodes, forecast = (jax.tree.map(np.asarray, a) for a in (nodes, forecast))
    m, inertia = float(go1.PARAMS.mass), float(go1.PARAMS.pitch_inertia) * 0.87
    now, states, foot, start = np.array(x), [], forecast.foot.copy(), None
    for k, h in enumerate(nodes.length):
        if not nodes.present[k]:
            if nodes.begin[k] != start:
                start = nodes.begin[k]
                touchdown = now[0] + forecast.ahead[k] + forecast.by_speed[k] * now[3]
            foot[k, 0] = touchdown
        total = force[k] * nodes.feet[k]

        def rate(s, f=total, r=foot[k]):
            moment = (r[0] - s[0]) * f[1] - (r[1] - s[1]) * f[0]
            return np.r_[s[3:], f[0] / m, f[1] / m - GRAVITY, moment / inertia]

        k1 = rate(now)
        k2 = rate(now + h / 2 * k1)
        k3 = rate(now + h / 2 * k2)
        now = now + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(now + h * k3))
        states.append(now)
    return np.array(states)


@pytest.fixture(params=[(FRONT, 0.03), (REAR, 0.01)], ids=["front", "rear"])
def moving(request, params, schedule, forecast_of):
    """Nodes and forecast of a tilted body on its way, and forces of a plan far from the mean."""
    nodes = nodes_at(params, schedule, *request.param)
    x = np.array([0.3, 0.26, 0.1, 0.5, -0.3, 1.2])
    forecast = forecast_of(nodes, x, velocity=0.4, command=0.6, contact=((0.36, 0.0), (0.2, 0.01)))
    rng = np.random.default_rng(0)
    standing = (np.asarray(nodes.feet) > 0)[:, None]
    vertical = np.asarray(forecast.force_z) * rng.uniform(0.6, 1.4, COUNT)
    force = standing * np.stack([rng.normal(size=COUNT) * 25.0, vertical], axis=1)
    return nodes, forecast, x, force


def test_the_roll_out_and_its_derivative_are_the_rigid_bodys(params, moving):
    nodes, forecast, x, force = moving
    about = jax.tree.map(np.asarray, roll_out(params, nodes, forecast, x, force))
    # Both are exact: rounding is left, of differences over 1e-3 N too (the motion is quadratic).
    exact = rigid_body_motion(nodes, forecast, x, force)
    np.testing.assert_allclose(about.states, exact, atol=1e-12)
    for j, axis in np.ndindex(COUNT, 2):
        change = np.zeros((COUNT, 2))
        change[j, axis] = 1e-3 * float(nodes.feet[j] > 0)
        both = [rigid_body_motion(nodes, forecast, x, force + s * change) for s in (1, -1)]
        slope = (both[0] - both[1]) / 2e-3
        np.testing.assert_allclose(about.by_force[:, :, j, axis], slope, atol=1e-10)


def test_toppling_and_next_footholds_are_predicted_when_forces_change(params, moving):
    # The plan after a disturbance differs by a fifth from the last one. A path that does not
    # depend on the forces misses the moments that the change makes.
    nodes, forecast, x, force = moving
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(20):
        last = force * rng.uniform(0.8, 1.2, force.shape)
        about = jax.tree.map(np.asarray, roll_out(params, nodes, forecast, x, last))
        here = forecast._replace(path=about.path, foot=about.foot)
        free, forced = map(np.asarray, response(params, nodes, here, x))
        exact = rigid_body_motion(nodes, forecast, x, force)
        predicted = about.states + np.einsum("kajf,jf->ka", about.by_force, force - last)
        fixed = free + np.einsum("kajf,jf->ka", forced, force)
        np.testing.assert_allclose(predicted[:, [0, 1, 3, 4]], exact[:, [0, 1, 3, 4]], atol=1e-12)
        errors.append([np.abs(a - exact)[-1, [2, 5]] for a in (predicted, fixed)])
    with_arms, without = np.sqrt(np.mean(np.square(errors), axis=0))
    # 10 to 13 times; a fifth of what changes is left to second order.
    assert (8 * with_arms < without).all()


def test_replanning_about_the_plan_ends_at_a_plan_that_the_rigid_body_follows(
    params, schedule, forecast_of
):
    nodes = nodes_at(params, schedule, FRONT, 0.02)
    x = np.array([0.0, 0.262, -0.08, 0.3, -0.1, -0.3])
    forecast = forecast_of(nodes, x, velocity=0.3, command=1.0)
    spec = CycleSpec(nodes=COUNT - 1, tolerance=1e-9, max_iterations=40)

    @jax.jit
    def run(params, robot, nodes, forecast, x, nominal):
        lever = jnp.array([0.0, -0.018])
        return multiphase.solve(params, robot, nodes, forecast, x, lever, spec, nominal)

    nominal = np.stack([np.zeros(COUNT), np.asarray(forecast.force_z)], axis=1)
    for _ in range(8):
        solved = run(params, go1.PARAMS, nodes, forecast, x, nominal)
        assert solved.status == 0
        nominal = np.asarray(solved.force)
    exact = rigid_body_motion(nodes, forecast, x, nominal)
    np.testing.assert_allclose(solved.states, exact, atol=1e-5)  # what 8 plans leave


def test_the_last_plan_is_found_again_in_later_nodes(params, schedule):
    before = nodes_at(params, schedule, FRONT, 0.02)
    force = np.random.default_rng(0).uniform(10.0, 90.0, (COUNT, 2))
    force[np.asarray(before.feet) == 0] = 0.0
    memory = cycle_rollout.CycleMemory(force=force, end=before.end)
    later = nodes_at(params, schedule, FRONT, 0.025)
    otherwise = np.where(later.feet > 0, 77.0, 0.0)
    got = np.asarray(shifted(memory, later, otherwise, 0.005))
    middle = 0.005 + later.end - 0.5 * later.length
    for k in np.flatnonzero(later.feet > 0):
        node = np.searchsorted(before.end, middle[k], side="right")
        expected = force[node] if node < COUNT else [0.0, 77.0]
        np.testing.assert_array_equal(got[k], expected)
    np.testing.assert_array_equal(got[later.feet == 0], 0.0)
    # Long after, nothing of it is left.
    old = cycle_rollout.aged(memory, 1.0)
    np.testing.assert_array_equal(shifted(old, later, otherwise, 0.005)[:, 1], otherwise)
