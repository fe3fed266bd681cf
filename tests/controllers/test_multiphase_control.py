"""The controller with a horizon through flight: in one program with the other gaits, and safe."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig, build_controller, load_config, qp
from kjax.controllers.params import condense
from kjax.controllers.resolve import controller_spec, resolve
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.types import Leg, Mode, Observation

DT = 0.005
TIMES = [0.0, 0.4]


def config(**changes):
    chosen = {
        "sim.base": "planar",
        "gait.also": ["trot", "bound_multiphase"],
        "gait.names": ["bound_multiphase", "trot"],
        "gait.times": TIMES,
        "gaits.bound_multiphase.ramp_start": 1.0,
        "gaits.bound_multiphase.body_height": 0.6338,
        "gaits.bound_multiphase.foothold_front": 0.1761,
        "gaits.bound_multiphase.foothold_rear": 0.3474,
        "gaits.bound_multiphase.foothold_gain": 0.3599,
        "lmpc.integral_gains": [2.0, 1.0],
        "command.times": [0.0],
        "command.v_x": [0.05],
        "lmpc.command_slew": np.inf,
    }
    return load_config(RunConfig, None, chosen | changes)


def standing(**changes):
    height, joints = stand_pose(go1.PARAMS, 0.26)
    floats = {
        "base_pos": [0.0, 0.0, height],
        "base_quat": [1.0, 0.0, 0.0, 0.0],
        "base_vel": [0.0, 0.0, 0.0],
        "base_ang_vel": [0.0, 0.0, 0.0],
        "joint_pos": joints,
        "joint_vel": np.zeros((4, 3)),
    }
    arrays = {key: jnp.asarray(value, float) for key, value in (floats | changes).items()}
    return Observation(**arrays, contact=jnp.ones(4, bool))


@pytest.fixture(scope="module")
def controller():
    return build_controller(controller_spec(config()))


@pytest.fixture(scope="module")
def tables():
    return condense(*resolve(config(), go1.PARAMS))


@pytest.fixture(scope="module")
def plan(controller):
    return jax.jit(controller.plan)


@pytest.fixture(scope="module")
def ticks(controller, tables, plan):
    """States and infos of 130 plans of a robot that is held still: bound, then trot."""
    state, log = controller.init(tables, standing()), []
    for _ in range(130):
        state, info = plan(tables, state, standing())
        log.append((state, info))
    return log


def test_each_phase_is_planned_by_its_own_scheme_and_solved(ticks):
    modes = [int(info.mode) for _, info in ticks]
    assert set(modes) == {Mode.FRONT, Mode.FLIGHT, Mode.REAR, Mode.TROT}
    for (state, info), mode in zip(ticks, modes, strict=True):
        assert info.status == qp.Status.SOLVED
        force = np.asarray(state.force)
        standing_legs = np.asarray(state.stance)
        np.testing.assert_array_equal(force[~standing_legs], 0.0)
        if mode in (Mode.FRONT, Mode.REAR):
            assert (force[standing_legs, 2] >= 10.0 - 1e-3).all()
            ratio = np.abs(force[standing_legs, 0]) / force[standing_legs, 2]
            assert (ratio <= 0.7 + 1e-3).all()
            assert np.ptp(force[standing_legs], axis=0).max() == 0.0  # a pair shares


def test_the_force_on_a_pitched_trunk_keeps_to_the_pyramid_of_the_world(controller, tables, plan):
    pitch = 0.2  # nose up: about +y by -0.2
    half = [np.cos(pitch / 2), 0.0, -np.sin(pitch / 2), 0.0]
    seen = standing(base_quat=half)
    state, info = plan(tables, controller.init(tables, seen), seen)
    assert int(info.mode) == Mode.FRONT
    force = np.asarray(state.force)[Leg.FR]
    assert 10.0 - 1e-3 <= force[2] <= 340.0 + 1e-3
    assert abs(force[0]) == pytest.approx(0.6 * force[2], rel=1e-4)  # the pitch asks for all of it


def test_a_nan_in_the_observation_is_reported_and_leaves_the_reference_force(
    controller, tables, plan
):
    state = controller.init(tables, standing())
    bad = standing(base_vel=[np.nan, 0.0, 0.0])
    state, info = plan(tables, state, bad)
    assert info.status == qp.Status.NON_FINITE
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    force = np.asarray(state.force)
    # What the front pair carries in the periodic motion: its share of the weight over the cycle.
    share = 0.148 / (0.075 + 0.148)
    load = 12.743 * 9.81 * 0.35 * share / (2 * 0.1)
    assert force[[Leg.FR, Leg.FL], 2] == pytest.approx(load, rel=0.01)
    _, info = plan(tables, state, standing())
    assert info.status == qp.Status.SOLVED


def test_a_batch_of_robots_in_other_phases_equals_single_ones(plan, tables, ticks):
    chosen = [ticks[i][0] for i in (5, 25, 42, 120)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *chosen)
    seen = standing()
    states, infos = jax.vmap(plan, in_axes=(None, 0, None))(tables, batch, seen)
    for i, one in enumerate(chosen):
        state, info = plan(tables, one, seen)
        assert infos.mode[i] == info.mode
        np.testing.assert_allclose(states.force[i], state.force, atol=1e-4)


def test_integral_action_adds_up_the_velocity_error_and_starts_afresh_with_a_gait(ticks):
    gaits = np.array([int(state.clock.gait) for state, _ in ticks])
    seen = np.array([np.asarray(state.correction) for state, _ in ticks])
    # Held still under a command of 0.05 m/s, at 2 / s: 0.1 m/s^2 from the first tick on.
    bounding = gaits == 1
    n = bounding.sum()
    np.testing.assert_allclose(seen[bounding, 0], 2.0 * DT * 0.05 * np.arange(1, n + 1), atol=1e-9)
    first = np.flatnonzero(~bounding)[0]
    np.testing.assert_array_equal(seen[first], 0.0)
    assert seen[first + 1, 0] == pytest.approx(2.0 * DT * 0.05)


def test_the_correction_stays_within_its_limit(controller, plan):
    tables = condense(
        *resolve(
            config(**{"lmpc.integral_limits": [0.01, 0.02], "lmpc.integral_gains": [10.0, 1.0]}),
            go1.PARAMS,
        )
    )
    state = controller.init(tables, standing())
    for _ in range(40):
        state, _ = plan(tables, state, standing())
    np.testing.assert_allclose(state.correction[0], 0.01)
    assert abs(state.correction[1]) <= 0.02
