"""The floor of the tracking error in closed form, and medians that leave out falls."""

import numpy as np
import pytest

from kjax.config import CommandConfig, RunConfig, load_config
from kjax.controllers.resolve import build_command
from kjax.sim.summary import summarise, tracking_floor


def test_a_step_costs_the_cube_of_its_height_over_three_accelerations():
    command = build_command(CommandConfig(times=(0.0, 2.0), v_x=(0.0, 0.6)))
    floor = tracking_floor(command, 4.0, start=0.5, end=8.0)
    assert floor == pytest.approx(np.sqrt(0.6**3 / 12.0 / 7.5), rel=1e-12)


@pytest.mark.parametrize("velocities", [(0.0, 3.0, -1.0), (1.0, 1.0, 2.5), (0.0, 0.1, 0.2)])
def test_the_floor_equals_the_error_of_a_robot_integrated_in_small_steps(velocities):
    """With steps that follow before the last one is made good, and a window that cuts one."""
    command = build_command(CommandConfig(times=(0.0, 0.3, 0.8), v_x=velocities))
    a, end, dt = 2.0, 1.2, 1e-5
    v, errors = velocities[0], []
    for i in range(round(end / dt)):
        wanted = velocities[np.searchsorted(command.times, i * dt + 1e-9) - 1]
        v += np.clip(wanted - v, -a * dt, a * dt)
        errors.append(wanted - v)
    rmse = np.sqrt(np.mean(np.square(errors[round(0.5 / dt) :])))
    # 1e-4: the steps of the integration
    assert tracking_floor(command, a, start=0.5, end=end) == pytest.approx(rmse, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "gentle", "hard"),
    [("trot_velocity", 0.0083, 0.0060), ("bound_velocity", 0.043, 0.031)],
)
def test_the_papers_profiles_have_the_floors_that_were_worked_out_by_hand(
    name, gentle, hard, repository
):
    config = load_config(RunConfig, repository / "configs" / f"{name}.toml")
    command = build_command(config.command)
    floors = [tracking_floor(command, a, end=config.duration) for a in (4.0, 0.8 * 9.81)]
    assert floors == pytest.approx([gentle, hard], abs=5e-4)  # digits given


def test_falls_are_counted_and_left_out_of_the_rest():
    results = [
        {"fell": False, "crossed": True, "pitch": 1.0, "realtime_factor": 3.0, "none": None},
        {"fell": False, "crossed": False, "pitch": -5.0, "realtime_factor": 2.0, "none": None},
        {"fell": True, "crossed": False, "pitch": 60.0, "realtime_factor": 1.0, "none": 1.0},
    ]
    assert summarise(results) == {
        "runs": 3,
        "falls": 1,
        "crossed": 1,
        "pitch": {"median": -2.0, "worst": -5.0, "n": 2},
        "realtime_factor": {"median": 2.5, "worst": 2.0, "n": 2},
    }
    assert summarise([results[2]]) == {"runs": 1, "falls": 1, "crossed": 0}
