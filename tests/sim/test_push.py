"""Pushes: the impulse arrives, whole; impossible ones are refused. MJX: ``test_mjx.py``."""

import mujoco
import numpy as np
import pytest

from kjax import RunConfig, load_config
from kjax.config import ConfigError
from kjax.robots import go1
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.episode import push_at
from kjax.sim.resolve import batch_spec, resolve_episode, resolve_scene

DT = 0.001


def forces(steps, dt=DT, **keys):
    """Force (steps, 3) of each physics step."""
    config = {f"push.{key}": value for key, value in keys.items()}
    config |= {
        "sim.base": "free",
        "sim.sim_dt": dt,
        "leg.act_dt": 5 * dt,
        "lmpc.control_dt": 5 * dt,
    }
    _, episode = resolve_scene(load_config(RunConfig, None, config))
    return push_at(episode, np.arange(steps)[:, None])


def test_the_force_of_each_push_adds_up_to_its_impulse():
    force = forces(500, times=[0.1, 0.25], forward=[3.0, -1.0], lateral=2.0, duration=0.07)
    np.testing.assert_allclose(force.sum(axis=0) * DT, [2.0, 4.0, 0.0], atol=1e-12)
    acting = np.flatnonzero(force[:, 0])
    assert acting.tolist() == [*range(100, 170), *range(250, 320)]


def test_pushes_that_overlap_add_up_and_a_held_tick_gets_its_mean():
    force = forces(500, times=[0.1, 0.15], forward=[1.0, 2.0], duration=0.1)
    np.testing.assert_allclose(force[[99, 100, 149, 150, 199, 200, 249, 250], 0],
                               [0.0, 10.0, 10.0, 30.0, 30.0, 20.0, 20.0, 0.0])  # fmt: skip
    keys = {"push.times": [0.102], "push.forward": 1.0, "push.duration": 0.1}
    _, episode = resolve_scene(load_config(RunConfig, None, keys))
    # Two of five steps before it begins: 3/5 of 10 N.
    assert push_at(episode, 100, 5)[0] == pytest.approx(6.0)


def test_momentum_of_the_floating_robot_changes_by_the_impulse_whatever_its_joints_do():
    """Oracle: Newton's second law for the whole free robot, no gravity, no ground."""
    spec = mujoco.MjSpec.from_string(go1.MJCF.read_text(encoding="utf-8"))
    spec.body("trunk").add_freejoint()
    spec.option.gravity = [0.0, 0.0, 0.0]
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[3], data.qpos[7:] = 1.0, np.tile([0.0, 0.9, -1.8], 4)
    dt = model.opt.timestep
    steps = round(0.1 / dt) + 20
    for force in forces(steps, dt, times=[0.0], forward=3.0, lateral=-1.0, duration=0.1):
        data.ctrl[:] = 0.5  # internal torques
        data.xfrc_applied[model.body("trunk").id, :3] = force
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    mass = model.body_subtreemass[1]
    # 1e-3: implicitfast leaves out the change of Coriolis terms within a step
    np.testing.assert_allclose(mass * data.subtree_linvel[1], [3.0, -1.0, 0.0], atol=1e-3 * mass)


def test_a_push_speeds_the_walking_robot_up_and_it_walks_on():
    chosen = {
        "sim.base": "planar",
        "duration": 1.6,
        "command.times": [0.0],
        "command.v_x": [0.0],
    }
    chosen |= {"noise.enabled": False}
    calm = load_config(RunConfig, None, chosen)
    pushed = load_config(RunConfig, None, chosen | {"push.times": [0.5], "push.forward": 4.0})
    simulation = MujocoEngine(batch_spec(calm))
    runs = [simulate(simulation, resolve_episode(config)) for config in (calm, pushed)]
    np.testing.assert_array_equal(runs[0].x[:501], runs[1].x[:501])
    gain = runs[1].x[600, 3] - runs[0].x[600, 3]
    # The stance legs take back some of the impulse while it acts, and its share of 4 N s / 12.7 kg.
    assert 0.1 < gain < 4.0 / 12.743
    assert not runs[1].fell
    assert abs(runs[1].x[-300:, 3].mean()) < 0.1


def test_a_lateral_push_on_the_planar_robot_and_lists_of_two_lengths_are_refused():
    with pytest.raises(ConfigError, match=r"push\.lateral needs sim\.base = 'free'"):
        load_config(
            RunConfig, None, {"sim.base": "planar", "push.times": [1.0], "push.lateral": 2.0}
        )
    with pytest.raises(ConfigError, match=r"forward must be one number or as many as times"):
        load_config(RunConfig, None, {"push.times": [1.0], "push.forward": [2.0, 3.0]})
    with pytest.raises(ConfigError, match=r"push\.duration must be a whole multiple"):
        load_config(RunConfig, None, {"push.duration": 0.0015})
