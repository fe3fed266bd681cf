"""The spatial controller on slopes and steps that it cannot see, in C MuJoCo."""

import numpy as np
import pytest

from kjax import RunConfig, load_config, qp
from kjax.sim import free_base
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.metrics import metrics
from kjax.sim.resolve import batch_spec, resolve_episode, resolve_goal

WALK = {
    "controller": "spatial",
    "sim.base": "free",
    "gaits.trot.period": 0.4,
    "gait.also": [],
    "duration": 10.0,
    "command.times": [0.0, 0.5],
    "command.v_x": [0.0, 0.4],
    "terrain.start": 0.5,
    "terrain.end": 2.3,
    "terrain.width": 1.6,
}


def walk(engine, changes):
    config = load_config(RunConfig, None, WALK | changes)
    run = simulate(engine, resolve_episode(config, seed=3))
    return run, metrics(run, resolve_goal(config))


@pytest.fixture(scope="module")
def sloping():
    slope = {"terrain.kind": "slope", "terrain.slope": 15.0}
    return slope, MujocoEngine(batch_spec(load_config(RunConfig, None, WALK | slope)))


@pytest.mark.slow
@pytest.mark.parametrize("slope", [15.0, -15.0])
def test_the_trunk_lies_along_a_slope(sloping, slope):
    kind, engine = sloping
    run, result = walk(engine, kind | {"terrain.slope": slope})
    assert result["crossed"]
    assert (run.plan_status == qp.Status.SOLVED).all()
    _, pitch, _ = free_base.attitude(run.qpos)
    on_it = (run.x[:, 0] > 0.8) & (run.x[:, 0] < 1.0)
    assert np.degrees(pitch[on_it]).mean() == pytest.approx(slope, abs=1.5)
    assert result["roll_max_deg"] < 4.0
    assert result["path_error_max_m"] < 0.1


@pytest.mark.slow
def test_it_stays_level_where_that_is_asked_for(sloping):
    kind, engine = sloping
    run, result = walk(engine, kind | {"spatial.alignment": 0.0})
    assert result["crossed"]
    on_it = (run.x[:, 0] > 0.8) & (run.x[:, 0] < 1.0)
    _, pitch, _ = free_base.attitude(run.qpos)
    assert abs(np.degrees(pitch[on_it]).mean()) < 2.5


@pytest.mark.slow
def test_steps_that_it_does_not_see_are_climbed():
    steps = {
        "terrain.kind": "steps", "terrain.count": 4, "terrain.height_min": 0.07,
        "terrain.height_max": 0.07, "leg.swing_height": 0.3, "leg.hold_after": 0.6,
        "command.v_x": [0.0, 0.3],
    }  # fmt: skip
    engine = MujocoEngine(batch_spec(load_config(RunConfig, None, WALK | steps)))
    run, result = walk(engine, steps)
    assert not result["fell"]
    assert run.x[:, 1].max() > 0.27 + 0.12  # two steps up
    assert result["crossed"]
