"""Batches in C MuJoCo against single runs: the same physics to the last bit, the same loop."""

import dataclasses

import mujoco
import numpy as np
import pytest

from kjax.config import RunConfig, load_config
from kjax.robots import go1
from kjax.sim.batching import scene_models
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.metrics import metrics
from kjax.sim.observe import find_addresses
from kjax.sim.resolve import (
    batch_spec,
    resolve_episode,
    resolve_episodes,
    resolve_goal,
    start_state,
)

pytestmark = pytest.mark.slow

COMMON = {
    "sim.base": "planar",
    "duration": 0.6,
    "sim.contacts": "feet",
    "terrain.kind": "paper",
    "terrain.count": 3,
    "terrain.start": 0.4,
    "terrain.end": 0.7,
}
SUMMED = (
    "velocity_rmse_mps", "velocity_reference_rmse_mps", "height_mean_m", "height_min_m",
    "height_max_m", "pitch_max_deg", "torque_max_nm", "torque_saturation_fraction",
    "abduction_saturation_fraction", "thigh_saturation_fraction", "knee_saturation_fraction",
)  # fmt: skip
OWN = (
    {},
    {"command.v_x": [0.3, 0.3, 0.3, 0.3, 0.3], "terrain.seed": 3},
    {"push.times": [0.1], "push.forward": 4.0, "sim.friction": 0.6, "terrain.height_max": 0.09},
    {"sim.payload": 2.0, "sim.delay": 0.005, "lmpc.body_height": 0.5869},
    {"noise.position": 0.0, "seed": 7},
)


@pytest.fixture(scope="module")
def configs():
    return [
        dataclasses.replace(load_config(RunConfig, None, COMMON | own), seed=i)
        for i, own in enumerate(OWN)
    ]


@pytest.fixture(scope="module")
def engine(configs):
    return BatchEngine(batch_spec(configs[0]), dtype=np.float64, threads=2)


@pytest.fixture(scope="module")
def held(configs):
    return BatchEngine(batch_spec(configs[0]), torques="held", threads=2)


@pytest.fixture(scope="module")
def recording(engine, configs):
    return engine.run(resolve_episodes(configs))


@pytest.fixture(scope="module")
def held_recording(held, configs):
    return held.run(resolve_episodes(configs))


def test_physics_is_that_of_single_robots_to_the_last_bit(held, held_recording, configs):
    """Held torques are recorded whole, so a plain loop over ``mj_step`` can repeat them."""
    actuators = find_addresses(go1.ROBOT, held.model).actuator.reshape(-1)
    for i, config in enumerate(configs):
        (model,) = scene_models(go1.ROBOT, held.model, [resolve_episode(config)])
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start_state(config, model)
        mujoco.mj_forward(model, data)
        trunk = model.body("trunk").id
        delay = round(config.sim.delay / 0.005)
        for tick in range(int(held_recording.ticks[i])):
            np.testing.assert_array_equal(data.qpos, held_recording.qpos[tick, i])
            np.testing.assert_array_equal(data.qvel, held_recording.qvel[tick, i])
            torque = held_recording.torque[tick - delay, i] if tick >= delay else 0.0
            data.ctrl[actuators] = torque
            pushed = any(t <= tick * 0.005 + 1e-9 < t + 0.1 for t in config.push.times)
            data.xfrc_applied[trunk, 0] = 40.0 if pushed else 0.0  # 4 N s in 0.1 s
            mujoco.mj_step(model, data, 5)


def test_closed_loops_are_those_of_single_runs(recording, configs):
    single = MujocoEngine(batch_spec(configs[0]))
    for i, config in enumerate(configs):
        alone = simulate(single, resolve_episode(config))
        assert not alone.fell
        # 1e-6: equal algorithms; a batch sums in another order, and contacts amplify that.
        np.testing.assert_allclose(recording.qpos[:, i], alone.qpos[::5], atol=1e-6)
        own = recording.trajectory(i)
        np.testing.assert_allclose(own.x, alone.x[::5], atol=1e-6)
        np.testing.assert_allclose(own.torque, alone.torque[::5], atol=1e-3)
        np.testing.assert_array_equal(own.stance, alone.stance[::5])
        np.testing.assert_allclose(own.velocity_reference, alone.velocity_reference[::5])
        few, many = list(recording.metrics())[i], metrics(alone, resolve_goal(config))
        assert set(many) - set(few) == {
            "plan_ms_median", "plan_ms_p99", "act_ms_median", "act_ms_p99", "realtime_factor"
        }  # fmt: skip
        assert_metrics_of_the_physics_rate(few, many)


def assert_metrics_of_the_physics_rate(of_batch, of_single):
    """What is summed between the samples of a batch is what a single run sees at every step."""
    for name in SUMMED:
        # 1e-5: that of the walks, 1e-6 in x, against RMSE of 0.02 and heights of 0.25.
        assert of_batch[name] == pytest.approx(of_single[name], rel=1e-5, abs=1e-9), name
    # The path in a step is its length on one side, speed times step on the other: 0.3 % apart.
    assert of_batch["foot_slip_m"] == pytest.approx(of_single["foot_slip_m"], rel=0.01)
    assert of_batch["distance_m"] == pytest.approx(of_single["distance_m"], abs=5e-3)


def test_metrics_between_the_samples_count_on_the_free_base_as_well():
    keys = {"sim.base": "free", "duration": 1.0, "sim.contacts": "feet"}
    keys |= {"lmpc.friction": np.inf, "lmpc.torque_fraction": np.inf}
    config = load_config(RunConfig, None, keys | {"command.v_x": [0.3] * 5})
    episode = resolve_episode(config)
    batch = BatchEngine(episode.spec, torques="held", dtype=np.float64, threads=1).run([episode])
    alone = simulate(MujocoEngine(episode.spec, torques="held"), episode)
    of_batch, of_single = next(batch.metrics()), metrics(alone, episode.goal)
    assert_metrics_of_the_physics_rate(of_batch, of_single)
    # At its samples alone a batch sees too little, here 5 % of the slip.
    sampled = metrics(batch.trajectory(0), episode.goal)
    assert sampled["foot_slip_m"] < 0.97 * of_single["foot_slip_m"]


def test_held_torques_walk_like_those_of_every_step(recording, held_recording):
    assert not held_recording.fell.any()
    apart = np.abs(recording.log.x[-1, :, 0] - held_recording.log.x[-1, :, 0])
    # The place after 0.6 s: over 12 seeds at most 1 mm, but for the robot at 0.3 m/s that meets its
    # block (7 to 15 mm) and the loaded one, whose torques come a tick late (11 mm).
    assert (apart < [0.002, 0.02, 0.002, 0.015, 0.002]).all()


def test_a_robot_that_falls_leaves_its_neighbours_as_they_are(held, held_recording, configs):
    thrown = dataclasses.replace(
        configs[2], push=dataclasses.replace(configs[2].push, forward=80.0)
    )
    other = held.run(resolve_episodes([*configs[:2], thrown, *configs[3:]]))
    assert other.fell.tolist() == [False, False, True, False, False]
    assert 20 < other.ticks[2] < 120
    assert len(other.trajectory(2).time) == other.ticks[2]
    for i in (0, 1, 3, 4):
        np.testing.assert_array_equal(other.qpos[:, i], held_recording.qpos[:, i])


def test_numbers_that_are_none_end_one_robot_only(held, held_recording, configs):
    """A state that is not a number, from the first tick on, is a fall."""
    episodes = resolve_episodes(configs)
    nowhere = episodes[1].start._replace(pose=np.nan * episodes[1].start.pose)
    episodes[1] = dataclasses.replace(episodes[1], start=nowhere)
    other = held.run(episodes)
    assert other.fell.tolist() == [False, True, False, False, False]
    assert other.ticks[1] == 1
    np.testing.assert_array_equal(other.qpos[:, 4], held_recording.qpos[:, 4])


def test_it_says_which_episode_does_not_fit(engine, held, configs):
    with pytest.raises(ValueError, match=r"episodes\[1\] needs another engine"):
        engine.run(
            resolve_episodes(
                [configs[0], load_config(RunConfig, None, COMMON | {"lmpc.horizon": 7})]
            )
        )
    with pytest.raises(ValueError, match=r"episodes\[1\] takes 1\.0 s"):
        engine.run(resolve_episodes([configs[0], dataclasses.replace(configs[0], duration=1.0)]))
    late = dataclasses.replace(configs[0], sim=dataclasses.replace(configs[0].sim, delay=0.003))
    with pytest.raises(ValueError, match=r"sim\.delay must be a multiple of lmpc\.control_dt"):
        held.run(resolve_episodes([late]))
    with pytest.raises(ValueError, match="at least one episode"):
        engine.run([])
    with pytest.raises(TypeError, match=r"episodes\[0\]: wanted an Episode .* got RunConfig"):
        engine.run(configs)
    with pytest.raises(ValueError, match="torques must be"):
        BatchEngine(batch_spec(configs[0]), torques="often")
