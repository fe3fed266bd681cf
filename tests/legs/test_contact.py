"""Which contact flags stop a swing foot, and which legs' flags are told to be wrong."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from kjax.legs import contact

DT = 0.001
# Legs: on its path in the air; stopped by something; behind its path; on the ground.
PLACE = np.array([[0.1, 0.06], [0.1, 0.06], [0.1, 0.06], [0.1, 0.01]])
WANTED = PLACE + np.array([[0.0, 0.0], [0.0, 0.0], [0.04, 0.0], [0.0, 0.0]])
RATE = np.tile([1.0, 0.0], (4, 1))
SPEED = RATE * np.array([[1.0], [0.1], [1.0], [1.0]])
ON, OFF = jnp.ones(4, bool), jnp.zeros(4, bool)


@jax.jit
def read(state, flags, stance, phase_time, swing_time):
    dtype = state.on_time.dtype
    return contact.read_flags(
        state,
        flags,
        contact.LegPhase(stance, phase_time, jnp.full(4, swing_time, dtype)),
        contact.FootMotion(jnp.asarray(PLACE, dtype), jnp.asarray(SPEED, dtype)),
        contact.FootMotion(jnp.asarray(WANTED, dtype), jnp.asarray(RATE, dtype)),
        jnp.zeros((), dtype),
        DT,
    )


def after(samples, *, stance=OFF, phase_time=0.1, swing_time=0.1, dtype="float64"):
    """What the last of some samples tells."""
    state = contact.initial_contact(jnp.dtype(dtype))
    for flags in samples:
        told = read(state, flags, stance, jnp.asarray(phase_time, dtype), swing_time)
        chex.assert_trees_all_equal_shapes_and_dtypes(told.state, state)
        state = told.state
    return told


def test_a_swing_foot_is_blocked_where_it_slows_falls_behind_or_is_on_the_ground(dtype):
    assert after([ON] * 2, dtype=dtype).blocked.tolist() == [False, True, True, True]


def test_a_flag_that_has_been_on_since_before_the_lift_off_blocks_nothing():
    assert not after([ON] * 30, swing_time=0.02).blocked.any()
    # Off once since then, it counts again.
    assert after([ON] * 30 + [OFF, ON], swing_time=0.02).blocked.tolist() == [
        False, True, True, True
    ]  # fmt: skip


def test_no_flag_blocks_nothing_and_neither_does_one_of_a_stance_leg():
    assert not after([OFF] * 3).blocked.any()
    assert not after([ON] * 3, stance=ON).blocked.any()


def test_a_contact_is_a_flicker_when_it_was_over_within_4_ms():
    for length, flicker in ((1, True), (3, True), (4, False), (20, False)):
        assert bool(after([ON] * length + [OFF]).flicker.all()) == flicker, length
    assert not after([ON] * 2).flicker.any()  # not over yet
    assert not after([ON, OFF, OFF]).flicker.any()  # told once


def test_the_leg_whose_flag_denies_its_kinematics_is_told():
    """0.04 of the samples of 0.5 s: 21 ms of them in a row."""
    assert not contact.is_faulty(after([ON] * 20).state).any()
    assert contact.is_faulty(after([ON] * 25).state).tolist() == [True, False, False, False]
    # A stance leg without contact is wrong 50 ms after its phase has begun.
    missing = after([OFF] * 25, stance=ON, phase_time=0.06)
    assert contact.is_faulty(missing.state).all()
    late = after([OFF] * 25, stance=ON, phase_time=0.04)
    assert not contact.is_faulty(late.state).any()
