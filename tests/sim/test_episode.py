"""Episodes are data: what is changed by hand counts, and a config in their place is refused."""

import dataclasses

import numpy as np
import pytest

from kjax.config import RunConfig, load_config
from kjax.robots import go1
from kjax.sim.engines.mujoco import MujocoEngine
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.metrics import metrics
from kjax.sim.resolve import batch_spec, resolve_episode, resolve_episodes, resolve_goal
from kjax.sim.scene import build_model

SHORT = {"sim.base": "planar", "duration": 0.02}


@pytest.fixture(scope="module")
def episode():
    return resolve_episode(load_config(RunConfig, None, SHORT))


def with_weights(episode, state_weights):
    modes = episode.controller.modes._replace(state_weights=state_weights)
    return dataclasses.replace(episode, controller=episode.controller._replace(modes=modes))


def test_the_controllers_key_follows_every_parameter_but_the_requests(episode):
    others = [
        resolve_episode(load_config(RunConfig, None, SHORT | keys))
        for keys in (
            {"seed": 3, "command.v_x": [0.3] * 5},
            {"sim.friction": 0.5, "push.times": [0.01], "push.forward": 2.0},
            {"lmpc.R": 0.1},
            {"leg.swing_kp": 0.5},
        )
    ]
    same = [other.controller_key == episode.controller_key for other in others]
    assert same == [True, True, False, False]


def test_parameters_changed_by_hand_get_another_key_in_place_too(episode):
    weights = 2.0 * np.asarray(episode.controller.modes.state_weights)
    changed = with_weights(episode, weights)
    before = changed.controller_key
    assert before != episode.controller_key
    assert with_weights(episode, 0.5 * weights).controller_key == episode.controller_key
    weights[0, 0] += 1.0
    assert with_weights(episode, weights).controller_key != before


def test_parameters_changed_by_hand_walk_otherwise_on_the_same_engine(episode):
    engine = MujocoEngine(episode.spec)
    heavy = with_weights(episode, 50.0 * np.asarray(episode.controller.modes.state_weights))
    plain, other, again = (engine.run([one]).qpos for one in (episode, heavy, episode))
    np.testing.assert_array_equal(again, plain)
    assert np.abs(other - plain).max() > 1e-6


def test_configs_that_differ_elsewhere_share_their_parameters():
    configs = [load_config(RunConfig, None, SHORT | {"seed": seed}) for seed in range(3)]
    first, *others = (one.controller.fits for one in resolve_episodes(configs))
    assert all(fits is first for fits in others)


def test_a_config_in_place_of_what_is_resolved_from_it_is_refused_by_name(episode):
    config = load_config(RunConfig, None, SHORT)
    for engine in (MujocoEngine, BatchEngine):
        with pytest.raises(TypeError, match=r"spec: wanted kjax\.sim\.resolve\.batch_spec\(config"):
            engine(config)
    with pytest.raises(TypeError, match=r"episodes\[0\]: wanted an Episode .* got RunConfig"):
        BatchEngine(batch_spec(config)).run([config])
    with pytest.raises(TypeError, match=r"goal: wanted .*resolve_goal\(config\), got RunConfig"):
        metrics(None, config)
    with pytest.raises(TypeError, match=r"scene: wanted the SceneSpec .* got SimConfig"):
        build_model(go1.ROBOT, config.sim)


def test_the_goal_of_an_episode_is_that_of_its_config(episode):
    config = load_config(RunConfig, None, SHORT)
    goal = resolve_goal(config)
    assert goal.scene == episode.goal.scene == episode.spec.scene
    np.testing.assert_array_equal(goal.heights, episode.controller.height)
    assert episode.ticks == 4


MESH = """v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""


def test_a_robots_meshes_are_found_beside_its_mjcf(tmp_path):
    text = go1.MJCF.read_text(encoding="utf-8")
    text = text.replace("<worldbody>", '<asset><mesh name="m" file="m.obj"/></asset><worldbody>', 1)
    (tmp_path / "robot.xml").write_text(text)
    (tmp_path / "m.obj").write_text(MESH)
    robot = dataclasses.replace(go1.ROBOT, mjcf=tmp_path / "robot.xml")
    scene = resolve_episode(load_config(RunConfig, None, SHORT)).spec.scene
    assert build_model(robot, scene).nmesh == 1


def test_a_trunk_that_there_is_not_is_named(episode):
    robot = dataclasses.replace(go1.ROBOT, trunk="torso")
    with pytest.raises(ValueError, match=r"robot 'go1': no body named 'torso', there are .*trunk"):
        build_model(robot, episode.spec.scene)
