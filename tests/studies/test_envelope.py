"""The envelope's script with a stand-in for episodes: what it finds, keeps and draws."""

import json
from types import SimpleNamespace

import pytest

from kjax.studies import envelope


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
