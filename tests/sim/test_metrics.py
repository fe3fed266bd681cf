"""Names of metrics are known before anything walks."""

import numpy as np
import pytest

from kjax.config import RunConfig, load_config
from kjax.sim.metrics import metric_names, metrics, reference_velocity
from kjax.sim.resolve import resolve_goal

WALL = {"plan_ms_median", "plan_ms_p99", "act_ms_median", "act_ms_p99", "realtime_factor"}
SWITCH = {"gait.names": ["trot", "bound"], "gait.times": [0.0, 1.0]}


@pytest.mark.parametrize(
    ("keys", "seconds"),
    [
        ({}, 3.0),
        ({"duration": 0.3}, 0.3),
        ({"command.times": [0.0], "command.v_x": [0.1]}, 3.0),
        ({"sim.base": "free"}, 3.0),
        ({"terrain.kind": "paper"}, 3.0),
        (SWITCH, 3.0),
        ({**SWITCH, "sim.base": "free", "terrain.kind": "slope", "sim.contacts": "feet"}, 3.0),
    ],
)
def test_the_metrics_of_an_episode_are_those_that_its_config_names(standing_run, keys, seconds):
    config = load_config(RunConfig, None, {"duration": seconds, **keys})
    run = standing_run(config, seconds)
    if len(config.gait.times) > 1:
        run.gait = np.where(run.time < 1.0, 0, 1)
    assert set(metrics(run, resolve_goal(config))) - WALL == metric_names(resolve_goal(config))


def test_a_command_without_a_bound_on_its_rate_is_its_own_reference():
    keys = {"command.times": [0.0, 1.0], "command.v_x": [0.0, 0.6], "lmpc.command_slew": np.inf}
    goal = resolve_goal(load_config(RunConfig, None, keys))
    wanted = reference_velocity(np.array([0.0, 0.999, 1.0, 2.0]), goal)
    np.testing.assert_array_equal(wanted[:, 0], [0.0, 0.0, 0.6, 0.6])
    assert not wanted[:, 1:].any()
