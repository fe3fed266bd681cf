"""The controller as a set of pure functions: rates, shapes, purity, faults."""

import dataclasses
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import Observation, RunConfig, build_controller, load_config, qp
from kjax.config import ConfigError, DatasetConfig, KoopmanConfig, LmpcConfig
from kjax.config.gaits import LIBRARY
from kjax.controllers.params import condense, with_params
from kjax.controllers.planning import reference_trajectory
from kjax.controllers.resolve import controller_spec, resolve
from kjax.controllers.walkable import build_gaits, contact_problems
from kjax.legs.base import build_base
from kjax.legs.posture import stand_pose
from kjax.mpc.lmpc import solve_lmpc
from kjax.prediction import build, families, storage
from kjax.robots import go1
from kjax.types import Leg, Mode

HIP_X, COM_X = 0.1881, -0.00208202  # m
# Footholds of the bound [m], of leg lengths; stiffness of swing legs [N m/rad], of m g L.
FRONT, REAR = 0.426 * LIBRARY["bound"].foothold_front, 0.426 * LIBRARY["bound"].foothold_rear
HEIGHT = 0.426 * 0.6338  # m
WEIGHT = float(go1.PARAMS.mass) * 9.81  # N
STIFFNESS = 2.817 * float(go1.PARAMS.mass) * 9.81 * 0.426
CONFIG = load_config(RunConfig, None, {"sim.base": "planar"})
STANCE = {
    Mode.TROT: [True, False, False, True],  # the first diagonal
    Mode.FRONT: [True, True, False, False],
    Mode.REAR: [False, False, True, True],
    Mode.FLIGHT: [False] * 4,
    Mode.STAND: [True] * 4,
}


def standing(dtype=float, com_height=HEIGHT, **changes):
    height, joints = stand_pose(go1.PARAMS, com_height)
    floats = {
        "base_pos": [0.0, 0.0, height],
        "base_quat": [1.0, 0.0, 0.0, 0.0],
        "base_vel": [0.0, 0.0, 0.0],
        "base_ang_vel": [0.0, 0.0, 0.0],
        "joint_pos": joints,
        "joint_vel": np.zeros((4, 3)),
    }
    floats |= changes
    arrays = {key: jnp.asarray(value, dtype) for key, value in floats.items()}
    return Observation(**arrays, contact=jnp.ones(4, bool))


@pytest.fixture(scope="module")
def controller():
    return build_controller(controller_spec(CONFIG))


@pytest.fixture(scope="module")
def tables():
    return condense(*resolve(CONFIG, go1.PARAMS))


def bounding(**changes):
    """A bound at the full length of its flights from the start.

    Its parameters have the shapes of the default's, so that both share their compiled functions.
    """
    chosen = {"sim.base": "planar", "gait.names": ["bound"], "gaits.bound.ramp_start": 1.0}
    return load_config(RunConfig, None, chosen | changes)


@pytest.fixture(scope="module")
def bound_tables():
    return condense(*resolve(bounding(), go1.PARAMS))


@pytest.fixture(scope="module")
def plan(controller):
    return jax.jit(controller.plan)


@pytest.fixture(scope="module")
def act(controller):
    return jax.jit(controller.act)


def after_first_plan(controller, tables, plan, observation=None):
    observation = standing() if observation is None else observation
    return plan(tables, jax.jit(controller.init)(tables, observation), observation)


def test_the_first_plan_enters_the_first_phase_with_one_diagonal_on_the_ground(
    controller, tables, plan
):
    state, info = after_first_plan(controller, tables, plan)
    assert int(state.clock.phase) == 0
    assert float(state.clock.elapsed) == 0.0
    assert state.stance.tolist() == [True, False, False, True]
    assert int(info.mode) == Mode.TROT
    assert int(info.status) == qp.Status.SOLVED


def test_swing_legs_get_no_force_and_stance_legs_carry_about_the_weight(controller, tables, plan):
    state, _ = after_first_plan(controller, tables, plan)
    force = np.asarray(state.force)
    assert (force[[Leg.FL, Leg.RR]] == 0.0).all()
    weight = go1.PARAMS.mass * 9.81
    # R pulls to the mean force; 1 %: the body is off its references by the fit's rounding only.
    assert force[:, 2].sum() == pytest.approx(weight, rel=0.01)


def test_a_lower_body_asks_for_more_force_and_a_slow_one_for_a_push(controller, tables, plan):
    base = np.asarray(after_first_plan(controller, tables, plan)[0].force).sum(axis=0)
    low = standing(com_height=HEIGHT - 0.005)
    assert np.asarray(after_first_plan(controller, tables, plan, low)[0].force).sum(axis=0)[2] > (
        base[2] + 5.0
    )
    slow = standing(base_vel=[-0.1, 0.0, 0.0])
    assert np.asarray(after_first_plan(controller, tables, plan, slow)[0].force).sum(axis=0)[0] > (
        base[0] + 5.0
    )


def test_stance_torques_press_with_the_planned_force(controller, tables, plan, act):
    """Virtual work against the planned force, by finite differences of the foot position."""
    observation = standing()
    state, _ = after_first_plan(controller, tables, plan, observation)
    state = state._replace(force=jnp.tile(jnp.array([10.0, 0.0, 60.0]), (4, 1)))
    _, joints = act(tables, state, observation)
    torque = joints.torque

    def foot(q1, q2):
        l1, l2 = go1.THIGH_LENGTH, go1.CALF_LENGTH
        return np.array(
            [-l1 * np.sin(q1) - l2 * np.sin(q1 + q2), -l1 * np.cos(q1) - l2 * np.cos(q1 + q2)]
        )

    _, q1, q2 = np.asarray(observation.joint_pos)[0]
    h = 1e-6
    for joint, (a, b) in enumerate([(h, 0.0), (0.0, h)]):
        column = (foot(q1 + a, q2 + b) - foot(q1 - a, q2 - b)) / (2 * h)
        # 1e-6: the rounding of a central difference with h = 1e-6
        assert float(torque[Leg.FR, 1 + joint]) == pytest.approx(
            -column @ np.array([10.0, 60.0]), abs=1e-6
        )


def test_torques_stay_within_the_robots_limits(controller, tables, plan, act):
    state, _ = after_first_plan(controller, tables, plan)
    wild = standing(joint_pos=np.tile([0.8, 4.0, -0.9], (4, 1)), joint_vel=np.full((4, 3), 30.0))
    _, joints = act(tables, state, wild)
    torque = joints.torque
    assert (np.abs(torque) <= go1.PARAMS.torque_limit).all()
    assert (np.abs(torque) == go1.PARAMS.torque_limit).any()


@pytest.mark.parametrize("config", [CONFIG, bounding()], ids=["trot", "bound"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_state_keeps_its_tree_shapes_and_types(controller, dtype, config):
    tables = condense(*resolve(config, go1.PARAMS), dtype=dtype)
    observation = standing(dtype)
    state = jax.eval_shape(controller.init, tables, observation)
    planned, _ = jax.eval_shape(controller.plan, tables, state, observation)
    acted, joints = jax.eval_shape(controller.act, tables, planned, observation)
    chex.assert_trees_all_equal_shapes_and_dtypes(state, planned, acted)
    assert all((part.shape, part.dtype) == ((4, 3), dtype) for part in joints)
    assert all(
        leaf.dtype == dtype
        for leaf in jax.tree.leaves(state)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    )


def test_float32_and_float64_agree_on_the_plan(controller, tables, plan):
    single = condense(*resolve(CONFIG, go1.PARAMS), dtype=jnp.float32)
    pitched = dict(base_vel=[0.03, 0.0, -0.02], base_ang_vel=[0.0, 0.2, 0.0])
    full, _ = after_first_plan(controller, tables, plan, standing(**pitched))
    half, _ = after_first_plan(controller, single, plan, standing(jnp.float32, **pitched))
    # 0.02 N of about 60: gains of up to 3e3 N/m on positions that float32 resolves to 3e-8 m,
    # times the 1e-6 residual that the QP is solved to
    np.testing.assert_allclose(half.force, full.force, atol=0.02)


def test_one_trace_serves_all_gaits_commands_and_phases(controller, tables):
    counted = jax.jit(chex.assert_max_traces(controller.plan, n=1))
    observation = standing()
    state = controller.init(tables, observation)
    for tick in range(120):  # more than a whole stride of 0.5 s
        state, info = counted(tables, state, observation)
        assert int(info.status) == qp.Status.SOLVED, tick
    for gait, mode in enumerate((Mode.TROT, Mode.FRONT, Mode.STAND)):
        other = with_params(
            tables,
            gaits=jnp.asarray([gait], jnp.int32),
            command=tables.params.command._replace(
                values=tables.params.command.values.at[:, 0].add(0.1)
            ),
        )
        state, info = counted(other, controller.init(other, observation), observation)
        assert int(info.mode) == mode
        np.testing.assert_array_equal(state.stance, STANCE[mode])


def test_trot_swaps_diagonals_every_stance_time(controller, tables, plan):
    observation = standing()
    state = controller.init(tables, observation)
    pattern = []
    for _ in range(200):
        state, _ = plan(tables, state, observation)
        pattern.append(bool(state.stance[Leg.FR]))
    # 0.25 s at 200 Hz
    assert pattern == ([True] * 50 + [False] * 50) * 2


def plans(controller, tables, plan, ticks, observation=None):
    """States and infos of ``ticks`` plans for a robot that stands still."""
    observation = standing() if observation is None else observation
    state, results = controller.init(tables, observation), []
    for _ in range(ticks):
        state, info = plan(tables, state, observation)
        results.append((state, info))
    return jax.device_get(jax.tree.map(lambda *leaves: np.stack(leaves), *results))


@pytest.fixture(scope="module")
def two_bounds(controller, bound_tables, plan):
    """0.7 s, two cycles."""
    return plans(controller, bound_tables, plan, 140)


# 0.10, 0.10, 0.05 and 0.10 s at 200 Hz
CYCLE = [Mode.FRONT] * 20 + [Mode.FLIGHT] * 20 + [Mode.REAR] * 10 + [Mode.FLIGHT] * 20


def test_a_bound_is_front_stance_flight_rear_stance_flight(two_bounds):
    states, infos = two_bounds
    assert infos.mode.tolist() == CYCLE * 2
    np.testing.assert_array_equal(states.stance, [STANCE[mode] for mode in CYCLE * 2])
    np.testing.assert_array_equal(states.clock.cycle, np.repeat([0, 1], 70))
    assert (infos.status == qp.Status.SOLVED).all()


def test_no_leg_in_the_air_has_a_force_and_every_leg_on_the_ground_has_one(two_bounds):
    states, _ = two_bounds
    np.testing.assert_array_equal(states.force[~states.stance], 0.0)
    assert (states.force[states.stance][:, 2] >= 20.0).all()


def test_legs_swing_from_the_end_of_their_stance_to_its_next_beginning(two_bounds):
    """What the swing takes is the rest of the cycle: 0.25 s in front, 0.30 s behind."""
    states, _ = two_bounds
    lifted = np.diff(states.stance.astype(int), axis=0) < 0
    for leg in Leg:
        at = np.flatnonzero(lifted[:, leg]) + 1
        np.testing.assert_array_equal(at, [20, 90] if leg in (Leg.FR, Leg.FL) else [50, 120])
        wait = 0.25 if leg in (Leg.FR, Leg.FL) else 0.30
        # The first tick of the phase, within rounding of its clock.
        np.testing.assert_allclose(states.swing.duration[at, leg], wait, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(states.swing.elapsed[at, leg], 0.0)


def test_a_bound_ramps_up_by_its_flights(controller, plan):
    tables = condense(*resolve(bounding(**{"gaits.bound.ramp_start": 0.5}), go1.PARAMS))
    states, infos = plans(controller, tables, plan, 50 + 52 + 54)
    # Half of 20 ticks of flight, and a tick more in each of 10 cycles.
    expected = []
    for flight in (10, 11, 12):
        expected += [Mode.FRONT] * 20 + [Mode.FLIGHT] * flight
        expected += [Mode.REAR] * 10 + [Mode.FLIGHT] * flight
    assert infos.mode.tolist() == expected
    # The reference of each cycle is the one of its own flights: higher every time.
    assert (np.diff(np.ptp(np.asarray(tables.params.reference)[1, ..., 0], axis=(1, 2))) > 0).all()
    for cycle, begin in enumerate((0, 50, 102)):
        assert states.clock.cycle[begin] == cycle
        # At the cycle's first tick the reference is 1 ms into the first row: v_z falls by less
        # than 10 m/s^2 times that, and differs by more than that between the cycles.
        first = np.asarray(tables.params.reference)[1, cycle, 0, 0, 2]
        assert infos.reference[begin, 4] == pytest.approx(first, abs=0.0099)
        assert abs(first - np.asarray(tables.params.reference)[1, cycle + 1, 0, 0, 2]) > 0.0200


# A robot that is high and flies up wants no force at all, one that is low and falls wants more
# than there is; the horizontal force wanted is large as well.
EAGER = {
    "least": {"com_height": 0.36, "base_vel": [-2.0, 0.0, 2.0]},
    "most": {"com_height": 0.15, "base_vel": [2.0, 0.0, -2.0]},
}
BOX = {"lmpc.friction": np.inf, "lmpc.torque_fraction": np.inf}  # the paper's: no rows


@pytest.fixture(scope="module")
def box():
    """Controller, compiled plan and parameters of a bound without friction and torque rows."""
    own = build_controller(controller_spec(bounding(**BOX)))
    return own, jax.jit(own.plan), condense(*resolve(bounding(**BOX), go1.PARAMS))


@pytest.mark.parametrize(
    ("mode", "least", "most", "sideways"),
    [
        (Mode.TROT, 0.0, 1.28, 0.48),
        (Mode.FRONT, 0.16, 2.4, 0.412),
        (Mode.REAR, 0.16, 2.4, 0.412),
        (Mode.STAND, 0.0, 1.28, 0.48),
    ],
)
def test_each_mode_presses_within_its_own_limits_and_reaches_them(box, mode, least, most, sideways):
    controller, plan, bound_tables = box
    least, most, sideways = WEIGHT * np.array([least, most, sideways])
    index = {Mode.TROT: 0, Mode.FRONT: 1, Mode.REAR: 1, Mode.STAND: 2}[mode]
    tables = with_params(bound_tables, gaits=jnp.asarray([index], jnp.int32))
    for name, limit in (("least", least), ("most", most)):
        observation = standing(**EAGER[name])
        state = controller.init(tables, observation)
        if mode == Mode.REAR:  # the phase after the first flight
            state = state._replace(clock=state.clock._replace(phase=jnp.asarray(2, jnp.int32)))
        state, info = plan(tables, state, observation)
        assert int(info.mode) == mode
        force, stance = np.asarray(state.force), np.asarray(state.stance)
        np.testing.assert_array_equal(stance, STANCE[mode])
        np.testing.assert_array_equal(force[~stance], 0.0)
        np.testing.assert_array_equal(force[stance, 2], limit)
        assert (np.abs(force[stance, 0]) <= sideways).all()
        assert (np.abs(force[stance, 0]) == sideways).any()


def test_a_bound_s_reference_is_the_body_s_own_motion_at_the_clock_s_place(
    two_bounds, bound_tables
):
    """Level in the mean: the body turns and rises, and the reference with it, tick by tick."""
    _, infos = two_bounds
    table = np.asarray(bound_tables.params.reference)[1, 0]
    now = 0.005 * np.arange(70)
    rows = []
    begins = np.cumsum([0.0, 0.10, 0.10, 0.05, 0.10])
    for phase, (begin, end) in enumerate(itertools.pairwise(begins)):
        inside = now[(now > begin - 1e-9) & (now < end - 1e-9)] - begin
        at = np.linspace(0.0, end - begin, table.shape[1])
        rows += [[np.interp(t + 0.001, at, column) for column in table[phase].T] for t in inside]
    expected = np.tile(rows, (2, 1))
    # One model step ahead; the clock's time in the phase is rounded, rates of up to 100/s^2.
    np.testing.assert_allclose(infos.reference[:, 1], HEIGHT + expected[:, 0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(infos.reference[:, 2], expected[:, 1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(infos.reference[:, 4:], expected[:, 2:], rtol=0, atol=1e-10)
    assert np.ptp(expected[:, 1]) > 0.05


def test_only_a_bound_has_a_periodic_reference_and_only_if_it_is_asked_for(bound_tables):
    reference = np.asarray(bound_tables.params.reference)
    names = ("trot", "bound", "stand")
    for name, rows in zip(names, reference, strict=True):
        assert rows.any() == (name == "bound")
    constant = condense(*resolve(bounding(**{"gaits.bound.reference": "constant"}), go1.PARAMS))
    assert constant.params.reference.shape == reference.shape
    np.testing.assert_array_equal(constant.params.reference, 0.0)


def test_a_constant_reference_is_level_and_at_rest_in_every_phase(controller, plan):
    tables = condense(*resolve(bounding(**{"gaits.bound.reference": "constant"}), go1.PARAMS))
    _, infos = plans(controller, tables, plan, 70)
    assert infos.mode.tolist() == CYCLE
    level = np.tile([HEIGHT, 0.0, 0.0, 0.0, 0.0], (70, 1))
    np.testing.assert_array_equal(infos.reference[:, 1:], level)


def test_gaits_are_switched_at_their_times_in_one_trace(controller):
    """From bound to trot in the first flight, and to stand in the flight that comes next.

    Bound from 0.1 s; trot is asked for at 0.18 s, in front stance: the flight after it begins at
    0.2 s. Bound again from 0.3 s; stand is asked for at 0.53 s, in rear stance: that flight
    is that of the next cycle, from 0.3 + 0.35 + 0.1 s on.
    """
    chosen = {"gait.names": ["trot", "bound", "trot", "bound", "stand"]}
    chosen |= {"gait.times": [0.0, 0.1, 0.18, 0.3, 0.53], "gaits.trot.period": 0.44}
    config = bounding(**chosen)
    counted = jax.jit(chex.assert_max_traces(controller.plan, n=1))
    states, infos = plans(controller, condense(*resolve(config, go1.PARAMS)), counted, 170)
    assert (infos.status == qp.Status.SOLVED).all()
    gaits = [0] * 20 + [1] * 20 + [0] * 20 + [1] * 90 + [2] * 20
    assert states.clock.gait.tolist() == gaits
    modes = [Mode.TROT] * 20 + CYCLE[:20] + [Mode.TROT] * 20 + CYCLE + CYCLE[:20]
    assert infos.mode.tolist() == modes + [Mode.STAND] * 20
    # Legs in the air when a gait begins have its time to come down, whatever they had before: the
    # rear ones of the bound front stance and flight, the others of the trot its stance.
    rear, swinging = [Leg.RR, Leg.RL], [Leg.FL, Leg.RR]
    np.testing.assert_allclose(states.swing.duration[20, rear], 0.20, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(states.stance[40], STANCE[Mode.TROT])
    np.testing.assert_allclose(states.swing.duration[40, swinging], 0.22, rtol=0, atol=1e-12)


def test_a_landing_time_puts_a_four_leg_stance_between_a_bound_and_the_next_gait():
    trot, bound, stand = build_gaits(bounding())
    assert trot.transition_gait == bound.transition_gait == stand.transition_gait == ""
    config = bounding(
        **{"gaits.bound.transition_gait": "landing", "gaits.landing.period": 0.06}
        | {"gaits.trot.period": 0.54, "gaits.trot.duty": [0.25 / 0.54] * 4}
    )
    *others, landing = gaits = build_gaits(config)
    assert [g.transition_gait for g in others] == ["", "landing", ""]
    assert [(p.stance, p.duration) for p in landing.phases] == [((True,) * 4, 0.06)]
    assert [g.switch_rule for g in gaits] == ["anywhere", "first_flight", "anywhere", "cycle_end"]
    # One number for each gait, and the landing is at the trot's height.
    tables = condense(*resolve(config, go1.PARAMS))
    assert (
        len(gaits)
        == len(tables.params.height)
        == len(tables.params.swing.apex)
        == len(tables.params.reference)
        == 4
    )
    np.testing.assert_array_equal(tables.params.height[3], tables.params.height[0])
    np.testing.assert_array_equal(tables.params.schedule.transition_gait, [0, 3, 2, 3])


@pytest.mark.parametrize(
    ("rule", "free"),
    [
        ("first_flight", [False, True, False, False]),
        ("anywhere", [True] * 4),
        ("cycle_end", [True, False, False, False]),
    ],
)
def test_the_rule_says_in_which_phases_a_bound_may_be_left(rule, free):
    trot, bound, stand = build_gaits(bounding(**{"gaits.bound.switch_rule": rule}))
    assert bound.may_leave() == free
    assert all(trot.may_leave() + stand.may_leave())


@pytest.mark.parametrize(("slew", "ticks"), [(4.0, 25), (10.0, 10), (np.inf, 1)])
def test_the_reference_velocity_follows_the_command_at_its_largest_rate(
    controller, plan, slew, ticks
):
    """From rest to -0.5 m/s at 200 Hz, and the reference position is its integral."""
    chosen = {"command.v_x": [-0.5] * 5, "lmpc.command_slew": slew}
    chosen |= {"lmpc.position_slack": 1.0}
    tables = condense(
        *resolve(load_config(RunConfig, None, {"sim.base": "planar", **chosen}), go1.PARAMS)
    )
    states, infos = plans(controller, tables, plan, 30)
    ramp = -0.5 * np.minimum(np.arange(1, 31) / ticks, 1.0)
    # Sums of up to 30 terms, rounded.
    np.testing.assert_allclose(states.velocity[:, 0], ramp, rtol=0, atol=1e-14)
    np.testing.assert_allclose(infos.reference[:, 3], ramp, rtol=0, atol=1e-14)
    np.testing.assert_allclose(states.lag[:, 0], 0.005 * np.cumsum(ramp), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(states.command[:, 0], -0.5)


@pytest.mark.parametrize("rise", [0.07, 0.0, -0.27, -2.0, 1e4])
def test_heights_are_measured_from_the_stance_feet_wherever_zero_is(controller, plan, rise):
    """In stance, then in the air, where the ground of the last stance holds on."""
    config = bounding(**{"gaits.bound.reference": "constant"})
    tables = condense(*resolve(config, go1.PARAMS))
    high = standing(base_pos=standing().base_pos + np.array([0.0, 0.0, rise]))
    _, infos = plans(controller, tables, plan, 30, high)
    assert set(infos.mode.tolist()) == {Mode.FRONT, Mode.FLIGHT}
    # Rounding of the legs' kinematics.
    np.testing.assert_allclose(infos.reference[:, 1], HEIGHT, rtol=0, atol=1e-12)
    np.testing.assert_allclose(infos.x[:, 1], HEIGHT, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(infos.x[:, 0], 0.0)


def test_footholds_of_a_bound_lie_closer_under_the_body(controller, bound_tables, plan):
    """Standing, the feet of a swing end as far from the trunk's middle as the config says."""
    offset = np.asarray(bound_tables.params.swing.offset)
    hips = np.asarray(go1.PARAMS.hip_pos)[:, 0]
    np.testing.assert_array_equal(offset[[0, 2]], 0.0)
    # Rounding of a sum.
    np.testing.assert_allclose(hips + offset[1], [FRONT, FRONT, -REAR, -REAR], rtol=1e-14)
    swing, bound = bound_tables.params.swing, LIBRARY["bound"]
    heights = 0.426 * np.array([0.1408, bound.swing_height, 0.1408])
    gains = (0.426 / 9.81) ** 0.5 * np.array([0.144, bound.foothold_gain, 0.144])
    np.testing.assert_allclose(swing.apex, heights, rtol=1e-14)
    np.testing.assert_allclose(swing.velocity_gain, gains, rtol=1e-14)


def test_the_model_of_a_bound_stands_where_its_feet_do(bound_tables):
    """Two legs ahead or behind as far; the other modes stand at the rigid body's feet."""
    B = (
        float(go1.PARAMS.pitch_inertia) / 1e-3 * np.asarray(bound_tables.params.fits.model.B)[:, 6]
    )  # moment per force
    modes = [mode for _, mode in contact_problems(build_gaits(bounding()), bounding())[0]]
    assert sorted(modes) == sorted([Mode.TROT, Mode.FRONT, Mode.FLIGHT, Mode.REAR, Mode.STAND])
    ahead = {
        Mode.FRONT: [2 * FRONT, 0.0],
        Mode.REAR: [0.0, -2 * REAR],
        # The hips, and with them the feet, from MuJoCo's centre of mass in the nominal stance.
        Mode.TROT: [HIP_X - COM_X, -HIP_X - COM_X],
        Mode.STAND: [2 * (HIP_X - COM_X), 2 * (-HIP_X - COM_X)],
    }
    for mode, arms in ahead.items():
        # The pitch rate is linear in the forces: the fit is exact but for rounding; MuJoCo's figure
        # is given to 1e-8.
        np.testing.assert_allclose(B[modes.index(mode), 1::2], arms, rtol=0, atol=3e-8)
    # Below the centre of mass lies the sole, and a radius higher the foot's centre.
    for mode, column in ((Mode.FRONT, 0), (Mode.REAR, 2)):
        assert -1e-9 <= HEIGHT - B[modes.index(mode), column] / 2 <= go1.FOOT_RADIUS + 1e-9


def test_a_bound_s_feet_swing_to_their_own_footholds(controller, bound_tables, plan, act):
    """The same tick of a swing, with the apex and the foothold of either gait, by hand."""
    observation = standing()._replace(contact=jnp.zeros(4, bool))
    state = controller.init(bound_tables, observation)
    for _ in range(20 + 1):  # the first flight
        state, info = plan(bound_tables, state, observation)
    assert int(info.mode) == Mode.FLIGHT
    # At the end of the swing each foot is to be on its foothold, at rest.
    swing = state.swing._replace(elapsed=jnp.full(4, 0.25), duration=jnp.full(4, 0.25))
    _, joints = act(bound_tables, state._replace(swing=swing), observation)
    torque = joints.torque
    feet = np.asarray(observation.base_pos)[0] + np.array([FRONT, FRONT, -REAR, -REAR])
    expected = []
    for leg in Leg:
        local = np.array([feet[leg], go1.FOOT_RADIUS]) - [0.0, float(observation.base_pos[2])]
        angles = knee_backward(local - np.asarray(go1.PARAMS.hip_pos)[leg, ::2])
        expected.append(STIFFNESS * (angles - np.asarray(observation.joint_pos)[leg, 1:]))
    limit = np.asarray(go1.PARAMS.torque_limit)[1:]
    # Stiffness times the rounding of angles of order one.
    np.testing.assert_allclose(torque[:, 1:], np.clip(expected, -limit, limit), atol=1e-9)
    assert np.abs(expected).max() > 5.0


def knee_backward(foot):
    """Thigh and calf angle for a foot (x, z) from the hip, by the law of cosines."""
    l1, l2 = go1.THIGH_LENGTH, go1.CALF_LENGTH
    reach = foot @ foot
    knee = -np.arccos((reach - l1**2 - l2**2) / (2 * l1 * l2))
    angle = np.arctan2(-foot[0], -foot[1])
    return np.array([angle - np.arctan2(l2 * np.sin(knee), l1 + l2 * np.cos(knee)), knee])


def test_the_reference_velocity_follows_the_command_at_a_bounded_rate(controller, tables, plan):
    stepped = with_params(tables, command=tables.params.command.hold(v_x=0.4))
    state = controller.init(stepped, standing())
    velocities = []
    for _ in range(30):
        state, _ = plan(stepped, state, standing())
        velocities.append(float(state.velocity[0]))
    # 4 m/s^2 at 200 Hz: 0.02 m/s a tick, 0.4 m/s after 20 of them
    np.testing.assert_allclose(velocities, np.minimum(0.02 * np.arange(1, 31), 0.4), atol=1e-12)
    assert float(state.command[0]) == 0.4


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_non_finite_observation_is_reported_and_spreads_nowhere(
    controller, tables, plan, act, bad
):
    good = standing()
    state, _ = after_first_plan(controller, tables, plan, good)
    broken = good._replace(joint_vel=good.joint_vel.at[2, 1].set(bad))
    state, info = plan(tables, state, broken)
    assert int(info.status) == qp.Status.NON_FINITE
    state, joints = act(tables, state, broken)
    torque = joints.torque
    assert (np.asarray(torque) == 0.0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    state, info = plan(tables, state, good)
    assert int(info.status) == qp.Status.SOLVED


def test_a_batch_of_robots_equals_single_ones(controller, tables, plan):
    shifts = jnp.linspace(-0.01, 0.01, 5)
    batch = jax.vmap(lambda dz: standing(base_pos=jnp.array([0.0, 0.0, 0.285]) + dz))(shifts)
    states = jax.jit(jax.vmap(controller.init, in_axes=(None, 0)))(tables, batch)
    together, _ = jax.jit(jax.vmap(controller.plan, in_axes=(None, 0, 0)))(tables, states, batch)
    states, batch = jax.tree.map(np.asarray, (states, batch))
    for i in range(5):
        alone, _ = plan(tables, *jax.tree.map(lambda a, i=i: a[i], (states, batch)))
        # 1e-9 N: the same operations, summed in another order
        np.testing.assert_allclose(together.force[i], alone.force, atol=1e-9)


def test_measured_feet_and_fixed_feet_agree_where_the_feet_are_nominal(controller, tables, plan):
    """With the robot standing, the measured contact points differ from the fixed ones by mm."""
    config = load_config(RunConfig, None, {"sim.base": "planar", "koopman.feet": "measured"})
    measured = build_controller(controller_spec(config))
    low = standing(base_pos=[0.0, 0.0, float(standing().base_pos[2]) - 0.014])
    ours, info = jax.jit(measured.step)(
        *_start(measured, condense(*resolve(config, go1.PARAMS)), low)
    )[::2]
    theirs, _ = after_first_plan(controller, tables, plan, low)
    assert int(info.status) == qp.Status.SOLVED
    # 1.5 N of 60: B is fitted on other data, and the contact points are a few mm apart
    np.testing.assert_allclose(ours.force, theirs.force, atol=1.5)


def _start(controller, tables, observation):
    return tables, controller.init(tables, observation), observation


def test_a_residual_model_knows_the_last_force_and_the_place_in_the_stance(tmp_path):
    """The second plan is that of the same LMPC with the model started by hand."""
    rng = np.random.default_rng(0)
    W = np.zeros((len(Mode), 6, 29))
    W[Mode.TROT, 3:] = 2e-3 * rng.normal(size=(3, 29))
    W[..., 5:9] /= 100.0
    W[..., 17:21] /= 30.0
    path = tmp_path / "residual.npz"
    spread = np.zeros((len(Mode), 6))
    storage.save(path, storage.Stored("residual", 0.005, W, spread, "clock_history"))
    config = dataclasses.replace(
        CONFIG,
        koopman=KoopmanConfig(
            model="residual", file=str(path), feet="measured", dataset=DatasetConfig(dt=0.005)
        ),
        lmpc=LmpcConfig(model_dt=0.02, horizon=5),
    )
    own = build_controller(controller_spec(config))
    tables = condense(*resolve(config, go1.PARAMS))
    observation = standing()
    state = own.init(tables, observation)
    plan = jax.jit(own.plan)
    before = []
    for _ in range(3):
        before.append(state)
        state, info = plan(tables, state, observation)
        assert info.status == qp.Status.SOLVED
    last = before[-1]
    stance_time = 0.5 * config.gaits.trot.period
    view = jax.jit(build_base(config.sim.base).view)(tables.params.robot, None, observation)
    feet = np.array(view.planar.feet - view.planar.x[:2]).reshape(2, 2, 2)
    feet[..., 1] -= go1.FOOT_RADIUS
    contacts = np.stack([feet[i][np.asarray(state.stance).reshape(2, 2)[i]][0] for i in range(2)])
    family = build.build_family(controller_spec(config).model)
    model_params, force, _ = jax.tree.map(lambda a: a[0], tables.params.fits.prediction)

    def forces(u_before, elapsed):
        start = families.Start(
            view.planar.x.at[0].set(0.0), jnp.asarray(contacts) @ view.planar.rotation, u_before,
            jnp.pi * elapsed / stance_time, jnp.pi / stance_time,
        )  # fmt: skip
        model = families.operating_point(family, model_params, start, force, 4)
        ahead = config.lmpc.model_dt * jnp.arange(1, 6)
        reference = reference_trajectory(
            position=state.lag[0], velocity=state.velocity[0], height=tables.params.height[0],
            periodic=jnp.zeros((5, 4)), ahead=ahead,
        )  # fmt: skip
        z = family.lift(model_params, start)
        memory = last.memory
        solved = solve_lmpc(
            tables.lmpc,
            jnp.asarray(0),  # the trot's only problem
            z,
            reference,
            memory,
            controller_spec(config),
            model=model,
        )
        return solved.plan[:4]

    forces = jax.jit(forces)
    planned = last.memory.plan[:4]
    np.testing.assert_allclose(state.clock.elapsed, 0.01, atol=1e-6)
    np.testing.assert_allclose(forces(planned, 0.01), state.memory.plan[:4], atol=1e-6)
    assert np.abs(forces(jnp.zeros(4), 0.01) - state.memory.plan[:4]).max() > 1e-2
    assert np.abs(forces(planned, 0.1) - state.memory.plan[:4]).max() > 1e-2


def test_a_fit_that_misjudges_forces_is_warned_of_and_a_good_one_is_not(recwarn):
    """Seed 1's fourth powers of omega, contact points varied, answer forces 4.9 times wrong."""
    lmpc = LmpcConfig(model_dt=0.02, horizon=10)
    config = dataclasses.replace(CONFIG, lmpc=lmpc, koopman=KoopmanConfig(feet="measured", order=2))
    condense(*resolve(config, go1.PARAMS))
    assert not [w for w in recwarn if "koopman" in str(w.message)]
    faulty = dataclasses.replace(config, koopman=KoopmanConfig(feet="measured"))
    with pytest.warns(UserWarning, match=r"model of trot \(trot\) predicts for .* 4\.9 times"):
        condense(*resolve(faulty, go1.PARAMS))


def test_a_flag_that_contradicts_the_kinematics_is_told_of_its_leg(controller, tables, plan, act):
    """A leg that presses without contact; its flag comes on again, and is trusted after a while."""
    silent = standing()._replace(contact=jnp.asarray([False, True, True, True]))
    state, told = controller.init(tables, standing()), []
    for tick in range(100):
        seen = silent if tick < 40 else standing()
        state, info = plan(tables, state, seen)
        told.append(np.asarray(info.contact_fault))
        for _ in range(5):
            state, _ = act(tables, state, seen)
    # FR stands in the first 0.25 s; a fault counts from 50 ms on, averaged over 0.5 s.
    assert not np.any(told[:10])
    assert told[30].tolist() == [True, False, False, False]
    assert not np.any(np.asarray(told)[:, 1:])


def test_a_key_of_an_earlier_version_is_told_what_has_become_of_it():
    with pytest.raises(ConfigError, match=r"lmpc\.height_above: .*stance feet"):
        load_config(RunConfig, None, {"lmpc.height_above": "feet"})
    with pytest.raises(ConfigError, match=r"lateral\.plan_friction: .*lateral\.friction"):
        load_config(RunConfig, None, {"lateral.plan_friction": 0.8})
    with pytest.raises(ConfigError, match=r"lmpc\.input_reference: .*'mean'"):
        load_config(RunConfig, None, {"lmpc.input_reference": "hover"})
