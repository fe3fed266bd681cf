"""The fit study's script: all of its statistics, and what it leaves."""

import json
import tomllib

import numpy as np
import pytest

from kjax.studies import koopman_fit


@pytest.mark.slow
def test_the_fit_study_reports_all_statistics(call, capsys, tmp_path):
    assert call(koopman_fit.main, "--scales", "[1.0, 0.1]", "--out", tmp_path) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    for mode in ("trot", "front", "rear"):
        assert set(metrics["error_at_end"][mode]) == {"mean", "variance", "std", "max"}
        assert metrics["fit"][mode]["rank"] == 19
        assert metrics["error_at_end"][mode]["variance"]["v_x"] == pytest.approx(
            metrics["error_at_end"][mode]["std"]["v_x"] ** 2
        )
    assert (tmp_path / "figure.png").exists()
    assert "within 0.0001" in capsys.readouterr().out


@pytest.fixture
def fitted(monkeypatch):
    """Stand in for the fits: made-up statistics of two modes."""
    rng = np.random.default_rng(0)
    states = ("p_x", "p_z", "theta", "v_x", "v_z", "omega")
    curves = {
        mode: {key: np.abs(rng.normal(size=(50, 6))) for key in koopman_fit.STATISTICS}
        for mode in ("trot", "front")
    }
    fit = {"rank": 19, "columns": 19, "condition": 1e3, "condition_full": 1e5}
    result = {
        "fit": dict.fromkeys(curves, fit),
        "error_at_end": {
            mode: {key: dict(zip(states, values[-1], strict=True)) for key, values in one.items()}
            for mode, one in curves.items()
        },
        "largest_scale_within_tolerance": {
            mode: {"mean": 0.5, "variance": 1.0, "std": 0.25, "max": None} for mode in curves
        },
    }
    monkeypatch.setattr(koopman_fit, "fit_study", lambda config: (result, curves))
    return result


def test_it_leaves_the_statistics_the_config_and_a_figure(fitted, call, capsys, tmp_path):
    words = ("--test_states", 7, "--out", tmp_path)
    assert call(koopman_fit.main, *words) == 0
    assert {p.name for p in tmp_path.iterdir()} == {"metrics.json", "config.toml", "figure.png"}
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found == json.loads(json.dumps(fitted))
    assert tomllib.loads((tmp_path / "config.toml").read_text())["test_states"] == 7
    out = capsys.readouterr().out
    assert "rank 19 of 19" in out
    row = out.splitlines()[-4].split()
    assert row == ["trot", "0.5", "1", "0.25", "none"]


def test_a_fit_that_is_not_finite_is_one_line(call, capsys, monkeypatch, tmp_path):
    def diverge(config):
        raise ValueError("the fit is not finite: check srb")

    monkeypatch.setattr(koopman_fit, "fit_study", diverge)
    assert call(koopman_fit.main, "--out", tmp_path) == 2
    assert capsys.readouterr().err == "error: the fit is not finite: check srb\n"


def test_a_scale_counts_if_all_smaller_ones_hold_as_well():
    def statistics(largest):
        return koopman_fit.ErrorStatistics(*[np.full((1, 50, 6), largest)] * 4)

    scan = {0.1: statistics(1e-5), 0.2: statistics(2e-4), 0.3: statistics(1e-5)}
    assert koopman_fit._largest_scale(scan, "max", 0, 1e-4) == 0.1
    assert koopman_fit._largest_scale(scan, "max", 0, 1e-3) == 0.3
    assert koopman_fit._largest_scale(scan, "max", 0, 1e-6) is None
