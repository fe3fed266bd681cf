"""The envelope: the rules of its limits; what its script finds, keeps and draws."""

import dataclasses
import json
from argparse import Namespace
from types import SimpleNamespace

import pytest

from kjax.studies import envelope


def test_every_axis_has_a_config_that_loads():
    for axis in envelope.AXES:
        config = envelope._config(axis, "planar", Namespace(quick=False))
        easy = envelope._changed(config, axis.vary(axis.easy, 3, config), 3)
        hard = envelope._changed(config, axis.vary(axis.hard, 3, config), 3)
        assert easy.seed == 3
        assert easy != hard


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


# The script, with a stand-in for episodes.


@pytest.fixture
def episodes(monkeypatch):
    """Stand in for episodes: all walk at 90 % of the command, and fall over a push of 10 N s.

    ``run`` lists those that were run; Ctrl-C comes before the one at ``stop_at``.
    """
    log = SimpleNamespace(run=[], stop_at=None)

    def episode(config, record, path):
        if len(log.run) == log.stop_at:
            raise KeyboardInterrupt
        log.run.append(config)
        return {
            "interrupted": False,
            "fell": bool(config.push.times) and config.push.forward > 10.0,
            "velocity_late_mean_mps": 0.9 * config.command.v_x[-1],
        }

    monkeypatch.setattr("kjax.runs.pool._episode", episode)
    return log


WORDS = ("--quick", "--jobs", 1, "--only", "speed_trot", "push_bound", "--out")


def test_a_quick_search_finds_the_limits_and_is_not_done_twice(episodes, call, capsys, tmp_path):
    assert call(envelope.main, *WORDS, tmp_path) == 0
    found = json.loads((tmp_path / "results.json").read_text())["axes"]
    assert set(found) == {"speed_trot_planar", "push_bound_planar"}
    speed, push = found["speed_trot_planar"], found["push_bound_planar"]
    # Within 20 % of the speed up to the end of the search.
    assert (speed["passed"], speed["failed"]) == (2.2, None)
    assert speed["reached_mps"] == pytest.approx(0.9 * 2.2)
    # The quick map has three pushes, 2.5, 21.25 and 40 N s, at two phases.
    assert (push["passed"], push["failed"]) == (2.5, 21.25)
    assert [one["passed"] for one in push["phases"]] == [2.5, 2.5]
    assert (tmp_path / "figure.png").stat().st_size > 5000
    assert "strongest forward push, bound, planar: 2.5 N s passes" in capsys.readouterr().out
    count = len(episodes.run)
    assert count > 0
    assert call(envelope.main, *WORDS, tmp_path) == 0
    assert len(episodes.run) == count
    # What is not asked for stays on the figure, as it is there whole.
    words = ("--quick", "--jobs", 1, "--only", "speed_trot", "--out", tmp_path)
    assert call(envelope.main, *words) == 0
    assert set(json.loads((tmp_path / "results.json").read_text())["axes"]) == set(found)


def test_it_goes_on_after_ctrl_c(episodes, call, capsys, tmp_path):
    assert call(envelope.main, *WORDS, tmp_path / "whole") == 0
    whole = len(episodes.run)
    episodes.run.clear()
    episodes.stop_at = 3
    assert call(envelope.main, *WORDS, tmp_path / "cut") == 130
    assert "stopped; the same command goes on" in capsys.readouterr().out
    episodes.stop_at = None
    assert call(envelope.main, *WORDS, tmp_path / "cut") == 0
    assert len(episodes.run) == whole
    axes = [json.loads((tmp_path / name / "results.json").read_text())["axes"]
            for name in ("whole", "cut")]  # fmt: skip
    assert axes[0] == axes[1]


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--only", "speed"], "wanted some of speed_trot"),
        (["--jobs", "0"], "--jobs: got 0, wanted at least 1"),
        (["--sedes", "3"], "--sedes"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(call, words, part, capsys):
    assert call(envelope.main, *words) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1, text
    assert part in text
