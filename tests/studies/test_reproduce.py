"""The reproduction: the rules of its table; what its script leaves and finds again."""

import json
from types import SimpleNamespace

import pytest

from kjax.gait import Gait, phases
from kjax.runs.cache import Cache
from kjax.sim.metrics import metrics
from kjax.sim.resolve import batch_spec, resolve_goal
from kjax.studies.reproduce import page, paper_results
from kjax.studies.reproduce import study as reproduce


def test_every_experiment_has_a_config_that_loads():
    for experiment in paper_results.EXPERIMENTS:
        config = paper_results.base_config(experiment, "planar", quick=False)
        chosen = paper_results.episodes(experiment, config, seeds=4, terrains=3)
        assert len(chosen) == (3 if experiment.vary == "terrain" else 4)
        assert len(set(chosen)) == len(chosen)
        assert len({one.seed for one in chosen}) == len(chosen)


def test_request_times_cover_a_cycle_of_the_gait_that_is_left():
    by_name = {e.name: e for e in paper_results.EXPERIMENTS}
    for name, cycle in (("trot_to_bound", 0.5), ("bound_to_trot", 0.35)):
        config = paper_results.base_config(by_name[name], "planar", quick=False)
        chosen = paper_results.episodes(by_name[name], config, seeds=5, terrains=1)
        late = [one.gait.times[-1] - 3.0 for one in chosen]
        assert late == pytest.approx([cycle * i / 5 for i in range(5)])


def test_the_naive_switch_is_asked_for_in_the_middle_of_a_stance():
    cycle = phases(0.35, (0.0, 0.0, 4 / 7, 4 / 7), (2 / 7, 2 / 7, 1 / 7, 1 / 7))
    gait = Gait("bound", cycle, ramp_start=0.5, ramp_cycles=2)
    # By hand: cycles of 0.25, 0.30 and then 0.35 s begin at 0, 0.25, 0.55, 0.90, ...
    times = paper_results.mid_stances(gait, 1.0, 1.58, 4)
    rear, front = 1.55 + 0.2, 1.90
    expected = [rear + 0.25 * 0.05, front + 0.375 * 0.1, rear + 0.5 * 0.05, front + 0.625 * 0.1]
    assert times == pytest.approx(expected)


def test_a_target_is_met_by_the_number_that_it_is_for():
    row, judge = paper_results.Row, reproduce._row
    total = {"runs": 8, "falls": 1, "crossed": 7, "a": {"median": 1.0, "worst": -3.0, "n": 7}}
    floors = {"x": 0.1, "y": 0.2}

    def met(**fields):
        return judge(row(label="", **fields), total, floors)["met"]

    assert met(metric="a", target=2.0)
    assert not met(metric="a", target=2.0, of="worst")
    assert met(metric="a") is None
    assert met(metric="missing", target=2.0) is False
    assert not met(metric="falls", target=0)
    assert met(metric="crossed", target=0.8)
    assert not met(metric="crossed", target=0.9)


def field(crossed, rmse=0.1, fell=False):
    if fell:
        return {"fell": True, "crossed": False}
    return {
        "fell": False, "crossed": crossed, "velocity_rmse_mps": rmse, "field_pitch_p95_deg": None
    }  # fmt: skip


def test_the_cost_of_held_torques_is_counted_field_by_field():
    every = [*[field(True)] * 16, field(False), field(True, fell=True)]
    held = [*[field(True, 0.12)] * 14, field(False, 0.2), field(False, fell=True),
            field(True, 0.1), field(True, 0.1)]  # fmt: skip
    cost = reproduce.held_cost(every, held)
    crossed = cost["crossed"]
    assert (crossed["every_step"], crossed["held"], crossed["fields"]) == (16, 16, 18)
    assert (crossed["lost"], crossed["gained"]) == (2, 2)
    assert crossed["difference"] == 0.0
    assert crossed["low"] < 0.0 < crossed["high"]
    # 16 fields are stood up on both ways: 14 by 0.02, one by 0.1, one by nothing.
    rmse = cost["velocity_rmse_mps"]
    assert rmse["n"] == 16
    assert (rmse["median"], rmse["low"], rmse["high"]) == pytest.approx((0.02, 0.02, 0.02))
    assert cost["field_pitch_p95_deg"] == {"n": 0, "median": None, "low": None, "high": None}
    rows = page._held_rows("rough", "free", cost)
    assert all(len(row) == len(page.HEADER) for row in rows)
    assert rows[0][5:7] == ["16 of 18", "67.2 to 96.9 %"]  # Wilson's, by hand
    assert "2 lost, 2 gained" in rows[1][2]


def test_numbers_stand_beside_their_intervals():
    row, judge = paper_results.Row, reproduce._row
    results = [{"fell": i == 0, "a": float(i)} for i in range(17)]
    total = {"runs": 17, "falls": 1, "crossed": 16, "a": {"median": 8.5, "worst": 16.0, "n": 16}}
    own = judge(row(metric="a", label=""), total, {}, results)
    assert (own["low"], own["high"]) == (4.0, 13.0)  # ranks 4 and 13 of 16, from a table
    falls = judge(row(metric="falls", label=""), total, {}, results)
    assert (falls["low"], falls["high"]) == pytest.approx((0.0105, 0.2698), abs=1e-4)
    few = judge(row(metric="a", label=""), total, {}, results[:4])
    assert (few["low"], few["high"]) == (None, None)
    assert page._interval(few) == ""
    assert page._interval(falls, percent=True) == "1.0 to 27.0 %"


def test_rough_ground_is_walked_on_256_fields():
    args = reproduce._parse([])
    rough = [e for e in paper_results.EXPERIMENTS if e.vary == "terrain"]
    assert {e.name for e in rough} == {"trot_rough", "bound_rough"}
    for experiment in rough:
        config = paper_results.base_config(experiment, "free", quick=False)
        chosen = paper_results.episodes(
            experiment, config, seeds=args.seeds, terrains=args.terrains
        )
        assert len({one.terrain.seed for one in chosen}) == 256
        assert len({batch_spec(one) for one in chosen}) == 1  # one batch takes them all


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (
            ["--only", "trott"],
            "--only: got 'trott', wanted some of koopman_fit, trot",
        ),
        (["--seeds", "0"], "--seeds: got 0, wanted at least 1"),
        (["--base", "both", "--terrains", "x"], "--terrains"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(call, words, part, capsys):
    assert call(reproduce.main, *words) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1, text
    assert part in text


@pytest.fixture
def episodes(monkeypatch, standing_run):
    """Stand in for episodes: robots stand still. ``run`` lists those that were run."""
    log = SimpleNamespace(run=[], stop_at=None)

    def episode(config, record, path):
        if len(log.run) == log.stop_at:
            raise KeyboardInterrupt
        log.run.append(config)
        run = standing_run(config, config.duration)
        path.parent.mkdir(parents=True, exist_ok=True)
        record(run, path)
        return metrics(run, resolve_goal(config))

    monkeypatch.setattr("kjax.runs.pool._episode", episode)
    return log


def test_flat_ground_goes_on_after_ctrl_c_and_leaves_page_table_and_figures(
    episodes, call, capsys, tmp_path
):
    only = ("--only", "trot_velocity", "trot_to_bound")
    words = ("--quick", "--jobs", 1, "--base", "planar", *only, "--out", tmp_path)
    episodes.stop_at = 3
    assert call(reproduce.main, *words) == 130
    assert "the same command goes on" in capsys.readouterr().out
    assert not (tmp_path / "index.html").exists()
    episodes.stop_at = None
    assert call(reproduce.main, *words) == 0
    assert len(episodes.run) == 4  # two seeds of each, none of them twice
    found = json.loads((tmp_path / "results.json").read_text())["experiments"]
    assert set(found) == {"trot_velocity", "trot_to_bound"}
    rows = {row["metric"]: row for row in found["trot_velocity"]["planar"]["rows"]}
    # It stands still and is asked for nothing in its first second and a half.
    assert rows["velocity_rmse_mps"]["median"] == 0.0
    assert rows["falls"]["met"] is True
    assert rows["falls"]["high"] == pytest.approx(0.6576, abs=1e-4)  # Wilson's, of 0 of 2
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"trot_velocity_planar.png", "switches_planar.png"}
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert lines[0] == "| " + " | ".join(page.HEADER) + " |"
    assert any(line.startswith("| trot steps, 6 x 1 ms | planar | falls |") for line in lines)
    assert "A quick check of the machinery: this is no result." in lines
    html = (tmp_path / "index.html").read_text()
    assert html.count('<img src="data:image/png;base64,') == len(names)
    assert json.loads((tmp_path / "results.json").read_text())["provenance"]["git_revision"] in html
    assert "trot_velocity (free)" in capsys.readouterr().out  # not finished, so not on the page


@pytest.mark.slow
def test_a_quick_reproduction_leaves_page_table_and_json_and_goes_on(
    call, tmp_path, monkeypatch, capsys, repository
):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(repository / ".cache" / "jax"))
    options = ["--quick", "--jobs", "2", "--base", "planar", "--out", str(tmp_path)]
    words = [*options, "--only", "trot_rough"]
    assert call(reproduce.main, *words) == 0
    assert {p.name for p in tmp_path.iterdir()} == {
        "results.json", "table.md", "index.html", "figures", "cache"
    }  # fmt: skip
    record = json.loads((tmp_path / "results.json").read_text())
    one = record["experiments"]["trot_rough"]["planar"]
    assert one["summary"]["runs"] == 2
    assert one["rows"][0]["target"] == 0.98
    assert one["held"]["cost"]["crossed"]["fields"] == 2
    assert len(Cache(tmp_path)) == 4
    html = (tmp_path / "index.html").read_text()
    assert html.count('<img src="data:image/png;base64,') == 1
    assert (tmp_path / "figures" / "trot_rough_planar.png").exists()
    assert "rough trot" in (tmp_path / "table.md").read_text()
    assert "rough trot, 0.3 m/s, torques held" in (tmp_path / "table.md").read_text()

    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()}
    assert call(reproduce.main, *words) == 0
    again = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()}
    assert again == files  # nothing was run again
    assert "trot_rough (planar)" not in capsys.readouterr().out

    (rough,) = (e for e in paper_results.EXPERIMENTS if e.name == "trot_rough")
    rough.overrides["leg.swing_height"] = 0.2
    try:
        monkeypatch.setattr(reproduce, "_fit", lambda *a, **k: {
            "largest_scale_within_tolerance": {"trot": {"max": None}}})  # fmt: skip
        assert call(reproduce.main, *options, "--only", "koopman_fit") == 0
        record = json.loads((tmp_path / "results.json").read_text())
        assert "trot_rough" not in record["experiments"]
        (line,) = [one for one in capsys.readouterr().out.splitlines() if "not on the page" in one]
        assert "trot_rough (planar)" in line
    finally:
        del rough.overrides["leg.swing_height"]
    # With the config as it was, it is on the page again, and runs nothing.
    assert call(reproduce.main, *options, "--only", "koopman_fit") == 0
    record = json.loads((tmp_path / "results.json").read_text())
    assert record["experiments"]["trot_rough"]["planar"]["rows"] == one["rows"]


def test_the_floor_of_a_config_is_reported_with_its_rmse():
    row = reproduce._row(
        paper_results.Row(metric="velocity_rmse_mps", label=""),
        {"runs": 1, "falls": 0},
        {"4_mps2": 0.008, "mu_g": 0.006},
    )
    assert row["floor"] == [0.008, 0.006]
