"""The study in three dimensions: what it asks of the robots, measures and says."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from kjax.runs.batches import batch_key
from kjax.sim.resolve import batch_spec
from kjax.studies import spatial

QUICK = ["--quick", "--seeds", "2", "--robots", "2"]


@pytest.fixture
def walks(monkeypatch):
    """No physics: who climbs more than 20 degrees or 8 cm does not cross; counts episodes."""
    count = []

    def run(cache, configs, *, torques, dtype, measure, **more):
        assert len({batch_spec(config) for config in configs}) == 1
        for config in configs:
            key = batch_key(cache, config, torques, dtype, measure)
            if key not in cache:
                count.append(config)
                cache.add({key: row(config)})

    def row(config):
        terrain = config.terrain
        hard = abs(terrain.slope) > 20 or terrain.height_max > 0.08
        ok = terrain.kind == "flat" or not hard
        return {
            "fell": not ok, "crossed": ok, "qp_unsolved": 0, "path_error_max_m": 0.02,
            "roll_max_deg": 3.0, "errors": [0.01, 0.02, 0.03] if ok else None,
            "errors_of_cycles": [0.001, 0.002, 0.003], "tilt_p95_deg": [0.5, 1.0],
        }  # fmt: skip

    monkeypatch.setattr(spatial, "run_batch", run)
    monkeypatch.setattr(spatial.cli, "configure_jax", lambda **more: None)
    return count


def test_a_second_call_walks_nothing_again_and_the_numbers_are_those_of_the_runs(
    walks, tmp_path, monkeypatch
):
    options = ["--out", str(tmp_path), "--seeds", "2", "--robots", "3"]
    assert spatial.main(options) == 0
    walked = len(walks)
    assert walked == 2 * (len(spatial.COMMANDS) + sum(len(g.values) for g in spatial.GROUNDS)) + 3
    assert spatial.main(options) == 0
    assert len(walks) == walked
    record = json.loads((tmp_path / "results.json").read_text())
    assert [row["v_y_rmse_mps"] for row in record["commands"]] == [0.02] * len(spatial.COMMANDS)
    crossed = {(row["ground"], row["value"]): row["crossed"] for row in record["grounds"]}
    assert crossed["up", 20.0] == crossed["steps", 0.08] == 2
    assert crossed["down", 25.0] == crossed["tiles", 0.1] == 0
    assert record["random"]["falls"] == 0
    text = (tmp_path / "table.md").read_text()
    assert "0 of 3 fell" in text
    assert (
        spatial._title(record["grounds"])
    ) == "Every seed crosses slopes of up to 20 deg and steps and tiles of up to 8 cm"
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_random_commands_stay_in_their_range_and_last_two_to_five_seconds():
    configs = spatial.random_configs(SimpleNamespace(robots=50, quick=False))
    values = np.concatenate([np.stack(
        [c.command.v_x, c.command.v_y, c.command.yaw_rate], axis=-1) for c in configs])  # fmt: skip
    assert (np.abs(values) <= np.array(spatial.RANGE)).all()
    assert (np.abs(values).max(axis=0) > 0.9 * np.array(spatial.RANGE)).all()
    gaps = np.concatenate([np.diff(c.command.times[1:]) for c in configs])
    assert gaps.min() >= 1.99
    assert gaps.max() <= 5.01
    assert configs[0].command != configs[1].command


def test_a_part_that_does_not_exist_is_refused(capsys):
    with pytest.raises(SystemExit):
        spatial.main(["--parts", "stairs"])
    assert "commands, grounds, random" in capsys.readouterr().err


def test_errors_are_against_the_last_command_and_averaged_over_a_cycle():
    config = spatial.command_configs((0.5, 0.0, 1.0), SimpleNamespace(seeds=1, quick=False))[0]
    time = np.arange(0.0, 8.0, 0.005)
    qpos, qvel = np.zeros((len(time), 19)), np.zeros((len(time), 18))
    yaw = 1.1 * time
    qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    swing = 0.05 * np.sin(2 * np.pi * time / 0.4)  # within a cycle
    x = np.zeros((len(time), 6))
    x[:, 3] = 0.5 + swing
    qvel[:, :2] = 0.03 * np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)  # to the left
    run = SimpleNamespace(time=time, qpos=qpos, qvel=qvel, x=x, dt=0.005, fell=False)
    got = spatial.walked(run, config)
    np.testing.assert_allclose(got["errors"], [0.05 / np.sqrt(2), 0.03, 0.1], rtol=1e-3)
    np.testing.assert_allclose(got["errors_of_cycles"], [0.0, 0.03, 0.1], rtol=1e-3, atol=1e-9)
    assert spatial.walked(run.__class__(**vars(run) | {"fell": True}), config) == {"errors": None}
