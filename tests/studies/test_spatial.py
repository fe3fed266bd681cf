"""The study in three dimensions: what it asks of the robots, measures and says."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from kjax.runs.batches import batch_key
from kjax.sim.resolve import batch_spec
from kjax.studies.spatial import commands, grounds, limits, measures, report, study
from kjax.studies.spatial.cases import SpatialOptions


@pytest.fixture
def walks(monkeypatch):
    """No physics: who climbs more than 20 degrees or 8 cm does not cross; counts episodes."""
    count = []

    def run(cache, configs, *, torques, dtype, engine, measure, **more):
        assert len({batch_spec(config) for config in configs}) == 1
        for config in configs:
            key = batch_key(cache, config, torques, dtype, measure, engine)
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
            "reached": [1.19, 0.0, 2.0], "tilt_max_deg": [1.0, 2.0],
            "peaks_deg": [[1.0, 2.0], [1.0, 12.0]], "velocity_rmse_mps": 0.01,
            "pitch_p95_deg": 1.0, "roll_p95_deg": 0.5,
        }  # fmt: skip

    monkeypatch.setattr(study, "run_batch", run)
    monkeypatch.setattr(study.cli, "configure_jax", lambda **more: None)
    return count


def test_a_second_call_walks_nothing_again_and_the_numbers_are_those_of_the_runs(walks, tmp_path):
    options = ["--out", str(tmp_path), "--seeds", "2", "--robots", "3"]
    options += ["--parts", "commands", "grounds", "random"]
    assert study.main(options) == 0
    walked = len(walks)
    cells = len(commands.COMMANDS) + sum(len(g.values) for g in grounds.GROUNDS)
    assert walked == 2 * cells + 2 * 3
    assert study.main(options) == 0
    assert len(walks) == walked
    record = json.loads((tmp_path / "results.json").read_text())["parts"]
    assert [row["v_y_rmse_mps"] for row in record["commands"]] == [0.02] * len(commands.COMMANDS)
    crossed = {(row["ground"], row["value"]): row["crossed"]["count"] for row in record["grounds"]}
    assert crossed["up", 20.0] == crossed["steps", 0.08] == 2
    assert crossed["down", 25.0] == crossed["tiles", 0.1] == 0
    assert record["random"]["playground"]["falls"]["count"] == 0
    assert "| ±1, ±0.4, ±1.5 | 3 | 0 |" in (tmp_path / "table.md").read_text()
    assert (
        report._ground_title(record["grounds"])
    ) == "Every seed crosses slopes of up to 20 deg and steps and tiles of up to 8 cm"
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_a_quick_call_goes_through_every_part(walks, tmp_path, monkeypatch):
    lap = {"fell": False, "path_error_m": 0.01, "v_x_rmse_mps": 0.02}
    circle = dataclasses.replace(study.PARTS["laps"], walk=lambda config: lap)
    monkeypatch.setitem(study.PARTS, "laps", circle)
    assert study.main(["--out", str(tmp_path), "--quick"]) == 0
    record = json.loads((tmp_path / "results.json").read_text())["parts"]
    assert list(record) == list(study.PARTS)
    assert record["speeds"][0]["held"]["count"] == 2  # 1.19 m/s where 1.2 were asked for
    assert record["laps"]["path_error_worst_m"] == 0.01
    assert record["switches"]["above_largest_deg"] == 0.0
    text = (tmp_path / "table.md").read_text()
    assert "trot, the paper's profile" in text
    assert "this is no result" in text


def test_random_commands_stay_in_their_range_and_last_two_to_five_seconds():
    configs = commands.random_configs("own", SpatialOptions(robots=50))
    values = np.concatenate([np.stack(
        [c.command.v_x, c.command.v_y, c.command.yaw_rate], axis=-1) for c in configs])  # fmt: skip
    own = np.array(commands.RANGES["own"])
    assert (np.abs(values) <= own).all()
    assert (np.abs(values).max(axis=0) > 0.9 * own).all()
    gaps = np.concatenate([np.diff(c.command.times[1:]) for c in configs])
    assert gaps.min() >= 1.99
    assert gaps.max() <= 5.01
    assert configs[0].command != configs[1].command


def test_pushes_come_from_all_sides_at_all_phases_with_one_strength():
    args = SpatialOptions(seeds=3)
    configs = limits.push_configs("bound", 10.0, args)
    assert len(configs) == 8 * 8 * 3
    forces = np.array([(c.push.forward, c.push.lateral) for c in configs])
    np.testing.assert_allclose(np.hypot(*forces.T), 10.0)
    turns = np.unique(np.degrees(np.arctan2(forces[:, 1], forces[:, 0])).round() % 360)
    np.testing.assert_array_equal(turns, limits.DIRECTIONS)
    begins = np.unique([c.push.times[0] for c in configs])
    assert len(begins) == 8
    assert begins[-1] - begins[0] < configs[0].gaits["bound_multiphase"].period
    # Seeds of one push lie side by side.
    assert [c.seed for c in configs[:4]] == [0, 1, 2, 0]
    assert configs[0].push == configs[2].push != configs[3].push


def test_the_strongest_push_is_that_of_the_weakest_phase_with_all_weaker_ones():
    whole = np.ones((8, 8))
    sideways = whole.copy()
    sideways[2, 5] = 0.9  # one phase of one direction
    rows = [
        {"gait": "trot", "impulse_Ns": impulse, "stands": stands.tolist()}
        for impulse, stands in ((20.0, whole), (10.0, whole), (15.0, sideways))
    ]
    least, each = limits.strongest(rows, "trot")
    assert least == 10.0
    np.testing.assert_array_equal(each, [20.0, 20.0, 10.0, 20.0, 20.0, 20.0, 20.0, 20.0])


def test_the_fastest_is_held_by_every_seed_and_no_slower_one_saw_a_fall():
    rows = [
        {"gait": "trot", "asked": speed, "held": {"count": count, "episodes": 4}, "falls": falls}
        for speed, count, falls in ((1.2, 4, 0), (1.4, 3, 0), (1.6, 4, 0), (1.8, 3, 1), (2.0, 4, 0))
    ]
    assert limits.fastest(rows, "trot")["asked"] == 1.6
    assert limits.fastest(rows[-2:], "trot") is None
    assert limits.fastest(rows, "bound") is None


def test_peaks_after_a_switch_are_above_the_larger_of_both_gaits_alone():
    args = SpatialOptions(quick=True)
    peaks = iter([[[9.0, 3.0], [2.0, 15.0]], [[1.0, 1.0]] * 2, [[2.0, 14.0]] * 2] for _ in range(2))
    runs = list(zip(*peaks, strict=True))
    number = iter(range(3))

    def done(configs):
        return [{"fell": False, "peaks_deg": one} for one in runs[next(number)]]

    found = limits._switches_summary(args, done)
    assert found["above_largest_deg"] == 7.0  # roll: 9 where the bound has 2
    assert found["peak_largest_deg"] == 15.0


def test_phases_of_the_switches_cover_a_cycle():
    configs = limits.switch_configs(("trot", "bound", "trot"), SpatialOptions())
    first = np.array([c.gait.times[1] for c in configs])
    assert len(np.unique(first)) == limits.SWITCH_PHASES
    assert first.max() - first.min() == pytest.approx(0.4 * 63 / 64, abs=1e-3)
    second = np.array([c.gait.times[2] for c in configs])
    period = configs[0].gaits["bound_multiphase"].period
    assert second.max() - second.min() == pytest.approx(period * 63 / 64, abs=1e-3)


def test_the_papers_field_is_crossed_with_any_heading_in_the_world():
    configs = grounds.paper_configs("trot 0.6 m/s, the paper's field", SpatialOptions(robots=40))
    headings = np.array([c.sim.heading for c in configs])
    assert headings.min() < -2
    assert headings.max() > 2
    assert len({c.terrain.seed for c in configs}) == 40
    assert {c.controller for c in configs} == {"spatial"}


def test_a_part_that_does_not_exist_is_refused(capsys):
    with pytest.raises(SystemExit):
        study.main(["--parts", "stairs"])
    assert "commands, grounds, random" in capsys.readouterr().err


def test_errors_are_against_the_last_command_and_averaged_over_a_cycle():
    config = commands.command_configs((0.5, 0.0, 1.0), SpatialOptions(seeds=1))[0]
    time = np.arange(0.0, 8.0, 0.005)
    qpos, qvel = np.zeros((len(time), 19)), np.zeros((len(time), 18))
    yaw = 1.1 * time
    qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    swing = 0.05 * np.sin(2 * np.pi * time / 0.4)  # within a cycle
    x = np.zeros((len(time), 6))
    x[:, 3] = 0.5 + swing
    qvel[:, :2] = 0.03 * np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)  # to the left
    run = SimpleNamespace(time=time, qpos=qpos, qvel=qvel, x=x, dt=0.005, fell=False)
    got = measures.walked(run, config)
    np.testing.assert_allclose(got["errors"], [0.05 / np.sqrt(2), 0.03, 0.1], rtol=1e-3)
    np.testing.assert_allclose(got["errors_of_cycles"], [0.0, 0.03, 0.1], rtol=1e-3, atol=1e-9)
    assert measures.walked(run.__class__(**vars(run) | {"fell": True}), config) == {"errors": None}


def test_what_is_reached_is_the_mean_of_the_last_seconds():
    config = limits.speed_configs("turn on the spot", 3.0, SpatialOptions(seeds=1))[0]
    time = np.arange(0.0, config.duration, 0.005)
    yaw = np.where(time < 4.0, 0.0, 2.9 * (time - 4.0))
    qpos, qvel = np.zeros((len(time), 19)), np.zeros((len(time), 18))
    qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    x = np.zeros((len(time), 6))
    run = SimpleNamespace(time=time, qpos=qpos, qvel=qvel, x=x, dt=0.005, fell=False)
    np.testing.assert_allclose(measures.reached(run, config)["reached"], [0, 0, 2.9], atol=0.02)


def test_peaks_are_those_of_the_second_after_a_switch():
    config = limits.switch_configs(("trot", "bound", "trot"), SpatialOptions())[0]
    time = np.arange(0.0, config.duration, 0.005)
    roll = np.radians(np.where((time > 3.2) & (time < 3.4), 5.0, 1.0))
    qpos = np.zeros((len(time), 19))
    qpos[:, 3], qpos[:, 4] = np.cos(roll / 2), np.sin(roll / 2)
    run = SimpleNamespace(time=time, qpos=qpos, fell=False)
    peaks = measures.switched(run, config)["peaks_deg"]
    np.testing.assert_allclose(np.array(peaks)[:, 0], [5.0, 1.0], atol=1e-6)
