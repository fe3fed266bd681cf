"""Swing legs: the foot's path, what it remembers, footholds, and joint references in MuJoCo."""

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from kjax import RunConfig, resolve
from kjax.legs import kinematics, swing
from kjax.legs.contact import Flags, initial_contact
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.types import Leg, Observation, RobotParams

DURATION, APEX, ACROSS, HOLD_AFTER = 0.25, 0.06, 0.9, 0.3
LIFT_OFF = np.array([[0.2, 0.02], [0.2, 0.02], [-0.2, 0.05], [-0.2, 0.05]])
TARGET = np.array([[0.3, 0.02], [0.15, 0.07], [-0.1, 0.02], [-0.2, 0.05]])
OFFSET = np.array([0.01, 0.02, -0.03, -0.04])  # m, foothold ahead of the hip
NONE = np.zeros(4, bool)
ROUNDING = {"float32": 1e-6, "float64": 1e-14}  # ten roundings on lengths below 1 m


def where_feet_shall_be(params, state, target):
    return swing.held_or_on_path(params, state, *swing.foot_path(params, state, target))


def flags_of(contact, *, blocked=NONE, flicker=NONE):
    """Flags as the contact logic hands them on; its own state plays no part here."""
    return Flags(
        state=initial_contact(np.dtype(float)), contact=contact, blocked=blocked, flicker=flicker
    )


def one_step(params, state, swinging, contact, feet, dt):
    state = swing.advance(state, swinging, dt)
    flags = flags_of(contact, blocked=swinging & contact)
    return swing.hold_feet(params, state, flags, feet, dt)


reference = jax.jit(where_feet_shall_be)
proceed = jax.jit(one_step, static_argnames="dt")
joint_reference = jax.jit(swing.joint_reference)
planar_state = jax.jit(kinematics.planar_state)


def settings(dtype="float64"):
    values = {"apex": APEX, "horizontal_fraction": ACROSS, "hold_after": HOLD_AFTER}
    values |= {"offset": OFFSET, "reach_speed": 0.8, "lift": 0.0}
    values |= {"velocity_gain": 0.05, "kp": [200.0, 150.0, 120.0], "kd": [4.0, 3.0, 2.0]}
    return swing.SwingParams(**{name: jnp.asarray(v, dtype) for name, v in values.items()})


def robot(dtype="float64"):
    return RobotParams(*(jnp.asarray(a, dtype) for a in go1.PARAMS))


def swinging(elapsed, dtype="float64", duration=DURATION):
    """All four legs ``elapsed`` seconds after lift-off."""
    state = swing.initial_swing(jnp.zeros((4, 2), dtype))
    state = swing.begin_swings(
        state, jnp.ones(4, bool), jnp.asarray(LIFT_OFF, dtype), jnp.full(4, duration, dtype)
    )
    return state._replace(elapsed=jnp.full(4, elapsed, dtype))


def path(elapsed, dtype="float64"):
    position, velocity = reference(
        settings(dtype), swinging(elapsed, dtype), jnp.asarray(TARGET, dtype)
    )
    assert position.dtype == velocity.dtype == dtype
    return np.asarray(position), np.asarray(velocity)


def test_a_swing_starts_at_lift_off_at_rest(dtype):
    position, velocity = path(0.0, dtype)
    np.testing.assert_array_equal(position, LIFT_OFF.astype(dtype))
    np.testing.assert_array_equal(velocity, 0.0)


@pytest.mark.parametrize("elapsed", [DURATION, 1.3 * DURATION])
def test_a_swing_ends_at_the_target_at_rest_and_waits_there(dtype, elapsed):
    position, velocity = path(elapsed, dtype)
    np.testing.assert_allclose(position, TARGET, rtol=0, atol=ROUNDING[dtype.name])
    # 6 s (1 - s) / T of heights of 0.1 m at s = 1 to rounding.
    np.testing.assert_allclose(velocity, 0.0, rtol=0, atol=10 * ROUNDING[dtype.name])


def test_the_velocity_is_the_slope_of_the_position():
    h = 1e-6
    for elapsed in (0.02, 0.1, 0.124, 0.126, 0.2, 0.223, 0.23):
        numeric = (path(elapsed + h)[0] - path(elapsed - h)[0]) / (2 * h)
        # Central differences: truncation h^2 p''' / 6 = 1e-10 (p''' up to 12 L / s^3 T^3 = 500),
        # rounding 1e-16 / h = 1e-10.
        np.testing.assert_allclose(path(elapsed)[1], numeric, rtol=0, atol=2e-9)


def test_position_and_velocity_have_no_jump():
    times = np.linspace(0.0, 1.1 * DURATION, 4001)
    positions, velocities = jax.jit(
        jax.vmap(
            lambda t: where_feet_shall_be(
                settings(), swinging(0.0)._replace(elapsed=jnp.full(4, t)), jnp.asarray(TARGET)
            )
        )
    )(jnp.asarray(times))
    dt = times[1]
    # Speed at most 1.5 L / (T / 2) = 1.4 m/s, acceleration 6 L / (T / 2)^2 = 45 m/s^2.
    assert np.abs(np.diff(positions, axis=0)).max() < 1.5 * dt
    assert np.abs(np.diff(velocities, axis=0)).max() < 45.0 * dt


def test_the_foot_clears_the_higher_end_by_the_apex_at_half_time():
    top = np.maximum(LIFT_OFF[:, 1], TARGET[:, 1]) + APEX
    # Rounding.
    np.testing.assert_allclose(path(DURATION / 2)[0][:, 1], top, rtol=0, atol=1e-15)
    for elapsed in np.linspace(0.0, DURATION, 21):
        assert (path(elapsed)[0][:, 1] <= top + 1e-15).all()


def test_the_foot_is_above_its_foothold_for_the_last_part_of_the_swing():
    for elapsed in (ACROSS * DURATION, 0.97 * DURATION):
        position, velocity = path(elapsed)
        # Rounding.
        np.testing.assert_allclose(position[:, 0], TARGET[:, 0], rtol=0, atol=1e-15)
        np.testing.assert_allclose(velocity[:, 0], 0.0, rtol=0, atol=1e-14)
    assert (np.abs(path(0.8 * DURATION)[0] - TARGET)[:3, 0] > 1e-3).all()


def test_only_lifting_legs_begin_a_swing(dtype):
    old = swinging(0.1, dtype)._replace(held=jnp.ones(4, bool))
    lifting = jnp.array([True, False, False, True])
    feet = jnp.asarray(TARGET, dtype)
    new = swing.begin_swings(old, lifting, feet, jnp.full(4, 0.3, dtype))
    chex.assert_trees_all_equal_shapes_and_dtypes(new, old)
    for leg in range(4):
        source = TARGET if lifting[leg] else LIFT_OFF
        np.testing.assert_array_equal(new.lift_off[leg], source[leg].astype(dtype))
    np.testing.assert_array_equal(new.elapsed, np.where(lifting, 0.0, 0.1).astype(dtype))
    np.testing.assert_array_equal(new.duration, np.where(lifting, 0.3, DURATION).astype(dtype))
    np.testing.assert_array_equal(new.held, ~lifting)


def after(elapsed, contact, *, state=None, moving=(True,) * 4, feet=TARGET, dtype="float64"):
    state = swinging(elapsed - 0.001, dtype) if state is None else state
    return proceed(
        settings(dtype),
        state,
        jnp.asarray(moving),
        jnp.asarray(contact),
        jnp.asarray(feet, dtype),
        dt=0.001,
    )


def test_a_contact_right_after_lift_off_is_ignored():
    state = after(0.9 * HOLD_AFTER * DURATION, [True] * 4)
    assert not state.held.any()


def test_a_foot_that_hits_something_late_in_its_swing_is_held_there(dtype):
    state = after(1.1 * HOLD_AFTER * DURATION, [True, False, True, False], dtype=dtype)
    np.testing.assert_array_equal(state.held, [True, False, True, False])
    position, velocity = reference(settings(dtype), state, jnp.asarray(LIFT_OFF, dtype))
    np.testing.assert_array_equal(position[::2], TARGET[::2].astype(dtype))
    np.testing.assert_array_equal(velocity[::2], 0.0)
    assert (np.abs(velocity[1::2]).max(axis=1) > 0.01).all()


def test_a_held_foot_stays_where_it_first_touched():
    first = after(0.2, [True] * 4)
    later = after(None, [True] * 4, state=first, feet=TARGET + 0.1)
    np.testing.assert_array_equal(later.held_at, TARGET)
    gone = after(None, [False] * 4, state=first, feet=TARGET + 0.1)
    np.testing.assert_array_equal(gone.held, True)
    np.testing.assert_array_equal(gone.held_at, TARGET)


CUT = np.array([True, True, False, False])


def cut_short(contact, reach_speed=0.8):
    """All legs are told to stand; the first two had their swing cut short."""
    feet = jnp.asarray(TARGET) + jnp.array([0.0, 0.03])
    params = settings()._replace(reach_speed=jnp.asarray(reach_speed))
    stand = jnp.ones(4, bool)
    return params, swing.end_swings(
        params, swinging(0.1), stand, jnp.asarray(CUT), jnp.asarray(contact), feet
    )


def test_a_foot_whose_swing_was_cut_short_sinks_straight_down_until_it_touches():
    params, state = cut_short([False, True, False, False])
    np.testing.assert_array_equal(state.reaching, [True, False, False, False])
    air, ground, none = jnp.zeros(4, bool), jnp.ones(4, bool), jnp.zeros(4, bool)
    for _ in range(10):
        state = one_step(params, state, none, air, jnp.asarray(TARGET), 0.001)
    position, velocity = where_feet_shall_be(params, state, jnp.asarray(LIFT_OFF))
    np.testing.assert_allclose(position[0], TARGET[0] + [0.0, 0.03 - 0.8 * 0.01], atol=1e-12)
    np.testing.assert_allclose(velocity[0], [0.0, -0.8])
    landed = one_step(params, state, none, ground, jnp.asarray(TARGET), 0.001)
    assert not landed.reaching.any()
    # It presses from then on, whatever the contact sensor says.
    again = one_step(params, landed, none, air, jnp.asarray(TARGET), 0.001)
    assert not again.reaching.any()


def test_a_reaching_foot_that_lifts_off_again_reaches_no_more():
    _, state = cut_short([False] * 4)
    np.testing.assert_array_equal(state.reaching, CUT)
    lifting = jnp.array([True, False, False, False])
    state = swing.begin_swings(state, lifting, jnp.asarray(LIFT_OFF), jnp.full(4, 0.2))
    np.testing.assert_array_equal(state.reaching, [False, True, False, False])


def test_without_a_reach_speed_every_leg_presses_at_once():
    _, state = cut_short([False] * 4, reach_speed=0.0)
    assert not state.reaching.any()


def test_a_stance_leg_neither_ages_nor_is_held():
    state = after(0.2, [True] * 4, moving=(False, True, False, True))
    np.testing.assert_array_equal(state.held, [False, True, False, True])
    # 0.199 + 0.001 rounds once.
    np.testing.assert_allclose(state.elapsed, [0.199, 0.2, 0.199, 0.2], rtol=1e-15)


def test_before_the_first_swing_nothing_is_held_and_the_path_stays_at_the_feet():
    state = swing.initial_swing(jnp.asarray(LIFT_OFF))
    assert not state.held.any()
    position, _ = reference(settings(), state, jnp.asarray(TARGET))
    np.testing.assert_array_equal(position, LIFT_OFF)


STUMBLE = 0.2 * DURATION


def stumbled(elapsed, blocked=(True, False, False, False), steps=1):
    """A swing whose first leg hits something ``elapsed`` seconds after it began."""
    params = settings()._replace(lift=jnp.asarray(0.05), hold_after=jnp.asarray(0.6))
    state = swing.initial_swing(jnp.asarray(LIFT_OFF), lifts=True)
    state = swing.begin_swings(
        state, jnp.ones(4, bool), jnp.asarray(LIFT_OFF), jnp.full(4, DURATION)
    )
    state = state._replace(elapsed=jnp.full(4, elapsed))
    hit = jnp.asarray(LIFT_OFF) + 0.04
    for _ in range(steps):
        flags = flags_of(jnp.array(blocked), blocked=jnp.array(blocked))
        state = swing.hold_feet(params, state, flags, hit, 0.001)
        blocked = [False] * 4
    return params, state, hit


def test_a_foot_that_hits_something_on_its_way_up_starts_again_from_there_and_higher():
    params, state, hit = stumbled(STUMBLE)
    np.testing.assert_allclose(state.lift_off[0], hit[0])
    np.testing.assert_allclose(state.lift_off[1:], LIFT_OFF[1:])
    np.testing.assert_allclose(state.elapsed, [0.0, *[STUMBLE] * 3])
    np.testing.assert_allclose(state.duration[0], DURATION - STUMBLE)  # it lands when it should
    assert not state.held.any()
    middle = state._replace(elapsed=0.5 * state.duration)
    position, _ = reference(params, middle, jnp.asarray(TARGET))
    high = np.maximum(np.asarray(middle.lift_off)[:, -1], np.asarray(TARGET)[:, -1])
    np.testing.assert_allclose(position[:, -1] - high, APEX + 0.05, rtol=1e-6)


def test_what_is_hit_late_holds_the_foot_and_what_is_left_with_does_not_count():
    _, state, _ = stumbled(0.7 * DURATION)
    assert state.held.tolist() == [True, False, False, False]
    assert float(state.raised) == 0.0
    _, state, _ = stumbled(0.05 * DURATION)
    assert not state.held.any()
    assert float(state.raised) == 0.0


def test_the_higher_swings_fade_within_seconds():
    _, state, _ = stumbled(STUMBLE, steps=1001)
    assert float(state.raised) == pytest.approx(0.05 / np.e, rel=1e-3)


def standing(x=0.0, pitch=0.0, velocity=0.0, dtype="float64"):
    height, joint_pos = stand_pose(go1.PARAMS, 0.27)
    half = -0.5 * pitch  # nose-up is a negative turn about +y
    values = (
        [x, 0.0, height],
        [np.cos(half), 0.0, np.sin(half), 0.0],
        [velocity, 0.0, 0.0],
        np.zeros(3),
        joint_pos,
        np.zeros((4, 3)),
    )
    seen = Observation(*(jnp.asarray(v, dtype) for v in values), contact=jnp.ones(4, bool))
    return planar_state(robot(dtype), seen)


@jax.jit
def foothold(body, remaining, stance_time, command):
    dtype = command.dtype
    return swing.foothold(robot(dtype), settings(dtype), body, remaining, stance_time, command)


def test_at_the_commanded_velocity_the_stance_is_symmetric_about_the_hip_and_its_offset(dtype):
    """The hip passes the offset before the foot half-way through the stance to come."""
    v, remaining, stance = 0.6, np.array([0.1, 0.2, 0.05, 0.0]), np.array([0.2, 0.25, 0.3, 0.1])
    body = standing(x=1.5, velocity=v, dtype=dtype)
    step = foothold(
        body,
        jnp.asarray(remaining, dtype),
        jnp.asarray(stance, dtype),
        jnp.asarray(v, dtype),
    )
    hips = 1.5 + np.array([0.1881, 0.1881, -0.1881, -0.1881])
    middle = hips + OFFSET + v * (remaining + stance / 2)
    # The gain times the rounded velocity error, and roundings of 1.7 m.
    np.testing.assert_allclose(step, middle, rtol=0, atol=2 * ROUNDING[dtype.name])


def test_too_fast_a_body_steps_further_ahead_by_the_gain():
    zero = jnp.zeros(4)
    body = standing(velocity=0.5)
    slow, fast = (foothold(body, zero, zero, jnp.asarray(command)) for command in (0.3, 0.5))
    np.testing.assert_allclose(slow - fast, 0.05 * 0.2, rtol=1e-13)  # rounding


def test_the_foothold_is_below_the_hip_of_a_pitched_trunk():
    zero = jnp.zeros(4)
    step = foothold(standing(pitch=0.5), zero, zero, jnp.asarray(0.0))
    expected = np.array([1, 1, -1, -1]) * 0.1881 * np.cos(0.5) + OFFSET
    np.testing.assert_allclose(step, expected, rtol=1e-13)  # rounding


def test_each_gait_has_its_own_apex_gain_and_offset(dtype):
    """All else is shared; the gait is an index, and batches of them trace once."""
    stacked = settings(dtype)._replace(
        apex=jnp.asarray([0.05, 0.06, 0.07], dtype),
        velocity_gain=jnp.asarray([0.01, 0.02, 0.03], dtype),
        offset=jnp.asarray(np.arange(12).reshape(3, 4), dtype),
    )
    pick = jax.jit(chex.assert_max_traces(swing.for_gait, n=1))
    for gait in range(3):
        picked = pick(stacked, jnp.asarray(gait))
        chex.assert_trees_all_equal_shapes_and_dtypes(picked, settings(dtype))
        assert picked.apex == stacked.apex[gait]
        assert picked.velocity_gain == stacked.velocity_gain[gait]
        np.testing.assert_array_equal(picked.offset, np.arange(4 * gait, 4 * gait + 4))
        for name in ("horizontal_fraction", "hold_after", "reach_speed", "kp", "kd"):
            np.testing.assert_array_equal(getattr(picked, name), getattr(stacked, name))


@pytest.fixture(scope="module")
def tracked(planar_go1, leg_joints):
    """A moving trunk and moving feet in reach; MuJoCo with our joint angles and rates."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(planar_go1)
    data.joint("root_x").qpos, data.joint("root_z").qpos = 0.4, 0.35
    data.joint("root_pitch").qpos = -0.3
    data.joint("root_x").qvel, data.joint("root_z").qvel = 0.5, -0.2
    data.joint("root_pitch").qvel = -1.5
    mujoco.mj_forward(planar_go1, data)
    hips = np.stack([data.body(f"{leg.name}_thigh").xpos[::2] for leg in Leg])
    position = hips + rng.uniform([-0.12, -0.32], [0.12, -0.2], (4, 2))
    velocity = rng.normal(size=(4, 2)) * 0.7
    seen = Observation(
        base_pos=jnp.asarray(data.body("trunk").xpos),
        base_quat=jnp.asarray(data.body("trunk").xquat),
        base_vel=jnp.array([0.5, 0.0, -0.2]),
        base_ang_vel=jnp.array([0.0, -1.5, 0.0]),
        joint_pos=jnp.zeros((4, 3)),
        joint_vel=jnp.zeros((4, 3)),
        contact=jnp.zeros(4, bool),
    )
    body = planar_state(robot(), seen)
    angle, rate = joint_reference(robot(), body, jnp.asarray(position), jnp.asarray(velocity))
    sagittal = leg_joints[:, 1:]
    data.qpos[planar_go1.jnt_qposadr[sagittal]] = angle
    data.qvel[planar_go1.jnt_dofadr[sagittal]] = rate
    mujoco.mj_forward(planar_go1, data)
    return data, position, velocity, np.asarray(rate), body


def test_joint_references_put_the_feet_of_a_moving_trunk_on_their_paths(tracked, planar_go1):
    data, position, velocity, rate, _ = tracked
    assert np.abs(rate).max() < swing.MAX_JOINT_RATE
    for leg in Leg:
        foot = planar_go1.geom(f"{leg.name}_foot").id
        # Rounding, over the leg's determinant for the rates (at least 0.01 m^2).
        np.testing.assert_allclose(data.geom_xpos[foot, ::2], position[leg], rtol=0, atol=1e-13)
        motion = np.zeros(6)
        mujoco.mj_objectVelocity(planar_go1, data, mujoco.mjtObj.mjOBJ_GEOM, foot, motion, 0)
        np.testing.assert_allclose(motion[3::2], velocity[leg], rtol=0, atol=1e-12)


def test_joint_rates_are_bounded_and_finite_at_the_end_of_the_reach(tracked):
    body = tracked[-1]
    hips = np.asarray(body.base + go1.PARAMS.hip_pos[:, ::2] @ np.asarray(body.rotation).T)
    far = jnp.asarray(hips + np.array([0.0, -1.0]))
    angle, rate = joint_reference(robot(), body, far, jnp.full((4, 2), 100.0))
    assert np.isfinite(angle).all()
    assert np.isfinite(rate).all()
    assert np.abs(rate).max() <= swing.MAX_JOINT_RATE


def test_the_joint_torque_is_a_spring_and_a_damper_towards_the_reference(dtype):
    rng = np.random.default_rng(0)
    q, qd = rng.normal(size=(2, 4, 3))
    wanted, wanted_rate = rng.normal(size=(2, 4, 2))
    pull = jax.jit(swing.swing_torque)
    torque = pull(settings(dtype), *(jnp.asarray(a, dtype) for a in (q, qd, wanted, wanted_rate)))
    assert torque.dtype == dtype
    spring = [150.0, 120.0] * (wanted - q[:, 1:]) + [3.0, 2.0] * (wanted_rate - qd[:, 1:])
    # A few roundings of torques up to 500 N m.
    np.testing.assert_allclose(torque, spring, rtol=0, atol=2000 * np.finfo(dtype).eps)
    at_rest = pull(settings(), *(jnp.asarray(a) for a in (q, qd, q[:, 1:], qd[:, 1:])))
    np.testing.assert_array_equal(at_rest, 0.0)


def test_the_state_keeps_its_tree_shapes_and_dtypes_and_traces_once(dtype):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def tick(state, contact):
        flags = jnp.ones(4, bool)
        return one_step(settings(dtype), state, flags, contact, state.lift_off, 0.001)

    state = swinging(0.1, dtype)
    for contact in (True, False):
        new = tick(state, jnp.full(4, contact))
        chex.assert_trees_all_equal_shapes_and_dtypes(new, state)


def test_a_foot_held_for_a_moment_goes_on_with_its_path():
    hit = jnp.array([True, True, False, False])
    feet = jnp.asarray(TARGET)
    held = swing.hold_feet(settings(), swinging(0.15), flags_of(hit, blocked=hit), feet, 0.001)
    assert held.held.tolist() == [True, True, False, False]
    over = flags_of(NONE, flicker=jnp.array([True, False, False, False]))
    released = swing.hold_feet(settings(), held, over, feet, 0.001)
    assert released.held.tolist() == [False, True, False, False]


def test_points_stay_where_they_are_when_the_frame_moves_on():
    state = swing.carry_along(swinging(0.1), jnp.array([0.3, -0.1]))
    # One rounding of a difference.
    np.testing.assert_allclose(state.lift_off + jnp.array([0.3, -0.1]), LIFT_OFF, atol=1e-15)


def gains_of(robot, dt):
    """Shipped gains of a robot's legs in the air, as they are and as its legs bear them."""
    given = resolve(RunConfig(), robot)[1].swing
    borne = swing.steady_gains(given, robot, dt)
    return [np.asarray(a) for a in (given.kp, given.kd, borne.kp, borne.kd)]


def test_gains_of_the_go1_are_its_own_at_1_khz_and_a_little_lower_in_held_torques():
    kp, kd, kp_borne, kd_borne = gains_of(go1.PARAMS, 0.001)
    np.testing.assert_array_equal(kp_borne, kp)
    np.testing.assert_array_equal(kd_borne, kd)
    kp, kd, kp_borne, kd_borne = gains_of(go1.PARAMS, 0.005)
    np.testing.assert_allclose(kd_borne / kd, [0.854, 1.0, 0.977], atol=2e-3)
    np.testing.assert_allclose(kp_borne / kp, kd_borne / kd, rtol=1e-12)


def test_a_light_leg_does_not_shake_between_two_torques():
    """Spot's calf at 5 ms: its rate would go to -3.9 times itself from one torque to the next."""
    inertia, dt = np.array([0.038, 0.063, 0.0234]), 0.005
    light = go1.PARAMS._replace(joint_inertia=inertia)
    given = resolve(RunConfig(), go1.PARAMS)[1].swing._replace(
        kp=jnp.array([1200.0, 900.0, 900.0]), kd=jnp.array([30.0, 22.7, 22.7])
    )
    borne = swing.steady_gains(given, light, dt)
    before, after = (1.0 - np.asarray(own.kd) * dt / inertia for own in (given, borne))
    assert before[2] < -3.8
    assert (np.abs(after) < 0.05).all()
    # Position and rate of each joint under its own gains, torques held: all eigenvalues within 1.
    for own, is_steady in ((given, False), (borne, True)):
        stiff, damp = np.asarray(own.kp)[2], np.asarray(own.kd)[2]
        step = np.array([
            [1.0 - dt**2 * stiff / inertia[2], dt * (1.0 - dt * damp / inertia[2])],
            [-dt * stiff / inertia[2], 1.0 - dt * damp / inertia[2]],
        ])  # fmt: skip
        assert (np.abs(np.linalg.eigvals(step)).max() < 1.0) == is_steady


def test_where_no_inertia_is_known_gains_stay_and_have_gradients():
    robot = go1.PARAMS._replace(joint_inertia=jnp.full(3, jnp.inf))
    given = resolve(RunConfig(), go1.PARAMS)[1].swing
    given = jax.tree.map(jnp.asarray, given)
    borne = swing.steady_gains(given, robot, 0.005)
    np.testing.assert_array_equal(borne.kp, given.kp)

    def total(kd):
        own = swing.steady_gains(given._replace(kd=kd), robot, 0.005)
        return own.kp.sum() + own.kd.sum()

    np.testing.assert_array_equal(jax.grad(total)(given.kd), 1.0)
