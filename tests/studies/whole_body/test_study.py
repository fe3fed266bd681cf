"""The study of the whole robot, once for real, and what it makes of its errors."""

import json
from types import SimpleNamespace

import pytest

from kjax.prediction import storage
from kjax.studies.whole_body import recordings, study
from kjax.types import Mode


@pytest.mark.slow
def test_the_study_runs_and_records_once(call, tmp_path, capsys):
    assert call(study.main, "--quick", "--out", tmp_path) == 0
    assert "recording" in capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "metrics.json", "table.md", "details.json", "figure.png",
        "residual_trot.npz", "residual_bound.npz",
        "residual_trot_clock_history.npz", "residual_bound_clock_history.npz",
        "weights_trot.npz", "weights_bound.npz", "cache",
    }  # fmt: skip
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    # Ten short episodes already: the limits of the whole study with some room.
    assert 0.0 < metrics["residual_velocity_ratio_50ms"] < 0.35
    assert 0.0 < metrics["residual_pitch_rate_ratio_50ms"] < 0.85
    trot, bound = (
        storage.load(tmp_path / f"residual_{gait}.npz", "residual") for gait in ("trot", "bound")
    )
    assert trot.params.shape == (len(Mode), 6, 17)
    assert trot.params[Mode.TROT].any()
    assert not trot.params[Mode.REAR].any()
    assert bound.params[Mode.FRONT].any()
    # One tick's error of the velocity after 5 ms: millimetres per second.
    assert (trot.spread[Mode.TROT, 3:5] > 1e-4).all()
    assert (trot.spread[Mode.TROT, 3:5] < 2e-2).all()
    # What lies there is taken, and only that.
    options = SimpleNamespace(robots=10, duration=3.0, force=15.0)
    episodes = recordings.record("trot", options, tmp_path)
    assert len(episodes) == 10
    assert capsys.readouterr().out == "trot: 10 episodes of 3 s are there\n"
