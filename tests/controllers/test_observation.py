"""What is believed of an observation, and which wrong conventions show in a standing sample."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kjax import Observation, build_controller, check_observation, load_config, qp
from kjax.config import RunConfig
from kjax.controllers.observation import SHAPES, cast, is_valid
from kjax.controllers.params import condense, with_params
from kjax.controllers.resolve import controller_spec, resolve
from kjax.legs.posture import stand_pose
from kjax.robots import go1

CONFIG = load_config(RunConfig, None, {"lmpc.horizon": 2, "koopman.order": 1})


def standing(**changes):
    height, joints = stand_pose(go1.PARAMS, 0.27)
    values = {
        "base_pos": np.array([3.0, -1.0, height - 2.0]),
        "base_quat": np.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)]),
        "base_vel": np.zeros(3),
        "base_ang_vel": np.zeros(3),
        "joint_pos": joints,
        "joint_vel": np.zeros((4, 3)),
        "contact": np.ones(4, bool),
    }
    return Observation(**(values | changes))


JOINTS = stand_pose(go1.PARAMS, 0.27)[1]
FAULTS = {
    "quaternion of zeros": ({"base_quat": np.zeros(4)}, r"base_quat: .* wanted a unit quaternion"),
    "quaternion in x, y, z, w order": (
        {"base_quat": np.array([0.0, 0.0, np.sin(0.8), np.cos(0.8)])},
        r"base_quat: .* tilts the trunk by 92 degrees; is it in the order \(x, y, z, w\)\?",
    ),
    "degrees": (
        {"joint_pos": np.degrees(JOINTS)},
        r"joint_pos: got an angle of 10[0-9.]+, wanted radians; is it in degrees\?",
    ),
    "joints of the other sign": (
        {"joint_pos": -JOINTS},
        r"joint_pos: the calf angles .* do the joints have the other sign\?",
    ),
    "thigh of the other sign": (
        {"joint_pos": JOINTS * [1.0, -1.0, 1.0]},
        r"joint_pos: FR's foot is 0\.[0-9]+ m beside its hip, .* the other sign",
    ),
    "joints in another order": (
        {"joint_pos": JOINTS[:, ::-1]},
        r"joint_pos: FR's calf angle is 0 rad, .* order abduction, thigh, calf",
    ),
    "flat joints": (
        {"joint_pos": JOINTS.reshape(-1)},
        r"joint_pos: got shape \(12,\), wanted \(4, 3\)",
    ),
    "forces for flags": (
        {"contact": np.array([30.0, 30.0, 31.0, 29.0])},
        r"contact: got .* compare forces with a threshold",
    ),
    "text": (
        {"base_vel": np.array(["a", "b", "c"])},
        r"base_vel: got type <U1, wanted a numeric type",
    ),
    "not a number": ({"base_vel": np.array([0.0, np.nan, 0.0])}, r"base_vel: .* wanted finite"),
    "speed in mm/s": (
        {"base_vel": np.array([300.0, 0.0, 0.0])},
        r"base_vel: got 300, more than 50 m/s",
    ),
    "flags in another order": (
        {
            "joint_pos": JOINTS + np.array([[0, 0.3, -0.5], [0, 0, 0], [0, 0, 0], [0, 0, 0]]),
            "contact": np.array([True, False, True, True]),
        },
        r"contact: FR is in contact 0\.[0-9]+ m above a foot that is not",
    ),
}


def test_a_robot_that_stands_is_accepted_in_any_place_and_heading():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for turn in (0.0, 1.0, -3.0):
            quat = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
            check_observation(go1.PARAMS, standing(base_quat=quat))
            check_observation(go1.PARAMS, standing(base_quat=-quat))
        check_observation(go1.PARAMS, standing(contact=np.array([1, 0, 0, 1])))


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_convention_is_named_with_its_likely_cause(name):
    changes, text = FAULTS[name]
    with pytest.raises(ValueError, match=rf"observation\.{text}"):
        check_observation(go1.PARAMS, standing(**changes))


def test_a_quaternion_that_may_be_in_the_other_order_is_warned_of():
    with pytest.warns(UserWarning, match=r"heading of 180 degrees; .* order \(x, y, z, w\)"):
        check_observation(go1.PARAMS, standing(base_quat=np.array([0.0, 0.0, 0.0, 1.0])))


@pytest.fixture(scope="module")
def controller():
    return build_controller(controller_spec(CONFIG))


@pytest.fixture(scope="module")
def tables():
    return condense(*resolve(CONFIG, go1.PARAMS))


@pytest.fixture(scope="module")
def calls(controller):
    return jax.jit(controller.init), jax.jit(controller.plan), jax.jit(controller.act)


def test_init_looks_at_what_it_can_and_leaves_traced_samples_alone(controller, tables, calls):
    wrong = standing(joint_pos=-JOINTS)
    with pytest.raises(ValueError, match="do the joints have the other sign"):
        controller.init(tables, wrong)
    assert np.isfinite(calls[0](tables, wrong).ground)


def finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


USELESS = {
    "base_quat": [np.zeros(4), np.full(4, 1e200), np.full(4, np.nan)],
    "base_vel": [np.full(3, 1e200), np.array([0.0, np.inf, 0.0]), np.full(3, 1e3)],
    "base_ang_vel": [np.full(3, 1e30)],
    "joint_pos": [np.full((4, 3), 1e308), np.full((4, 3), 100.0)],
    "joint_vel": [np.full((4, 3), -1e200)],
}


def test_a_position_that_is_no_number_is_not_missed(tables, calls):
    """The controller does not read it: an odometry that drops out must not stop the robot."""
    init, plan, act = calls
    good = standing()
    state = init(tables, good)
    lost = good._replace(base_pos=np.full(3, np.nan))
    for seen in (lost, good):
        _, info = plan(tables, state, seen)
        assert int(info.status) == qp.Status.SOLVED
        assert float(info.blind_time) == 0.0
    np.testing.assert_array_equal(act(tables, state, lost)[1], act(tables, state, good)[1])


def test_a_contact_flag_that_is_no_number_is_off():
    seen = cast(standing(contact=np.array([1.0, np.nan, 0.0, 2.0])), float)
    np.testing.assert_array_equal(seen.contact, [True, False, False, True])


def test_lists_are_as_good_as_arrays(tables):
    controller = build_controller(controller_spec(CONFIG))
    lists = Observation(*(np.asarray(field).tolist() for field in standing()))
    first, second = (controller.init(tables, seen) for seen in (lists, standing()))
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert not bool(is_valid(jax.tree.map(jnp.asarray, standing(base_vel=np.full(3, np.nan)))))


def test_init_takes_a_constant_sample_inside_a_trace(tables):
    """Domain randomisation: one sample for many robots."""
    controller, good = build_controller(controller_spec(CONFIG)), standing()
    eager = controller.init(tables, good)
    inside = jax.jit(lambda: controller.init(tables, good))()
    given = jax.jit(lambda tables: controller.init(tables, good))(tables)
    for state in (inside, given):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-12), state, eager
        )
    masses = jnp.stack([tables.params.robot.mass, 1.1 * tables.params.robot.mass])
    many = jax.vmap(lambda m: controller.init(
        with_params(tables, robot=tables.params.robot._replace(mass=m)), good))(masses)  # fmt: skip
    assert many.ground.shape[0] == 2


@pytest.mark.parametrize("name", USELESS)
def test_one_useless_sample_changes_nothing_that_is_sensed(tables, calls, name):
    init, plan, act = calls
    good = standing()
    state, _ = plan(tables, init(tables, good), good)
    state, joints = act(tables, state, good)
    for values in USELESS[name]:
        bad = good._replace(**{name: values})
        assert not bool(is_valid(jax.tree.map(jnp.asarray, bad)))
        planned, info = plan(tables, state, bad)
        assert int(info.status) == qp.Status.NON_FINITE
        acted, held = act(tables, planned, bad)
        assert finite((planned, acted, held))
        np.testing.assert_array_equal(held.torque, joints.torque)  # the last command holds
        np.testing.assert_array_equal(held.feedforward, joints.torque)  # no loop on such a sample
        # What comes from the clock goes on, what is sensed stays: the robot is at rest.
        assert float(acted.time) > float(state.time)
        for field in ("lag", "ground", "feet", "base_vel", "correction"):
            np.testing.assert_allclose(getattr(acted, field), getattr(state, field), atol=1e-12)
        _, info = plan(tables, acted, good)
        assert int(info.status) == qp.Status.SOLVED


def test_without_samples_the_last_torque_holds_for_a_while_and_turns_into_damping(tables, calls):
    init, plan, act = calls
    good = standing()
    state, _ = plan(tables, init(tables, good), good)
    state, joints = act(tables, state, good)
    rates = 0.1 * np.arange(12.0).reshape(4, 3)
    blind = good._replace(base_quat=np.zeros(4), joint_vel=rates)
    torques = []
    for _ in range(30):
        state, one = act(tables, state, blind)
        torques.append(np.asarray(one.torque))
    # m g L sqrt(L / g)
    damping = CONFIG.leg.blind_kd * float(go1.PARAMS.mass) * (9.81 * 0.426**3) ** 0.5
    hold = round(CONFIG.leg.hold_time / CONFIG.leg.act_dt)
    np.testing.assert_array_equal(torques[:hold], np.tile(joints.torque, (hold, 1, 1)))
    np.testing.assert_allclose(torques[hold + 1 :], np.tile(-damping * rates, (29 - hold, 1, 1)))
    # A motor's own damping slows its joint down at whatever rate that has.
    np.testing.assert_allclose(one.kd, damping)
    np.testing.assert_array_equal([one.kp, one.dq], 0.0)
    np.testing.assert_allclose(one.feedforward, 0.0, atol=1e-12)
    # The gait's clock has gone on, and so has the swing of the legs in the air.
    swinging = ~np.asarray(state.stance)
    np.testing.assert_allclose(np.asarray(state.swing.elapsed)[swinging], 0.031, atol=1e-12)
    # Joint rates that cannot be are no base for damping.
    _, nothing = act(tables, state, blind._replace(joint_vel=np.full((4, 3), np.nan)))
    np.testing.assert_array_equal(nothing.torque, 0.0)


WILD = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    observation=st.fixed_dictionaries(
        {
            name: arrays(
                bool if name == "contact" else float,
                shape,
                **({} if name == "contact" else {"elements": WILD}),
            )
            for name, shape in SHAPES.items()
        }
    )
)
def test_state_and_command_stay_finite_whatever_comes_in(tables, calls, observation):
    init, plan, act = calls
    seen = Observation(**observation)
    state = init(tables, seen)
    assert finite(state)
    state, _ = plan(tables, state, standing())
    state, _ = plan(tables, state, seen)
    state, joints = act(tables, state, seen)
    assert finite((state, joints))
    state, _ = plan(tables, state, standing())
    assert finite(state)


def test_the_state_may_be_donated(controller, tables):
    state = controller.init(tables, standing())
    plan = jax.jit(controller.plan, donate_argnums=1)
    act = jax.jit(controller.act, donate_argnums=1)
    observation = jax.tree.map(jnp.asarray, standing())
    for _ in range(2):
        state, _ = plan(tables, state, observation)
        state, _ = act(tables, state, observation)
    assert finite((state, tables))


def test_a_command_that_is_no_number_leaves_the_last_one(controller, tables, calls):
    init, plan, _ = calls
    broken = with_params(
        tables,
        command=tables.params.command._replace(
            values=jnp.full((5, 6), jnp.nan, tables.params.height.dtype)
        ),
    )
    state, info = plan(broken, init(broken, standing()), standing())
    assert finite(state)
    assert int(info.status) == qp.Status.SOLVED
