"""Reproduction and envelope as a user runs them, and the rules of their tables."""

import dataclasses
import json
from argparse import Namespace

import pytest

from kjax.gait import Gait, phases
from kjax.runs.cache import Cache
from kjax.sim.resolve import batch_spec
from kjax.studies import envelope
from kjax.studies.reproduce import page, paper_results
from kjax.studies.reproduce import study as reproduce


def test_every_experiment_and_axis_has_a_config_that_loads():
    for experiment in paper_results.EXPERIMENTS:
        config = paper_results.base_config(experiment, "planar", quick=False)
        chosen = paper_results.episodes(experiment, config, seeds=4, terrains=3)
        assert len(chosen) == (3 if experiment.vary == "terrain" else 4)
        assert len(set(chosen)) == len(chosen)
        assert len({one.seed for one in chosen}) == len(chosen)
    for axis in envelope.AXES:
        config = envelope._config(axis, "planar", Namespace(quick=False))
        easy = envelope._changed(config, axis.vary(axis.easy, 3, config), 3)
        hard = envelope._changed(config, axis.vary(axis.hard, 3, config), 3)
        assert easy.seed == 3
        assert easy != hard


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


def test_an_episode_passes_if_it_did_what_was_asked():
    axes = {axis.name: axis for axis in envelope.AXES}
    upright = {"fell": False, "crossed": False, "velocity_late_mean_mps": 0.85}

    def passed(name, value, **more):
        return envelope._passed(axes[name], value, upright | more)

    assert passed("speed_trot", 1.0)
    assert not passed("speed_trot", 1.2)
    assert not passed("speed_trot", 1.0, fell=True)
    assert passed("friction_trot", 0.4, velocity_late_mean_mps=0.3)
    assert not passed("friction_trot", 0.4)
    assert not passed("blocks_trot", 0.05)
    assert passed("push_bound", 5.0)


def bears(table):
    """A stand-in for episodes: phase -> the values that pass there."""
    asked = []

    def passes(value, phase):
        asked.append((value, phase))
        return value in table[phase]

    return passes, asked


def test_the_push_that_is_reported_is_that_of_the_weakest_phase():
    """Success that is not monotone: what passes beyond a failure does not count."""
    axis = {a.name: a for a in envelope.AXES}["push_bound"]
    axis = dataclasses.replace(axis, easy=5.0, hard=30.0)
    passes, asked = bears({0.0: {5, 10, 15, 20, 25, 30}, 0.3: {5, 10, 20, 25}, 0.6: {5, 10, 15}})
    found = envelope._map(passes, axis, 5.0, [0.0, 0.3, 0.6])
    assert (found["passed"], found["failed"]) == (10.0, 15.0)
    assert [(p["passed"], p["failed"]) for p in found["phases"]] == [
        (30.0, None), (10.0, 15.0), (15.0, 20.0)
    ]  # fmt: skip
    assert len(asked) == len(set(asked)) == 6 + 3 + 4


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ({0.0: {5, 10}, 0.5: set()}, (None, 5.0)),
        ({0.0: {5, 10}, 0.5: {10}}, (None, 5.0)),
        ({0.0: {5, 10}, 0.5: {5, 10}}, (10.0, None)),
    ],
)
def test_a_map_that_fails_at_once_or_never(table, expected):
    axis = dataclasses.replace(envelope.AXES[0], easy=5.0, hard=10.0)
    passes, _ = bears(table)
    found = envelope._map(passes, axis, 5.0, list(table))
    assert (found["passed"], found["failed"]) == expected
    shown = envelope._shown({**found, "unit": "N s", "easy": 5.0})
    assert "every phase" in shown or "at some phase" in shown


def search(name, answer, seeds=20):
    """Search an axis with a stand-in that answers each episode's config, early ends included."""
    axis = {a.name: a for a in envelope.AXES}[name]

    def run(configs, label="", enough=None):
        results = []
        for config in configs:
            results.append(answer(config))
            if enough(results):
                break
        return results + [None] * (len(configs) - len(results))

    return envelope._search(axis, "planar", Namespace(quick=False, seeds=seeds), run)


def test_the_speed_that_was_reached_stands_beside_the_one_that_passes():
    """A robot that walks 15 % too slowly up to 1 m/s, and stays at 0.85 m/s."""

    def answer(config):
        wanted = config.command.v_x[-1]
        return {"fell": False, "velocity_late_mean_mps": min(0.85 * wanted, 0.85)}

    one = search("speed_trot", answer)
    assert one["passed"] <= 0.85 / 0.8 < one["failed"]
    assert one["reached_mps"] == pytest.approx(min(0.85 * one["passed"], 0.85))
    assert "the speed reached is 0.85 m/s" in envelope._shown(one)


def test_pushes_come_at_every_phase_of_the_cycle_and_two_falls_of_twenty_are_too_many():
    seen = set()

    def answer(config):
        seen.add(config.push.times[0])
        late = config.push.times[0] - 3.0
        return {"fell": config.push.forward > 10.0 and late > 0.22 and config.seed < 2}

    one = search("push_bound", answer)
    # By hand: the bound's cycle is 0.35 s, seven phases are 0.05 s apart.
    assert sorted(seen) == pytest.approx([3.0 + 0.05 * i for i in range(7)])
    assert [p["late_s"] for p in one["phases"]] == pytest.approx([0.05 * i for i in range(7)])
    assert (one["passed"], one["failed"]) == (10.0, 12.5)
    assert [p["passed"] for p in one["phases"]] == [40.0] * 5 + [10.0] * 2
    shown = envelope._shown(one)
    assert "10 N s passes at every phase, 12.5 does not; from phase to phase: 40" in shown

    def seldom(config):
        return {"fell": config.seed == 3}

    assert search("push_bound", seldom)["passed"] == 40.0


def test_the_figure_shows_maps_and_speeds(tmp_path):
    from kjax.viz.report import envelope_figure

    found = {
        "a": search("push_bound", lambda c: {"fell": c.push.forward > 20.0}),
        "b": search("speed_trot", lambda c: {"fell": True}),
        "c": search("speed_bound", lambda c: {
            "fell": False, "velocity_late_mean_mps": c.command.v_x[-1]}),
    }  # fmt: skip
    envelope_figure(found, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000
    assert json.loads(json.dumps(found))["b"]["passed"] is None


@pytest.mark.parametrize(
    ("main", "words", "part"),
    [
        (
            reproduce.main,
            ["--only", "trott"],
            "--only: got 'trott', wanted some of koopman_fit, trot",
        ),
        (reproduce.main, ["--seeds", "0"], "--seeds: got 0, wanted at least 1"),
        (reproduce.main, ["--base", "both", "--terrains", "x"], "--terrains"),
        (envelope.main, ["--only", "speed"], "wanted some of speed_trot"),
        (envelope.main, ["--jobs", "0"], "--jobs: got 0, wanted at least 1"),
        (envelope.main, ["--sedes", "3"], "--sedes"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(call, main, words, part, capsys):
    assert call(main, *words) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1, text
    assert part in text


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
    assert "figures/trot_rough_planar.png" in html
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
