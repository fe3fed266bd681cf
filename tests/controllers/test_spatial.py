"""The plan in three dimensions: frames, derivative, batch, and walks in C MuJoCo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_robot import disturbed, seen_from, torques

from kjax import RunConfig, build_controller, load_config, qp
from kjax.config import ConfigError
from kjax.controllers.params import condense, with_params
from kjax.controllers.resolve import controller_spec, resolve
from kjax.controllers.walkable import check_walkable
from kjax.robots import go1
from kjax.sim import free_base
from kjax.sim.engines.mujoco import MujocoEngine
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.resolve import batch_spec, resolve_episode

# Ahead, to the left and turning at once, then back on the spot.
OMNI = {
    "controller": "spatial",
    "sim.base": "free",
    "sim.contacts": "feet",
    "gaits.trot.period": 0.4,
    "gait.also": [],
    "duration": 4.0,
    "command.times": [0.0, 0.5, 2.5],
    "command.v_x": [0.0, 0.4, 0.0],
    "command.v_y": [0.0, 0.2, 0.0],
    "command.yaw_rate": [0.0, 1.0, -1.0],
}


@pytest.fixture(scope="module")
def config():
    return load_config(RunConfig, None, OMNI)


@pytest.fixture(scope="module")
def spatial(config):
    controller = build_controller(controller_spec(config))
    return controller._replace(
        init=jax.jit(controller.init), plan=jax.jit(controller.plan), act=jax.jit(controller.act)
    )


@pytest.fixture(scope="module")
def tables(config):
    return condense(*resolve(config, go1.PARAMS))


@pytest.fixture(scope="module")
def walk(config):
    return MujocoEngine(batch_spec(config)).run([resolve_episode(config)])


@pytest.mark.parametrize(("yaw", "shift"), [(1.0, (0, 0)), (-2.8, (-1000.0, 400.0))])
def test_neither_place_nor_heading_at_the_start_matters(spatial, tables, yaw, shift):
    history = [disturbed(seed) for seed in range(3)]
    ours, _ = torques(spatial, tables, history)
    theirs, _ = torques(spatial, tables, [seen_from(o, yaw, shift) for o in history])
    assert np.abs(ours).max() > 5.0
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)  # the QP's tolerance


def test_after_a_push_the_reference_is_no_further_ahead_than_its_slack(spatial, tables):
    seen = disturbed(0, scale=0.0)._replace(contact=jnp.ones(4, bool))
    still = with_params(tables, command=tables.params.command.hold())
    state = spatial.init(still, seen)
    slack = float(tables.params.spatial.velocity_slack)
    for pushed, ahead in (((-1.2, 0.9, 0.0), (slack, -slack)), ((0.3, -0.2, 0.0), (-0.3, 0.2))):
        hit = seen._replace(base_vel=jnp.asarray(pushed))
        planned, info = spatial.plan(still, state, hit)
        came, wanted = (np.asarray(values)[9:11] for values in (info.x, info.reference))
        np.testing.assert_allclose(wanted - came, ahead, atol=0.01)
        assert np.isfinite(planned.force).all()


def test_integral_action_does_not_wind_up_in_a_step(spatial, tables):
    seen = disturbed(0, scale=0.0)._replace(contact=jnp.ones(4, bool))
    still = with_params(tables, command=tables.params.command.hold())
    rate, limit = np.asarray(tables.params.spatial.integral)[:, 0]
    for speed, counts in ((0.05, 0.05), (1.0, 0.25 * limit)):
        moving = seen._replace(base_vel=jnp.asarray([speed, 0.0, 0.0]))
        state = spatial.init(still, moving)
        there, _ = spatial.plan(still, state._replace(velocity=jnp.zeros(3)), moving)
        np.testing.assert_allclose(
            np.asarray(there.correction)[0], -0.005 * rate * counts, rtol=0.05
        )
        left = state._replace(velocity=jnp.asarray([1.0, 0.0, 0.0]))  # on its way to standing
        coming, _ = spatial.plan(still, left, moving)
        assert not np.asarray(coming.correction).any()


def test_a_gaits_own_weights_go_before_the_others():
    own = {
        "controller": "spatial", "sim.base": "free", "gait.names": ["trot", "bound"],
        "gait.times": [0.0, 1.0], "gait.also": [],
        "gaits.bound.attitude": [1.0, 2.0, 3.0], "spatial.attitude": [4.0, 5.0, 6.0],
    }  # fmt: skip
    _, params = resolve(load_config(RunConfig, None, own))
    np.testing.assert_array_equal(params.spatial.weights.attitude, [[4, 5, 6], [1, 2, 3]])


def test_standing_feet_carry_the_weight_and_undo_what_the_body_does(spatial, tables):
    seen = disturbed(0, scale=0.0)._replace(contact=jnp.ones(4, bool))
    still = with_params(tables, command=tables.params.command.hold())

    def force(**changes):
        observation = seen._replace(**{k: jnp.asarray(v) for k, v in changes.items()})
        state, info = spatial.plan(still, spatial.init(still, observation), observation)
        assert int(info.status) == qp.Status.SOLVED
        return np.asarray(state.force), np.asarray(state.stance)

    rest, stance = force()
    assert stance.tolist() == [True, False, False, True]
    assert not rest[~stance].any()
    assert rest[:, 2].sum() == pytest.approx(12.743 * 9.81, rel=0.05)
    assert (force(base_vel=[0.2, 0.0, 0.0])[0] - rest)[:, 0].sum() < -5.0
    assert (force(base_vel=[0.0, 0.2, 0.0])[0] - rest)[:, 1].sum() < -5.0
    turning = force(base_ang_vel=[0.0, 0.0, 0.5])[0] - rest
    arms = np.array([[0.19, -0.13], [0.0, 0.0], [0.0, 0.0], [-0.19, 0.13]])
    assert (arms[:, 0] * turning[:, 1] - arms[:, 1] * turning[:, 0]).sum() < -0.5


def test_planned_forces_keep_to_the_joints_torques(spatial, tables):
    own = tables.params.spatial
    falling = disturbed(2)._replace(base_vel=jnp.array([0.3, 0.1, -0.8]))

    def largest(limit):
        limits = own.limits._replace(torque=jnp.full(3, limit))
        limited = with_params(tables, spatial=own._replace(limits=limits))
        state, info = spatial.plan(limited, spatial.init(limited, falling), falling)
        assert int(info.status) == qp.Status.SOLVED
        _, joints = spatial.act(limited, state, falling)
        return np.abs(np.asarray(joints.torque)[np.asarray(state.stance)]).max()

    free = largest(1e6)
    assert largest(0.8 * free) == pytest.approx(0.8 * free, rel=1e-4)


def test_a_batch_equals_single_robots(spatial, tables):
    robots = [disturbed(seed) for seed in range(3)]
    plans = [spatial.plan(tables, spatial.init(tables, o), o)[0].force for o in robots]
    together = jax.tree.map(lambda *a: jnp.stack(a), *robots)
    states = jax.vmap(lambda o: spatial.init(tables, o))(together)
    batch, _ = jax.jit(jax.vmap(spatial.plan, (None, 0, 0)))(tables, states, together)
    np.testing.assert_allclose(batch.force, np.stack(plans), atol=1e-6)


def test_the_derivatives_of_a_plan_by_state_and_weights_are_those_of_differences(spatial, tables):
    seen = disturbed(4)
    state = spatial.init(tables, seen)
    state, _ = spatial.plan(tables, state, seen)

    own = tables.params.spatial

    def pressed(change):
        """Of changes of the velocity, and of the logarithms of five kinds of weights."""
        faster = seen._replace(base_vel=seen.base_vel + change[:3])
        factors = jnp.exp(change[3:])
        weights = type(own.weights)(*(w * f for w, f in zip(own.weights, factors, strict=True)))
        changed = with_params(tables, spatial=own._replace(weights=weights))
        force = spatial.plan(changed, state, faster)[0].force
        return (force * jnp.arange(12.0).reshape(4, 3)).sum()

    got = jax.jit(jax.grad(pressed))(jnp.zeros(8))
    for axis, step in enumerate(1e-5 * np.eye(8)):
        wanted = (pressed(jnp.asarray(step)) - pressed(jnp.asarray(-step))) / 2e-5
        np.testing.assert_allclose(got[axis], wanted, rtol=1e-3)


def test_it_goes_where_it_is_told_in_c_mujoco(walk):
    assert not walk.fell[0]
    run = walk.trajectory(0)
    assert (run.plan_status == qp.Status.SOLVED).all()
    roll, pitch, yaw = free_base.attitude(run.qpos)
    heading = np.unwrap(yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    v_x, v_y = c * run.qvel[:, 0] + s * run.qvel[:, 1], c * run.qvel[:, 1] - s * run.qvel[:, 0]
    going = (run.time > 1.3) & (run.time < 2.5)  # three cycles
    np.testing.assert_allclose([v_x[going].mean(), v_y[going].mean()], [0.4, 0.2], atol=0.05)
    rate = np.polyfit(run.time[going], heading[going], 1)[0]
    assert rate == pytest.approx(1.0, abs=0.03)
    back = run.time > 3.2
    assert np.polyfit(run.time[back], heading[back], 1)[0] == pytest.approx(-1.0, abs=0.05)
    np.testing.assert_allclose([v_x[back].mean(), v_y[back].mean()], 0.0, atol=0.05)
    assert np.degrees(np.abs(roll).max()) < 4.0
    assert np.degrees(np.abs(pitch).max()) < 4.0


def test_the_batch_engine_walks_it_alike(config, walk):
    engine = BatchEngine(batch_spec(config), dtype=np.float32, threads=2)
    batch = engine.run([resolve_episode(config, seed=seed) for seed in range(4)])
    assert not batch.fell.any()
    single = walk.trajectory(0).qpos[::5]
    # The first steps agree to float32; later the contacts' chaos is larger.
    np.testing.assert_allclose(batch.qpos[:40, 0], single[:40], atol=2e-3)


def test_a_planar_base_is_refused_and_a_planar_controller_refuses_to_turn():
    with pytest.raises(ConfigError, match=r"controller = 'spatial' needs sim\.base = 'free'"):
        load_config(RunConfig, None, OMNI | {"sim.base": "planar"})
    planar = load_config(RunConfig, None, OMNI | {"controller": "planar"})
    with pytest.raises(ValueError, match=r"command\.v_y: .* or set controller = 'spatial'"):
        check_walkable(planar, go1.PARAMS)
