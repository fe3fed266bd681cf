"""The controller as a set of pure functions: rates, shapes, purity, faults."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import Observation, RunConfig, build_controller, build_params, load_config, qp
from kjax.robots import go1
from kjax.types import Leg, Mode


def standing(dtype=float, **changes):
    height, joints = go1.stand_pose(0.27)
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
    return build_controller(RunConfig())


@pytest.fixture(scope="module")
def params():
    return build_params(RunConfig(), go1.PARAMS)


@pytest.fixture(scope="module")
def plan(controller):
    return jax.jit(controller.plan)


@pytest.fixture(scope="module")
def act(controller):
    return jax.jit(controller.act)


def after_first_plan(controller, params, plan, observation=None):
    observation = standing() if observation is None else observation
    return plan(params, controller.init(params, observation), observation)


def test_the_first_plan_enters_the_first_phase_with_one_diagonal_on_the_ground(
    controller, params, plan
):
    state, info = after_first_plan(controller, params, plan)
    assert int(state.clock.phase) == 0
    assert float(state.clock.elapsed) == 0.0
    assert state.stance.tolist() == [True, False, False, True]
    assert int(info.mode) == Mode.TROT
    assert int(info.status) == qp.Status.SOLVED


def test_swing_legs_get_no_force_and_stance_legs_carry_about_the_weight(controller, params, plan):
    # 14 mm below the reference, the paper's R on absolute forces balances the weight.
    height = float(standing().base_pos[2]) - 0.014
    low = standing(base_pos=[0.0, 0.0, height])
    state, _ = after_first_plan(controller, params, plan, low)
    force = np.asarray(state.force)
    assert (force[[Leg.FL, Leg.RR]] == 0.0).all()
    weight = go1.PARAMS.mass * 9.81
    # 10 %: the droop is read off the walking robot, not derived
    assert force[:, 1].sum() == pytest.approx(weight, rel=0.10)


def test_a_lower_body_asks_for_more_force_and_a_slow_one_for_a_push(controller, params, plan):
    base = np.asarray(after_first_plan(controller, params, plan)[0].force).sum(axis=0)
    low = standing(base_pos=[0.0, 0.0, float(standing().base_pos[2]) - 0.005])
    assert np.asarray(after_first_plan(controller, params, plan, low)[0].force).sum(axis=0)[1] > (
        base[1] + 5.0
    )
    slow = standing(base_vel=[-0.1, 0.0, 0.0])
    assert np.asarray(after_first_plan(controller, params, plan, slow)[0].force).sum(axis=0)[0] > (
        base[0] + 5.0
    )


def test_stance_torques_press_with_the_planned_force(controller, params, plan, act):
    """Virtual work against the planned force, by finite differences of the foot position."""
    observation = standing()
    state, _ = after_first_plan(controller, params, plan, observation)
    state = state._replace(force=jnp.tile(jnp.array([10.0, 60.0]), (4, 1)))
    _, torque = act(params, state, observation)

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


def test_torques_stay_within_the_robots_limits(controller, params, plan, act):
    state, _ = after_first_plan(controller, params, plan)
    wild = standing(joint_pos=np.tile([0.8, 4.0, -0.9], (4, 1)), joint_vel=np.full((4, 3), 30.0))
    _, torque = act(params, state, wild)
    assert (np.abs(torque) <= go1.PARAMS.torque_limit).all()
    assert (np.abs(torque) == go1.PARAMS.torque_limit).any()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_state_keeps_its_tree_shapes_and_types(controller, dtype):
    params = build_params(RunConfig(), go1.PARAMS, dtype=dtype)
    observation = standing(dtype)
    state = jax.eval_shape(controller.init, params, observation)
    planned, _ = jax.eval_shape(controller.plan, params, state, observation)
    acted, torque = jax.eval_shape(controller.act, params, planned, observation)
    chex.assert_trees_all_equal_shapes_and_dtypes(state, planned, acted)
    assert torque.dtype == dtype
    assert all(
        leaf.dtype == dtype
        for leaf in jax.tree.leaves(state)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    )


def test_float32_and_float64_agree_on_the_plan(controller, params, plan):
    single = build_params(RunConfig(), go1.PARAMS, dtype=jnp.float32)
    pitched = dict(base_vel=[0.03, 0.0, -0.02], base_ang_vel=[0.0, 0.2, 0.0])
    full, _ = after_first_plan(controller, params, plan, standing(**pitched))
    half, _ = after_first_plan(controller, single, plan, standing(jnp.float32, **pitched))
    # 0.02 N of about 60: gains of up to 3e3 N/m on positions that float32 resolves to 3e-8 m,
    # times the 1e-6 residual that the QP is solved to
    np.testing.assert_allclose(half.force, full.force, atol=0.02)


def test_one_trace_serves_all_gaits_commands_and_phases(controller, params):
    counted = jax.jit(chex.assert_max_traces(controller.plan, n=1))
    observation = standing()
    state = controller.init(params, observation)
    for tick in range(120):  # more than a whole stride of 0.5 s
        state, info = counted(params, state, observation)
        assert int(info.status) == qp.Status.SOLVED, tick
    other = params._replace(
        gait=jnp.asarray(1, jnp.int32),
        command=params.command._replace(velocities=params.command.velocities + 0.1),
    )
    state, info = counted(other, controller.init(other, observation), observation)
    assert int(info.mode) == Mode.STAND
    assert state.stance.all()


def test_trot_swaps_diagonals_every_stance_time(controller, params, plan):
    observation = standing()
    state = controller.init(params, observation)
    pattern = []
    for _ in range(200):
        state, _ = plan(params, state, observation)
        pattern.append(bool(state.stance[Leg.FR]))
    # 0.25 s at 200 Hz
    assert pattern == ([True] * 50 + [False] * 50) * 2


def test_the_reference_velocity_follows_the_command_at_a_bounded_rate(controller, params, plan):
    stepped = params._replace(command=params.command._replace(velocities=jnp.full(5, 0.4)))
    state = controller.init(stepped, standing())
    velocities = []
    for _ in range(30):
        state, _ = plan(stepped, state, standing())
        velocities.append(float(state.velocity))
    # 4 m/s^2 at 200 Hz: 0.02 m/s a tick, 0.4 m/s after 20 of them
    np.testing.assert_allclose(velocities, np.minimum(0.02 * np.arange(1, 31), 0.4), atol=1e-12)
    assert float(state.velocity_command) == 0.4


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_non_finite_observation_is_reported_and_spreads_nowhere(
    controller, params, plan, act, bad
):
    good = standing()
    state, _ = after_first_plan(controller, params, plan, good)
    broken = good._replace(joint_vel=good.joint_vel.at[2, 1].set(bad))
    state, info = plan(params, state, broken)
    assert int(info.status) == qp.Status.NON_FINITE
    state, torque = act(params, state, broken)
    assert (np.asarray(torque) == 0.0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    state, info = plan(params, state, good)
    assert int(info.status) == qp.Status.SOLVED


def test_a_batch_of_robots_equals_single_ones(controller, params, plan):
    shifts = jnp.linspace(-0.01, 0.01, 5)
    batch = jax.vmap(lambda dz: standing(base_pos=jnp.array([0.0, 0.0, 0.285]) + dz))(shifts)
    states = jax.vmap(controller.init, in_axes=(None, 0))(params, batch)
    together, _ = jax.jit(jax.vmap(controller.plan, in_axes=(None, 0, 0)))(params, states, batch)
    for i in range(5):
        alone, _ = plan(
            params,
            jax.tree.map(lambda a, i=i: a[i], states),
            jax.tree.map(lambda a, i=i: a[i], batch),
        )
        # 1e-9 N: the same operations, summed in another order
        np.testing.assert_allclose(together.force[i], alone.force, atol=1e-9)


def test_measured_feet_and_fixed_feet_agree_where_the_feet_are_nominal(controller):
    """With the robot standing, the measured contact points differ from the fixed ones by mm."""
    config = load_config(RunConfig, None, {"koopman.feet": "measured"})
    measured = build_controller(config)
    low = standing(base_pos=[0.0, 0.0, float(standing().base_pos[2]) - 0.014])
    ours, info = jax.jit(measured.step)(*_start(measured, build_params(config, go1.PARAMS), low))[
        ::2
    ]
    theirs = jax.jit(controller.step)(
        *_start(controller, build_params(RunConfig(), go1.PARAMS), low)
    )[0]
    assert int(info.status) == qp.Status.SOLVED
    # 1.5 N of 60: B is fitted on other data, and the contact points are a few mm apart
    np.testing.assert_allclose(ours.force, theirs.force, atol=1.5)


def _start(controller, params, observation):
    return params, controller.init(params, observation), observation
