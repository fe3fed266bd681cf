"""The study of all models, with stand-ins for the fits: its figures that are quoted, its table."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from kjax.studies import koopman_study

LABELS = (
    "SRB linearised at hover",
    "linear EDMD, p = 4 (the paper)",
    "bilinear EDMD, p = 4, with R",
    "exact bilinear (forces fixed in space)",
)


def statistics(size):
    """Errors that grow with the horizon: ``size`` at the longest, in every state."""
    shape = (len(koopman_study.HORIZONS), 6)
    rms = np.broadcast_to(size * np.array(koopman_study.HORIZONS)[:, None] / 0.5, shape)
    return {
        "mean": 0.0 * rms, "variance": rms**2, "std": rms, "max": 2.0 * rms, "rms": rms,
        "rms_low": 0.9 * rms, "rms_high": 1.1 * rms, "quantiles": rms,
        "max_velocity": 2.0 * rms[:, 3], "observables": 9,
    }  # fmt: skip


@pytest.fixture
def judged(monkeypatch):
    """Stand in for fits and judgement; each label's error is 10 times that of the one after it."""
    calls = []

    def fit_all(args, body, alpha, ranges):
        model = SimpleNamespace(A=jnp.eye(15))
        return {label: (label, model, "body", False) for label in LABELS}

    def judge(model, body, alpha, starts, forces):
        calls.append((model[0], starts.shape, forces.shape))
        return statistics(10.0 ** -LABELS.index(model[0]))

    monkeypatch.setattr(koopman_study, "fit_all", fit_all)
    monkeypatch.setattr(koopman_study, "judge", judge)
    return calls


def test_a_quick_study_leaves_the_figures_that_are_quoted(judged, call, capsys, tmp_path):
    assert call(koopman_study.main, "--quick", "--out", tmp_path) == 0
    assert {p.name for p in tmp_path.iterdir()} == {
        "metrics.json", "details.json", "table.md", "figure.png"
    }  # fmt: skip
    found = json.loads((tmp_path / "metrics.json").read_text())
    # By hand: the largest error of a velocity is twice the rms, which is a tenth after 50 ms.
    assert found["linear_max_velocity_error_50ms"] == pytest.approx(0.2 * 0.1)
    assert found["bilinear_max_velocity_error_50ms"] == pytest.approx(0.2 * 0.01)
    assert found["exact_max_error_500ms"] == pytest.approx(2.0 * 0.001)
    assert found["max_velocity_error_mps"]["bound ranges"]["trot"][LABELS[0]][-1] == 2.0
    assert [label for label, *_ in judged] == [*LABELS, *LABELS]  # two ranges, one gait
    assert judged[0][1:] == ((10, 6), (10, 500, 4))  # 10 starts under 10 profiles of 0.5 s
    text = (tmp_path / "table.md").read_text()
    assert text in capsys.readouterr().out
    # The velocity has two components: the norm of the rms is sqrt(2) of it.
    assert f"| {LABELS[0]} | 9 | 2.0e-01 | 1.4e+00 (1.3e+00 to 1.6e+00) |" in text


def test_a_finished_study_is_drawn_again(judged, call, tmp_path):
    assert call(koopman_study.main, "--quick", "--out", tmp_path) == 0
    judged.clear()
    (tmp_path / "figure.png").unlink()
    assert call(koopman_study.main, "--draw", "--out", tmp_path) == 0
    assert judged == []
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_the_residual_s_ratios_are_taken_over_from_whole_body(judged, call, tmp_path):
    other = tmp_path / "whole_body"
    other.mkdir()
    ratios = {"residual_velocity_ratio_50ms": 0.2, "residual_pitch_rate_ratio_50ms": 0.7}
    (other / "metrics.json").write_text(json.dumps({**ratios, "more": 1}))
    words = ("--quick", "--whole-body", other, "--out", tmp_path / "study")
    assert call(koopman_study.main, *words) == 0
    found = json.loads((tmp_path / "study" / "metrics.json").read_text())
    assert {key: found[key] for key in ratios} == ratios
    assert "more" not in found


def test_a_study_that_is_not_there_cannot_be_drawn(call, capsys, tmp_path):
    assert call(koopman_study.main, "--draw", "--out", tmp_path) == 2
    assert capsys.readouterr().err == f"error: --draw: no study in {tmp_path}\n"
