"""Tables and plans: the closed-form regulator, bounds, swing legs, contact points."""

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.config import GaitConfig, Gaits, LmpcConfig, RunConfig
from kjax.config.gaits import LIBRARY
from kjax.config.units import in_si
from kjax.controllers import planning
from kjax.controllers.resolve import problem_settings
from kjax.controllers.walkable import Problem
from kjax.dynamics import srb_planar
from kjax.koopman import models, observables
from kjax.legs.kinematics import LegTrig, leg_trig
from kjax.legs.posture import stand_pose
from kjax.mpc import limits, lmpc
from kjax.qp import Status
from kjax.robots import go1
from kjax.spec import ControllerSpec
from kjax.types import MODE_ALPHA, Mode

DT = 1e-3  # s, step of the fitted models
MASS = 12.7
G = 9.81
FREE = LmpcConfig(
    horizon=4,
    model_dt=0.005,
    grf_x_max=np.inf,
    grf_z_min=-np.inf,
    grf_z_max=np.inf,
    tolerance=1e-11,
)
FREE_BOUND = dataclasses.replace(
    LIBRARY["bound"], grf_x_max=np.inf, grf_z_min=-np.inf, grf_z_max=np.inf
)
BOUNDED = LmpcConfig(
    horizon=4, model_dt=0.005, grf_z_min=0.04, tolerance=1e-9, input_reference="zero"
)
# A bound's own weights and bounds, all unlike those of the other modes.
BOUND = GaitConfig(
    Q=(163.0, 1815.0, 500.0, 21.0, 8.4, 4.6),
    R=0.47,
    grf_x_max=0.32,
    grf_z_min=0.16,
    grf_z_max=2.4,
)
WEIGHT, LENGTH = float(go1.PARAMS.mass) * 9.81, 0.426  # N, m
# Units of Q: length, angle, speed sqrt(g L), pitch rate sqrt(g / L).
STATE_UNITS = np.array([LENGTH**-2] * 2 + [1.0] + [1 / (9.81 * LENGTH)] * 2 + [LENGTH / 9.81])
SPEC = ControllerSpec(horizon=4, model_dt=0.005, tolerance=1e-9)
FREE_SPEC = dataclasses.replace(SPEC, tolerance=1e-11)
AHEAD = 0.005 * np.arange(1, 5)  # s

lift = jax.jit(observables.paper(4).lift)
reference_trajectory = jax.jit(planning.reference_trajectory)
condense_all = jax.jit(lmpc.build_tables, static_argnames=("steps", "horizon"))
solve = jax.jit(lmpc.solve_lmpc, static_argnames="spec")
shift_plan = jax.jit(lmpc.shift_plan, static_argnums=1)
start_memory = jax.jit(lmpc.start_memory, static_argnums=1)
input_map = jax.jit(models.input_map)


@partial(jax.jit, static_argnames=("friction", "torque_fraction"))
def force_limits(trig, rotation, stance, friction, torque_fraction):
    return limits.force_limits(
        go1.PARAMS, trig, rotation, stance, friction=friction, torque_fraction=torque_fraction
    )


def here(tables, mode, feet):
    """The tables' model of a mode for contact points that are measured."""
    model = jax.tree.map(lambda a: np.asarray(a)[mode], tables.model)
    return model._replace(B=input_map(model, feet))


def mode_settings(lmpc, bound, force):
    """Front and rear stance those of a bound, the other modes of gaits without their own."""
    names = ["bound" if mode in (Mode.FRONT, Mode.REAR) else "trot" for mode in Mode]
    config = RunConfig(lmpc=lmpc, gaits=Gaits({"bound": bound, "trot": GaitConfig()}))
    problems = [Problem(gait=int(mode), mode=mode) for mode in Mode]
    return problem_settings(in_si(config, go1.PARAMS), problems, names, force)


def build(model, feet, config, bound):
    """Tables of all modes, with the same contact points in each; the weight shared or left out."""
    legs = np.maximum(MODE_ALPHA.sum(axis=1, keepdims=True), 1)
    wanted = (config.input_reference == "mean") * MASS * G / legs * np.ones((1, 2))
    return condense_all(
        model,
        mode_settings(config, bound, jnp.asarray(wanted)),
        steps=round(config.model_dt / DT),
        horizon=config.horizon,
        feet=np.tile(feet, (len(Mode), 1, 1)),
    )


def cast(tree, dtype):
    """Floating leaves in another precision, the rest as they are."""
    return jax.tree.map(
        lambda a: np.asarray(a, dtype if jnp.issubdtype(a.dtype, jnp.floating) else None), tree
    )


@pytest.fixture(scope="module")
def model(fitted):
    return fitted[0]


@pytest.fixture(scope="module")
def free(model, body):
    return build(model, body.feet, FREE, FREE_BOUND)


@pytest.fixture(scope="module")
def bounded(model, body):
    return build(model, body.feet, BOUNDED, BOUND)


@pytest.fixture(scope="module")
def start():
    """A disturbed state (6,) and a reference (4, 6) of walking at 0.3 m/s."""
    x = np.array([0.02, 0.25, 0.05, 0.1, -0.1, 0.4])
    reference = reference_trajectory(
        position=np.asarray(0.0),
        height=np.asarray(0.27),
        velocity=np.asarray(0.3),
        periodic=np.zeros((4, 4)),
        ahead=AHEAD,
    )
    return x, np.asarray(reference)


def memory(dtype="float64"):
    """Nothing remembered."""
    return lmpc.LmpcMemory(plan=np.zeros(16, dtype), problem=np.asarray(-1, np.int32), warm=None)


def horizon_by_hand(model, mode, config, x):
    """Free response and forced response of the states over the horizon, by stepping in numpy."""
    A, B = np.asarray(model.A)[mode], np.asarray(model.B)[mode]
    k, hold = config.horizon, round(config.model_dt / DT)

    def run(z, plan):
        states = []
        for u in plan:
            for _ in range(hold):
                z = A @ z + B @ u
            states.append(z[1:7])
        return np.concatenate(states)

    free = run(np.asarray(lift(x)), np.zeros((k, 4)))
    columns = [run(np.zeros(len(A)), e.reshape(k, 4)) for e in np.eye(4 * k)]
    return free, np.stack(columns, axis=1)


@pytest.mark.parametrize("mode", [Mode.TROT, Mode.STAND, Mode.FRONT, Mode.REAR])
def test_without_active_bounds_the_plan_is_the_least_squares_regulator(mode, free, model, start):
    """The finite-horizon LQ problem as one weighted least-squares problem, by numpy.

    Each mode with its own weights, and with the forces of its stance legs only.
    """
    x, reference = start
    plan = solve(free, np.asarray(int(mode)), lift(x), reference, memory(), spec=FREE_SPEC)
    assert plan.status == Status.SOLVED
    response, forced = horizon_by_hand(model, mode, FREE, x)
    own = FREE_BOUND if mode in (Mode.FRONT, Mode.REAR) else FREE
    Q, R = np.tile(own.Q * STATE_UNITS, 4), np.full(16, own.R / WEIGHT**2)
    hover = np.tile([0.0, MASS * G / MODE_ALPHA[mode].sum()], 8)
    standing = np.tile(np.repeat(MODE_ALPHA[mode] > 0, 2), 4)
    rows = np.concatenate([np.sqrt(Q)[:, None] * forced, np.diag(np.sqrt(R))])[:, standing]
    wanted = np.concatenate([np.sqrt(Q) * (reference.ravel() - response), np.sqrt(R) * hover])
    u = np.zeros(16)
    # The rows of the forces left out say sqrt(R) * 0 = sqrt(R) * hover: constants.
    u[standing] = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    assert np.abs(u).max() > 20.0
    # Rounding 2e-16 times the condition of H, 1e5, times forces of 1e3 N. An end that is fixed to
    # zero makes the solver iterate: tolerance times condition times forces, seen 100 times less.
    atol = 1e-6 if mode in (Mode.FRONT, Mode.REAR) else 2e-8
    np.testing.assert_allclose(plan.plan, u, rtol=0, atol=atol)


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("name", ["float32", "float64"])
def test_plans_respect_the_bounds_and_swing_legs_get_exactly_no_force(mode, name, bounded, start):
    spec = ControllerSpec(horizon=4, model_dt=0.005)  # default tolerance
    tables = cast(bounded, name)
    own = BOUND if mode in (Mode.FRONT, Mode.REAR) else BOUNDED
    limits = np.array([own.grf_x_max, own.grf_z_min, own.grf_z_max]) * WEIGHT
    limits = limits.astype(name)
    for scale in (1.0, 30.0):  # the larger disturbance drives every force to a bound
        x, reference = (a.astype(name) for a in start)
        z = lift(scale * (x - reference[0]) + reference[0])
        solution = solve(tables, np.asarray(int(mode)), z, reference, memory(name), spec)
        assert solution.status == Status.SOLVED
        forces = np.asarray(solution.plan).reshape(4, 2, 2)
        for end, standing in enumerate(MODE_ALPHA[mode] > 0):
            if not standing:
                np.testing.assert_array_equal(forces[:, end], 0.0)
                continue
            sideways, least, most = limits
            assert (np.abs(forces[:, end, 0]) <= sideways).all()
            assert (forces[:, end, 1] >= least).all()
            assert (forces[:, end, 1] <= most).all()
    if mode != Mode.FLIGHT:
        assert np.isin(np.abs(forces), limits).any()


def test_tables_hold_the_model_over_one_model_step(bounded, model):
    expected = jax.jit(jax.vmap(partial(models.aggregate, steps=5)))(model)
    # The same products, fused differently: rounding of entries of order one.
    chex.assert_trees_all_close(bounded.model, expected, rtol=0, atol=1e-13)


def test_contact_points_make_no_difference_to_a_model_that_ignores_them(bounded, start):
    x, reference = start
    arguments = (bounded, np.asarray(int(Mode.TROT)), lift(x), reference, memory())
    offline = solve(*arguments, spec=SPEC)
    model = here(bounded, Mode.TROT, np.array([[0.1, -0.2], [-0.3, -0.4]]))
    online = solve(*arguments, spec=SPEC, model=model)
    assert offline.status == online.status == Status.SOLVED
    # The same iterations but for rounding: 2e-16 times condition 1e5 times forces of 1e2 N.
    np.testing.assert_allclose(online.plan, offline.plan, rtol=0, atol=1e-8)


@pytest.fixture(scope="module")
def measured(fitted_moving_feet, body):
    return build(fitted_moving_feet[0], body.feet, BOUNDED, BOUND)


@pytest.mark.parametrize("mode", [Mode.FRONT, Mode.TROT, Mode.STAND])
def test_measured_contact_points_at_their_nominal_place_give_the_tables_plan(
    mode, measured, body, start
):
    x, reference = start
    arguments = (measured, np.asarray(int(mode)), lift(x), reference, memory())
    offline = solve(*arguments, spec=SPEC)
    online = solve(*arguments, spec=SPEC, model=here(measured, mode, body.feet))
    assert offline.status == online.status == Status.SOLVED
    # As above: rounding seen through the condition.
    np.testing.assert_allclose(online.plan, offline.plan, rtol=0, atol=1e-8)


def test_a_foot_further_forward_takes_less_of_the_weight_to_hold_the_pitch(measured, body):
    """Statics: level and at rest, the two vertical forces balance their moments about the CoM."""
    x = np.array([0.0, 0.27, 0.0, 0.0, 0.0, 0.0])
    reference = np.tile(x, (4, 1))
    shares = []
    for shift in (-0.05, 0.0, 0.05):
        feet = np.array(body.feet)
        feet[0, 0] += shift
        arguments = (measured, np.asarray(int(Mode.TROT)), lift(x), reference, memory())
        model = here(measured, Mode.TROT, feet)
        force = np.asarray(solve(*arguments, spec=SPEC, model=model).plan)
        shares.append(float(force[1] / (force[1] + force[3])))
    assert shares[0] > shares[1] > shares[2]


def test_plans_of_a_batch_with_mixed_modes_equal_single_plans(bounded, start):
    x, reference = start
    batch = jax.jit(
        jax.vmap(
            lambda mode, z: lmpc.solve_lmpc(
                bounded, mode, z, jnp.asarray(reference), jax.tree.map(jnp.asarray, memory()), SPEC
            ),
            in_axes=(0, 0),
        )
    )
    states = np.stack([x + 0.01 * i for i in range(len(Mode))])
    lifted = np.stack([lift(x) for x in states])
    plans = jax.tree.map(np.asarray, batch(np.arange(len(Mode)), lifted))
    for mode in Mode:
        single = solve(bounded, np.asarray(int(mode)), lifted[mode], reference, memory(), SPEC)
        assert plans.status[mode] == single.status == Status.SOLVED
        # As above: rounding seen through the condition.
        np.testing.assert_allclose(plans.plan[mode], single.plan, rtol=0, atol=1e-8)


def test_changing_mode_and_state_traces_once(bounded, start):
    reference, nothing = jax.device_put((start[1], memory()))

    @jax.jit
    @chex.assert_max_traces(n=1)
    def plan(mode, x):
        return lmpc.solve_lmpc(bounded, mode, lift(x), reference, nothing, SPEC)

    results = [plan(np.asarray(int(mode)), start[0]) for mode in Mode]
    chex.assert_trees_all_equal_shapes_and_dtypes(*results)


def test_the_rigid_body_under_the_plan_stands_up_from_a_tilt(bounded, body):
    """Closed loop on the exact dynamics: pitch and height come back within a second."""
    alpha = jnp.asarray(MODE_ALPHA[Mode.STAND], float)
    reference = jnp.tile(jnp.array([0.0, 0.27, 0.0, 0.0, 0.0, 0.0]), (4, 1))

    def tick(carry, _):
        x, memory = carry
        mode = jnp.asarray(int(Mode.STAND), jnp.int32)
        plan = lmpc.solve_lmpc(bounded, mode, lift(x), reference, memory, SPEC)
        for _ in range(5):
            x = srb_planar.rk4_step(body, alpha, x, plan.plan[:4], DT)
        memory = lmpc.LmpcMemory(plan=plan.plan, problem=mode, warm=plan.warm)
        return (x, memory), (x, plan.status)

    x0 = jnp.array([0.0, 0.25, 0.1, 0.0, 0.0, 0.0])
    _, (states, status) = jax.jit(lambda carry: jax.lax.scan(tick, carry, length=200))(
        (x0, start_memory(bounded, SPEC))
    )
    states = np.asarray(states)
    np.testing.assert_array_equal(status, Status.SOLVED)
    # 0.1 rad shrinks fivefold; the input weight on the absolute force leaves a droop in height.
    assert abs(states[-1, 2]) < 0.02
    assert abs(states[-1, 1] - 0.27) < 0.015
    assert np.abs(states[-1, 3:]).max() < 0.05


@pytest.mark.parametrize("mode", list(Mode))
def test_the_mean_force_becomes_the_input_reference_of_standing_legs(mode):
    force = 10.0 + np.arange(2.0 * len(Mode)).reshape(-1, 2)
    settings = mode_settings(FREE, FREE_BOUND, jnp.asarray(force))
    lower, upper, reference = (
        a[mode].reshape(2, 2) for a in (settings.lower, settings.upper, settings.input_reference)
    )
    standing = MODE_ALPHA[mode] > 0
    np.testing.assert_array_equal(reference[:, 0], 0.0)
    np.testing.assert_array_equal(reference[:, 1], np.where(standing, force[mode], 0.0))
    np.testing.assert_array_equal(lower[~standing], 0.0)
    np.testing.assert_array_equal(upper[~standing], 0.0)
    np.testing.assert_array_equal(lower[standing], -np.inf)
    np.testing.assert_array_equal(upper[standing], np.inf)


@pytest.mark.parametrize("mode", list(Mode))
def test_front_and_rear_stance_have_the_bound_s_weights_and_limits_and_the_others_their_own(mode):
    settings = mode_settings(BOUNDED, BOUND, jnp.zeros((len(Mode), 2)))
    single = mode in (Mode.FRONT, Mode.REAR)
    own = BOUND if single else BOUNDED
    close = partial(np.testing.assert_allclose, rtol=1e-14)  # rounding of products
    close(settings.state_weights[mode], np.array(own.Q) * STATE_UNITS)
    close(settings.input_weights[mode], own.R / WEIGHT**2)
    standing = np.repeat(MODE_ALPHA[mode] > 0, 2)
    low, high = ([-0.32, 0.16], [0.32, 2.4]) if single else ([-0.48, 0.04], [0.48, 1.28])
    close(settings.lower[mode], standing * np.tile(low, 2) * WEIGHT)
    close(settings.upper[mode], standing * np.tile(high, 2) * WEIGHT)


def test_the_contact_points_of_each_mode_enter_its_own_tables(fitted_moving_feet, body):
    model = fitted_moving_feet[0]
    settings = mode_settings(BOUNDED, BOUND, jnp.zeros((len(Mode), 2)))
    arguments = {"steps": 5, "horizon": 4}
    same = np.tile(body.feet, (len(Mode), 1, 1))
    shifted = same.copy()
    shifted[Mode.FRONT, 0, 0] += 0.05
    one, other = (
        np.asarray(condense_all(model, settings, **arguments, feet=feet).F)
        for feet in (same, shifted)
    )
    for mode in Mode:
        change = np.abs(other[mode] - one[mode]).max()
        if mode == Mode.FRONT:
            # 5 cm more of lever arm, of about 20: a good part of the pitch terms.
            assert change > 0.02 * np.abs(one[mode][:, 3]).max()
        else:
            assert change == 0.0, mode


def test_the_reference_walks_ahead_at_the_commanded_velocity(dtype):
    reference = reference_trajectory(
        position=jnp.asarray(1.0, dtype),
        height=jnp.asarray(0.3, dtype),
        velocity=jnp.asarray(-0.5, dtype),
        periodic=jnp.zeros((3, 4), dtype),
        ahead=jnp.asarray([0.02, 0.04, 0.06], dtype),
    )
    assert reference.dtype == dtype
    expected = [[1.0 - 0.01 * i, 0.3, 0.0, -0.5, 0.0, 0.0] for i in (1, 2, 3)]
    np.testing.assert_allclose(reference, expected, rtol=2 * np.finfo(dtype).eps)


def test_the_reference_rides_on_the_periodic_motion(dtype):
    """Height is added to; pitch and the rates are the motion's own."""
    reference = reference_trajectory(
        position=jnp.asarray(1.0, dtype),
        height=jnp.asarray(0.3, dtype),
        velocity=jnp.asarray(0.5, dtype),
        periodic=jnp.asarray([[0.01, 0.1, -0.2, 2.0], [-0.02, -0.3, 0.4, -5.0]], dtype),
        ahead=jnp.asarray([0.1, 0.2], dtype),
    )
    assert reference.dtype == dtype
    expected = [[1.05, 0.31, 0.1, 0.5, -0.2, 2.0], [1.1, 0.28, -0.3, 0.5, 0.4, -5.0]]
    # Each entry is a rounded number or the sum of two.
    np.testing.assert_allclose(reference, expected, rtol=4 * np.finfo(dtype).eps)


@pytest.mark.parametrize(
    ("control_dt", "order"),
    [(0.005, [1, 2, 3, 3]), (0.010, [2, 3, 3, 3]), (0.001, [0, 1, 2, 3]), (1.0, [3, 3, 3, 3])],
)
def test_shifting_a_plan_drops_what_has_passed_and_repeats_its_end(control_dt, order):
    spec = ControllerSpec(horizon=4, model_dt=0.005, control_dt=control_dt)
    shifted = np.asarray(shift_plan(np.arange(16.0), spec)).reshape(4, 4)
    np.testing.assert_array_equal(shifted, np.arange(16.0).reshape(4, 4)[order])


def test_shifting_a_plan_of_one_step_keeps_it():
    plan = np.arange(4.0)
    np.testing.assert_array_equal(shift_plan(plan, ControllerSpec(horizon=1)), plan)


def test_a_tableau_carried_across_modes_changes_no_plan(bounded, start):
    """Trot, front, front, trot, rear: the memory of another mode is another Hessian's."""
    x, reference = start
    carried = start_memory(bounded, SPEC)
    for i, mode in enumerate((Mode.TROT, Mode.FRONT, Mode.FRONT, Mode.TROT, Mode.REAR)):
        now = np.asarray(int(mode), np.int32)
        seen = x.copy()
        seen[2] += 0.02 * i
        z = lift(seen)
        warm = solve(bounded, now, z, reference, carried, spec=SPEC)
        cold = solve(bounded, now, z, reference, memory(), spec=SPEC)
        assert warm.status == Status.SOLVED
        np.testing.assert_allclose(warm.plan, cold.plan, rtol=0, atol=1e-8)
        carried = lmpc.LmpcMemory(plan=warm.plan, problem=now, warm=warm.warm)


def test_rows_hold_friction_and_torque_and_give_way_where_they_do_not_bind(bounded, start):
    x, reference = start
    mode = np.asarray(int(Mode.TROT), np.int32)
    posture = LegTrig(*(np.full((4,), f(a)) for a in (0.9, -0.9) for f in (np.sin, np.cos)))
    stance = np.array([True, False, False, True])

    def planned(friction, fraction):
        rows = force_limits(posture, np.eye(2), stance, friction, fraction)
        solution = solve(bounded, mode, lift(x), reference, memory(), spec=SPEC, rows=rows)
        assert solution.status == Status.SOLVED
        return np.asarray(solution.plan).reshape(4, 4), rows

    box = solve(bounded, mode, lift(x), reference, memory(), spec=SPEC).plan
    box = np.asarray(box).reshape(4, 4)
    wide, _ = planned(1e3, 1e3)
    np.testing.assert_allclose(wide, box, rtol=0, atol=1e-6)
    ratio = np.abs(box[:, ::2]) / np.maximum(box[:, 1::2], 1e-9)
    mu = 0.5 * float(ratio.max())
    tight, _ = planned(mu, None)
    assert (np.abs(tight[:, ::2]) <= mu * tight[:, 1::2] + 1e-6).all()
    torque = np.abs(np.einsum("rf,kf->kr", planned(None, 1.0)[1].A, box))
    fraction = 0.8 * float((torque / np.tile(go1.PARAMS.torque_limit[1:], 2)).max())
    limited, rows = planned(None, fraction)
    assert (np.abs(limited @ np.asarray(rows.A).T) <= np.asarray(rows.high) + 1e-6).all()


def test_friction_rows_are_the_grounds_whatever_the_trunks_pitch():
    """A vertical force in the world is as far from slipping with the nose up as level."""
    pitch, mu = 0.4, 0.6
    c, s = np.cos(pitch), np.sin(pitch)
    R = np.array([[c, -s], [s, c]])  # nose up: body to world
    posture = jax.jit(leg_trig)(stand_pose(go1.PARAMS, 0.27)[1])
    rows = jax.tree.map(np.asarray, force_limits(posture, R, np.ones(4, bool), mu, None))
    for world in ([0.0, 100.0], [59.9, 100.0], [-59.9, 100.0]):
        u = np.tile(R.T @ world, 2)
        assert (rows.A @ u <= rows.high + 1e-9).all()
    for world in ([60.1, 100.0], [-60.1, 100.0]):
        u = np.tile(R.T @ world, 2)
        # Each end's row is 0.1 N over.
        np.testing.assert_allclose((rows.A @ u).reshape(2, 2).max(axis=1), 0.1, atol=1e-9)


def test_with_rows_the_warm_start_is_carried_and_admm_plans_the_same(bounded, start):
    x, reference = start
    mode = np.asarray(int(Mode.TROT), np.int32)
    posture = LegTrig(*(np.full((4,), f(a)) for a in (0.9, -0.9) for f in (np.sin, np.cos)))
    stance = np.array([True, False, False, True])
    rows = force_limits(posture, np.eye(2), stance, 0.05, 0.95)
    z = lift(x)
    carried = start_memory(bounded, SPEC)
    first = solve(bounded, mode, z, reference, carried, spec=SPEC, rows=rows)
    assert first.warm is not None
    again = lmpc.LmpcMemory(plan=first.plan, problem=mode, warm=first.warm)
    second = solve(bounded, mode, z, reference, again, spec=SPEC, rows=rows)
    assert second.iterations <= first.iterations  # the box's part of them is 0 now
    box = solve(bounded, mode, z, reference, again, spec=SPEC)
    assert box.iterations == 0
    np.testing.assert_allclose(second.plan, first.plan, rtol=0, atol=1e-8)
    spec = dataclasses.replace(SPEC, solver="admm")
    admm = solve(bounded, mode, z, reference, memory(), spec=spec, rows=rows)
    assert admm.status == first.status == Status.SOLVED
    forces = np.asarray(first.plan).reshape(4, 4)
    assert (np.abs(forces[:, ::2]) <= 0.05 * forces[:, 1::2] + 1e-6).all()
    # Tolerance 1e-9 times the condition of 1e5 times forces of 1e2 N.
    np.testing.assert_allclose(admm.plan, first.plan, rtol=0, atol=1e-2)
