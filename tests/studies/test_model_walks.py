"""What model_walks.py finds in its folder is shown again only where it would come out the same."""

import json

import numpy as np
import pytest

from kjax.prediction import storage
from kjax.studies import model_walks
from kjax.types import Mode

MODELS = ("linear (the paper)", "SRB re-linearised")


@pytest.fixture
def episodes(call, monkeypatch, tmp_path):
    """Run model_walks.py --quick on trots with a stand-in for episodes; returns those it ran."""
    ran = []

    def run(configs):
        ran.extend(configs)
        return [{"fell": False, "velocity_rmse_mps": 0.1, "pitch_p95_deg": 1.0} for _ in configs]

    monkeypatch.setattr(model_walks, "run", run)
    monkeypatch.setattr(model_walks, "figure", lambda found, path: None)

    def study(*words):
        ran.clear()
        words = ("--quick", "--gaits", "trot", "--out", tmp_path, *words)
        assert call(model_walks.main, *words) == 0
        return list(ran)

    return study


def test_episodes_are_found_again(episodes, tmp_path):
    assert len(episodes()) > 0
    before = json.loads((tmp_path / "metrics.json").read_text())["walks"]
    assert episodes() == []
    assert json.loads((tmp_path / "metrics.json").read_text())["walks"] == before


@pytest.mark.parametrize("name", ["SPEEDS", "TUNE_SEEDS", "REPORT_SEEDS"])
def test_edited_lists_are_run(episodes, monkeypatch, name):
    first = episodes()
    other = {"SPEEDS": {"trot": (0.0, 0.4), "bound": (0.0, 0.5)}}.get(name, range(50, 60))
    monkeypatch.setattr(model_walks, name, other)
    assert len(episodes()) == len(first)
    monkeypatch.undo()


def test_a_model_with_other_keys_is_run_and_the_others_are_not(episodes, monkeypatch):
    first = episodes()
    monkeypatch.setitem(model_walks.MODELS, MODELS[1], {"koopman.model": "planted"})
    again = episodes()
    assert 0 < len(again) < len(first)
    assert {config.koopman.model for config in again} == {"planted"}


def test_a_model_that_is_added_to_the_lists_runs_alone(episodes, monkeypatch):
    first = episodes()
    real = model_walks.models_of
    more = {"another": {"koopman.model": "planted"}}
    monkeypatch.setattr(model_walks, "models_of", lambda *a: real(*a) | more)
    assert 0 < len(episodes()) < len(first)


def test_another_or_a_retrained_residual_is_run(episodes, tmp_path):
    def train(folder, value):
        folder.mkdir(exist_ok=True)
        W, spread = np.zeros((len(Mode), 6, 17)), np.full((len(Mode), 6), value)
        for end in ("", "_clock_history"):
            stored = storage.Stored("residual", 0.005, W, spread)
            storage.save(folder / f"residual_trot{end}.npz", stored)

    one, other = tmp_path / "one", tmp_path / "other"
    train(one, 1e-3)
    train(other, 2e-3)
    assert len(episodes("--residual", one)) > 0
    assert episodes("--residual", one) == []
    again = episodes("--residual", other)
    assert {config.koopman.model for config in again} == {"residual"}
    train(one, 3e-3)
    assert {config.koopman.model for config in episodes("--residual", one)} == {"residual"}


def test_with_other_code_everything_is_run(episodes, monkeypatch):
    first = episodes()
    monkeypatch.setattr("kjax.runs.cache.code_version", lambda *files: "other")
    assert len(episodes()) == len(first)
