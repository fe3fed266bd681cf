"""The closed loop where zero is elsewhere, on slopes, and with contact flags that lie."""

import dataclasses

import mujoco
import numpy as np
import pytest

from kjax.config import RunConfig, load_config
from kjax.sim import free_base
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.episode import initial_state
from kjax.sim.metrics import metrics
from kjax.sim.program import requests
from kjax.sim.resolve import (
    batch_spec,
    resolve_episode,
    resolve_episodes,
    resolve_goal,
)

WALK = {
    "duration": 1.2,
    "command.times": [0.0, 0.3],
    "command.v_x": [0.0, 0.3],
    "sim.contacts": "feet",
}
BOX = {"lmpc.friction": np.inf, "lmpc.torque_fraction": np.inf}
PLACES = [(0.0, 0.0), (10.0, 3.0), (1e3, -0.27), (1e4, -2.0)]  # m: start, floor


@pytest.mark.slow
def test_neither_the_place_nor_the_height_of_the_floor_matters():
    base = load_config(RunConfig, None, WALK | BOX | {"sim.base": "planar"})
    configs = [
        dataclasses.replace(base, sim=dataclasses.replace(base.sim, start=(x, 0.0), floor=z))
        for x, z in PLACES
    ]
    recording = BatchEngine(batch_spec(base), dtype=np.float64).run(resolve_episodes(configs))
    assert not recording.fell.any()
    x = recording.log.x
    for other in range(1, len(PLACES)):
        # MuJoCo's own positions round to 1e-12 m at 10 km; a few contacts later it is 1e-7.
        np.testing.assert_allclose(x[:, other], x[:, 0], rtol=0, atol=1e-5)
    assert x[-1, 0, 3] > 0.2


@pytest.mark.slow
def test_neither_place_nor_heading_matters_on_the_free_base():
    keys = {"noise.enabled": False, "sim.cone": "elliptic"}
    base = load_config(RunConfig, None, WALK | BOX | keys)
    starts = [(0.0, (0.0, 0.0), 0.0), (1.0, (0.0, 0.0), 0.0), (2.0, (1e3, -50.0), -0.27)]
    configs = [
        dataclasses.replace(
            base, sim=dataclasses.replace(base.sim, heading=yaw, start=start, floor=floor)
        )
        for yaw, start, floor in starts
    ]
    recording = BatchEngine(batch_spec(base), dtype=np.float64).run(resolve_episodes(configs))
    assert not recording.fell.any()
    for other in (1, 2):
        np.testing.assert_allclose(recording.log.x[:, other], recording.log.x[:, 0], atol=1e-5)


@pytest.fixture(scope="module")
def sloping():
    keys = {
        "duration": 10.0,
        "command.times": [0.0, 1.0],
        "command.v_x": [0.0, 0.3],
        "terrain.kind": "slope",
        "terrain.slope": 8.0,
        "terrain.start": 0.5,
        "terrain.end": 2.0,
        "lmpc.model_dt": 0.02,
        "lmpc.horizon": 10,
        "lmpc.Q": [1.815, 18.15, 50.0, 8.358, 4.179, 4.606],
        "leg.swing_height": 0.2347,
    }
    return keys, MujocoEngine(batch_spec(load_config(RunConfig, None, keys)))


@pytest.mark.slow
@pytest.mark.parametrize("slope", [8.0, -8.0])
def test_it_walks_up_and_down_a_slope(sloping, slope):
    keys, engine = sloping
    config = load_config(RunConfig, None, keys | {"terrain.slope": slope})
    result = metrics(simulate(engine, resolve_episode(config, seed=1)), resolve_goal(config))
    assert not result["fell"]
    assert result["crossed"]
    assert result["pitch_max_deg"] < 12.0


@pytest.fixture(scope="module")
def episode():
    keys = {"command.times": [0.0, 0.5], "command.v_x": [0.0, 0.3], "sim.base": "planar"}
    return resolve_episode(load_config(RunConfig, None, keys))


@pytest.fixture(scope="module")
def simulation(episode):
    return MujocoEngine(episode.spec)


FAULTS = {
    "stuck on": lambda force, rng: np.full(4, 100.0),
    "one stuck on": lambda force, rng: np.r_[100.0, force[1:]],
    "never on": lambda force, rng: np.zeros(4),
    "flickering": lambda force, rng: np.where(rng.random(4) < 0.1, 100.0 * (force < 5.0), force),
}


@pytest.mark.parametrize("name", FAULTS)
def test_contact_flags_that_lie_do_not_throw_the_robot(simulation, episode, name):
    """Flags come from the foot forces, which are replaced here; the physics knows the truth."""
    model, at = simulation.model, simulation.addresses
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = initial_state(episode.start, model, at)
    mujoco.mj_forward(model, data)
    noise = np.zeros(30)

    def sense():
        seen = data.sensordata.copy()
        seen[at.foot_force] = FAULTS[name](seen[at.foot_force], rng)
        return np.r_[data.qpos, data.qvel, seen, noise]

    program = simulation.program(episode)
    state, pitch = program.init(sense(), requests(episode)), []
    for step in range(3000):
        sensed = sense()
        if step % 5 == 0:
            state, _ = program.plan(state, sensed)
        state, torque = program.act(state, sensed)
        data.ctrl[:] = torque
        mujoco.mj_step(model, data)
        pitch.append(free_base.attitude(data.qpos)[1])
    assert data.subtree_com[model.body("trunk").id, 2] > 0.25
    assert np.degrees(np.abs(pitch[500:]).max()) < 4.0
    assert abs(data.qvel[0] - 0.3) < 0.1
