"""The study of the whole robot, once for real, and what it makes of its errors."""

import json
from types import SimpleNamespace

import numpy as np
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


@pytest.fixture
def studied(monkeypatch):
    """Stand in for recordings and fits: made-up errors of two models."""
    log = SimpleNamespace(recorded=[], interrupt=False)

    def record(kind, args, folder):
        if log.interrupt:
            raise KeyboardInterrupt
        log.recorded.append((kind, args.robots, args.duration))
        return []

    def errors(velocity, omega):
        return {key: {"ratio": ratio, "interval": [0.9 * ratio, 1.1 * ratio], "rms": 0.1}
                for key, ratio in (("velocity", velocity), ("omega", omega))}  # fmt: skip

    def one_gait(gait, episodes, quick):
        inside = {
            name: {"25ms": {"all": errors(1.0, 1.0)}, "50ms": {"all": errors(*ratios)}}
            for name, ratios in {
                "nominal": (1.0, 1.0), "affine": (0.3, 0.8), "clock_history": (0.2, 0.7)
            }.items()
        }  # fmt: skip
        fits = {
            name: SimpleNamespace(
                W=np.zeros((len(Mode), 6, columns)), after=np.ones((len(Mode), 6))
            )
            for name, columns in (("affine", 17), ("clock_history", 29))
        }
        metrics = {"chosen_inside": "clock_history", "inside": inside, "all_starts": {}}
        return metrics, {}, fits, None

    families = {"planted SRB": {"25ms": errors(1.0, 1.0), "50ms": errors(0.5, 0.6)}}
    stand_ins = {
        "kept": lambda kind, args, folder: None,
        "record": record,
        "study": one_gait,
        "compare": lambda gait, held, folder, quick: families,
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(study, name, stand_in)
    monkeypatch.setattr(study.report, "save_figure", lambda curves, dt, path: path.touch())
    return log


def test_it_leaves_the_ratios_of_the_chosen_residual_and_the_models(
    studied, call, capsys, tmp_path
):
    assert call(study.main, "--robots", 12, "--out", tmp_path) == 0
    assert [kind for kind, *_ in studied.recorded] == ["trot", "trot_rough", "bound", "bound_rough"]
    assert {tuple(how) for _, *how in studied.recorded} == {(12, 8.0)}
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["residual_model"] == "clock_history"
    assert found["residual_velocity_ratio_50ms"] == 0.2
    assert found["residual_pitch_rate_ratio_50ms"] == 0.7
    assert found["affine_residual_velocity_ratio_50ms"] == 0.3
    assert found["trot"]["inside, 50ms, all"]["affine"] == [[0.3, 0.27, 0.33], [0.8, 0.72, 0.88]]
    for gait in ("trot", "bound"):
        for suffix, columns in (("", 17), ("_clock_history", 29)):
            file = tmp_path / f"residual_{gait}{suffix}.npz"
            assert storage.load(file, "residual").params.shape == (len(Mode), 6, columns)
        assert set(np.load(tmp_path / f"weights_{gait}.npz")) == {"dt", "affine", "clock_history"}
    text = (tmp_path / "table.md").read_text()
    assert "| planted SRB | 0.100, 1.00 (0.90 to 1.10); 0.100, 1.00 (0.90 to 1.10) |" in text
    assert text in capsys.readouterr().out


def test_a_quick_study_is_of_flat_ground(studied, call, tmp_path):
    assert call(study.main, "--quick", "--out", tmp_path) == 0
    assert studied.recorded == [("trot", 10, 3.0), ("bound", 10, 3.0)]


def test_ctrl_c_keeps_what_is_recorded(studied, call, capsys, tmp_path):
    studied.interrupt = True
    assert call(study.main, "--out", tmp_path) == 130
    assert "finished recordings are kept" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--robots", 9], "--robots: got 9, wanted at least 10"),
        (["--duration", 2.5], "--duration: got 2.5, wanted at least 3"),
        (["--force", 0], "--force: got 0.0, wanted more than 0"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(studied, call, capsys, tmp_path, words, said):
    assert call(study.main, *words, "--out", tmp_path) == 2
    assert capsys.readouterr().err == f"error: {said}\n"
    assert studied.recorded == []
