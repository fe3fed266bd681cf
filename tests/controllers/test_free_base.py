"""The controller on the free base: what it may not depend on, where it equals the planar one."""

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from free_robot import disturbed, seen_from, torques

from kjax import build_controller, load_config, qp
from kjax.config import RunConfig
from kjax.controllers.params import condense, with_params
from kjax.controllers.resolve import controller_spec, resolve
from kjax.robots import go1
from kjax.types import Leg

PLANAR = load_config(RunConfig, None, {"sim.base": "planar"})
FREE = RunConfig()


@pytest.fixture(scope="module")
def tables():
    return condense(*resolve(FREE, go1.PARAMS))


@pytest.fixture(scope="module")
def free():
    return compiled(FREE)


def compiled(config):
    controller = build_controller(controller_spec(config))
    return controller._replace(
        init=jax.jit(controller.init), plan=jax.jit(controller.plan), act=jax.jit(controller.act)
    )


@pytest.mark.parametrize(("yaw", "shift"), [(0.0, (3.0, -2.0)), (1.0, (0, 0)), (-2.8, (-1.0, 4.0))])
def test_neither_place_nor_heading_at_the_start_matters(free, tables, yaw, shift):
    history = [disturbed(seed) for seed in range(3)]
    ours, _ = torques(free, tables, history)
    theirs, _ = torques(free, tables, [seen_from(o, yaw, shift) for o in history])
    assert np.abs(ours).max() > 5.0
    # No position enters; turning the vectors rounds them, times gains of up to 1e4.
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_a_turn_after_the_start_is_turned_back(free, tables):
    """Yawed to the left, then to the right: the moment of the stance feet on the trunk opposes."""
    level = disturbed(0, planar=True)._replace(base_ang_vel=jnp.zeros(3), contact=jnp.ones(4, bool))
    # What the friction cone leaves of it is tested in tests/legs/test_lateral.py.
    tables = with_params(tables, lateral=tables.params.lateral._replace(friction=jnp.full(3, 1e6)))
    for turned in (0.1, -0.1):
        state = free.init(tables, level)
        state, _ = free.plan(tables, state, level)
        there = seen_from(level, turned, (0.0, 0.0))
        turned_back, straight = (
            yaw_moment(seen, free.act(tables, state, seen)[1].torque, state.stance)
            for seen in (there, level)
        )
        moment = turned_back - straight
        # -20 N m/rad on 0.1 rad; two feet on a line give it but for the forces' own weight.
        assert moment == pytest.approx(-20.0 * turned, abs=0.4)


def yaw_moment(observation, torque, stance):
    """Yaw moment of the stance feet about the vertical through the trunk."""
    forces, arms = pressed(observation, torque, stance)
    return np.sum(arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0])


def pressed(observation, torque, stance):
    """Forces on the stance feet, world frame, and their arms, by MuJoCo's Jacobians."""
    spec = mujoco.MjSpec.from_string(go1.MJCF.read_text(encoding="utf-8"))
    spec.body("trunk").add_freejoint(name="root")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7] = observation.base_pos, observation.base_quat
    data.qpos[7:] = np.asarray(observation.joint_pos).reshape(-1)
    mujoco.mj_forward(model, data)
    forces, arms = [], []
    for leg in np.flatnonzero(stance):
        J = np.zeros((3, model.nv))
        foot = model.geom(f"{Leg(leg).name}_foot").id
        mujoco.mj_jacGeom(model, data, J, None, foot)
        forces.append(-np.linalg.solve(J[:, 6 + 3 * leg : 9 + 3 * leg].T, np.asarray(torque)[leg]))
        arms.append(data.geom_xpos[foot] - data.subtree_com[model.body("trunk").id])
    return np.array(forces), np.array(arms)


@pytest.mark.parametrize("tilt", [(0.0, 0.15, 0.0), (0.0, 0.0, 0.2), (0.1, -0.1, -0.1)])
def test_a_planned_force_holds_in_the_world_while_the_trunk_turns(free, tables, tilt):
    """What the friction pyramid allows when it is planned it allows until the next plan."""
    inactive = with_params(
        tables,
        lateral=tables.params.lateral._replace(weights=jnp.zeros(6), friction=jnp.full(3, 1e6)),
    )
    level = disturbed(1, planar=True, scale=0.05)._replace(contact=jnp.ones(4, bool))
    state, _ = free.plan(inactive, free.init(inactive, level), level)
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, np.array(tilt), "xyz")
    seen = level._replace(base_quat=jnp.asarray(quat))
    state, joints = free.act(inactive, state, seen)
    forces, _ = pressed(seen, joints.torque, state.stance)
    planned = np.asarray(state.force)[np.asarray(state.stance)]
    assert (planned[:, 2] > 10.0).all()
    np.testing.assert_allclose(forces, planned, rtol=0, atol=1e-9)


def test_without_a_regulator_a_planar_state_gives_the_planar_controller_s_torques(free, tables):
    inactive = with_params(
        tables,
        lateral=tables.params.lateral._replace(weights=jnp.zeros(6), friction=jnp.full(3, 1e6)),
    )
    history = [disturbed(seed, planar=True, scale=0.05) for seed in range(3)]
    ours, state = torques(free, inactive, history)
    assert (np.asarray(state.force)[[0, 3], 2] > 10.0).all()  # feet that need not pull
    theirs, flat = torques(compiled(PLANAR), tables, history)
    # Thigh and calf everywhere; abduction where the leg swings: in stance the planar robot's is
    # held, the free one's carries its share.  Rounding times gains, and the QP's tolerance.
    np.testing.assert_allclose(ours[..., 1:], theirs[..., 1:], rtol=0, atol=1e-3)
    swinging = ~np.asarray(state.stance)
    assert swinging.tolist() == [False, True, True, False]
    np.testing.assert_allclose(ours[:, swinging], theirs[:, swinging], rtol=0, atol=1e-3)
    np.testing.assert_allclose(state.force, flat.force, rtol=0, atol=1e-3)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_state_keeps_its_tree_shapes_and_types(dtype):
    controller = build_controller(controller_spec(FREE))
    tables = condense(*resolve(FREE, go1.PARAMS), dtype=dtype)
    observation = disturbed(0, dtype=dtype)
    state = jax.eval_shape(controller.init, tables, observation)
    planned, _ = jax.eval_shape(controller.plan, tables, state, observation)
    acted, joints = jax.eval_shape(controller.act, tables, planned, observation)
    chex.assert_trees_all_equal_shapes_and_dtypes(state, planned, acted)
    assert all((part.shape, part.dtype) == ((4, 3), dtype) for part in joints)
    assert state.swing.lift_off.shape == (4, 3)


def test_single_precision_agrees_with_double(free, tables):
    single = condense(*resolve(FREE, go1.PARAMS), dtype=jnp.float32)
    double, _ = torques(free, tables, [disturbed(1)])
    # Far from the origin float32 resolves 2e-7 m of a place, times 3e4 N/m of gain: 0.02 N.
    half, _ = torques(free, single, [disturbed(1, dtype=jnp.float32)])
    assert half.dtype == np.float32
    np.testing.assert_allclose(half, double, rtol=0, atol=0.05)


@pytest.mark.parametrize("field", ["base_quat", "joint_vel"])
def test_a_non_finite_observation_is_reported_and_spreads_nowhere(free, tables, field):
    good = disturbed(0)
    state, _ = free.plan(tables, free.init(tables, good), good)
    values = getattr(good, field)
    broken = good._replace(**{field: jnp.full_like(values, jnp.nan)})
    state, info = free.plan(tables, state, broken)
    assert int(info.status) == qp.Status.NON_FINITE
    state, joints = free.act(tables, state, broken)
    np.testing.assert_array_equal(joints.torque, 0.0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    state, info = free.plan(tables, state, good)
    assert int(info.status) == qp.Status.SOLVED


def test_the_heading_to_keep_is_that_of_the_first_valid_sample(free, tables):
    good = seen_from(disturbed(0), 2.0, (0.0, 0.0))
    state = free.init(tables, good._replace(base_quat=jnp.full(4, jnp.nan)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    state, info = free.plan(tables, state, good)
    assert int(info.status) == qp.Status.SOLVED
    ours = free.init(tables, good)
    np.testing.assert_allclose(state.track, ours.track, rtol=0, atol=1e-12)
    again, _ = free.plan(tables, state, seen_from(good, 0.3, (0.0, 0.0)))
    np.testing.assert_array_equal(again.track, state.track)


def test_the_gradient_through_act_is_finite_on_the_free_base(tables, free):
    """Swing legs press with nothing, where a root has no derivative."""
    seen = disturbed(0)
    state, _ = free.plan(tables, free.init(tables, seen), seen)

    def cost(tables, seen):
        return jnp.sum(free.act(tables, state, seen)[1].torque ** 2)

    slopes = jax.jit(jax.grad(cost, (0, 1), allow_int=True))(tables, seen)
    for leaf in jax.tree.leaves(slopes):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.isfinite(leaf).all()
