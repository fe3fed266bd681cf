"""What a study finds in its folder is shown again only where it would come out the same."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from kjax.config import SweepConfig, load_config, to_dict
from kjax.prediction import storage
from kjax.studies import model_walks, sweep
from kjax.studies.whole_body import recordings
from kjax.types import Mode

MODELS = ("linear (the paper)", "SRB re-linearised")


@pytest.fixture
def walks(call, monkeypatch, tmp_path):
    """Run model_walks.py --quick on trots with a stand-in for episodes; returns those it ran."""
    walked = []

    def run(configs):
        walked.extend(configs)
        return [{"fell": False, "velocity_rmse_mps": 0.1, "pitch_p95_deg": 1.0} for _ in configs]

    monkeypatch.setattr(model_walks, "run", run)
    monkeypatch.setattr(model_walks, "figure", lambda walks, path: None)

    def study(*words):
        walked.clear()
        words = ("--quick", "--gaits", "trot", "--out", tmp_path, *words)
        assert call(model_walks.main, *words) == 0
        return list(walked)

    return study


def test_walks_are_found_again(walks, tmp_path):
    assert len(walks()) > 0
    before = json.loads((tmp_path / "metrics.json").read_text())["walks"]
    assert walks() == []
    assert json.loads((tmp_path / "metrics.json").read_text())["walks"] == before


@pytest.mark.parametrize("name", ["SPEEDS", "TUNE_SEEDS", "REPORT_SEEDS"])
def test_edited_lists_are_walked(walks, monkeypatch, name):
    first = walks()
    other = {"SPEEDS": {"trot": (0.0, 0.4), "bound": (0.0, 0.5)}}.get(name, range(50, 60))
    monkeypatch.setattr(model_walks, name, other)
    assert len(walks()) == len(first)
    monkeypatch.undo()


def test_a_model_with_other_keys_is_walked_and_the_others_are_not(walks, monkeypatch):
    first = walks()
    monkeypatch.setitem(model_walks.MODELS, MODELS[1], {"koopman.model": "planted"})
    again = walks()
    assert 0 < len(again) < len(first)
    assert {config.koopman.model for config in again} == {"planted"}


def test_a_model_that_is_added_to_the_lists_walks_alone(walks, monkeypatch):
    first = walks()
    real = model_walks.models_of
    more = {"another": {"koopman.model": "planted"}}
    monkeypatch.setattr(model_walks, "models_of", lambda *a: real(*a) | more)
    assert 0 < len(walks()) < len(first)


def test_another_or_a_retrained_residual_is_walked(walks, tmp_path):
    def train(folder, value):
        folder.mkdir(exist_ok=True)
        W, spread = np.zeros((len(Mode), 6, 17)), np.full((len(Mode), 6), value)
        for end in ("", "_clock_history"):
            stored = storage.Stored("residual", 0.005, W, spread)
            storage.save(folder / f"residual_trot{end}.npz", stored)

    one, other = tmp_path / "one", tmp_path / "other"
    train(one, 1e-3)
    train(other, 2e-3)
    assert len(walks("--residual", one)) > 0
    assert walks("--residual", one) == []
    again = walks("--residual", other)
    assert {config.koopman.model for config in again} == {"residual"}
    train(one, 3e-3)
    assert {config.koopman.model for config in walks("--residual", one)} == {"residual"}


def test_with_other_code_everything_is_walked(walks, monkeypatch):
    first = walks()
    monkeypatch.setattr("kjax.runs.cache.code_version", lambda *files: "other")
    assert len(walks()) == len(first)


# ---------------------------------------------------------------- recordings


@pytest.fixture
def record(monkeypatch, tmp_path):
    """Record a kind of episodes with a stand-in for the engine; returns how many it recorded."""
    count = []

    class Engine:
        def __init__(self, config, torques):
            pass

        def run(self, configs):
            count.append(len(configs))
            shape = (20, len(configs))
            log = SimpleNamespace(
                x=np.zeros((*shape, 6)), feet=np.zeros((*shape, 4, 2)),
                force=np.zeros((*shape, 4, 2)), stance=np.ones((*shape, 4), bool),
                foot_force=np.zeros((*shape, 4)),
            )  # fmt: skip
            ticks, fell = np.full(len(configs), 20), np.zeros(len(configs), bool)
            return SimpleNamespace(interrupted=False, log=log, ticks=ticks, fell=fell)

    monkeypatch.setattr("kjax.sim.engines.mujoco_batch.BatchEngine", Engine)

    def call(*, robots=3, kind="trot"):
        count.clear()
        args = SimpleNamespace(robots=robots, duration=3.0, force=15.0)
        assert len(recordings.record(kind, args, tmp_path)) == robots
        return sum(count)

    return call


def test_recordings_are_found_again(record):
    assert record() == 3
    assert record() == 0


def test_with_other_code_or_another_config_it_is_recorded_and_the_first_stays(record, monkeypatch):
    record()
    with monkeypatch.context() as other:
        other.setattr("kjax.runs.cache.code_version", lambda *files: "other")
        assert record() == 3
    assert record(robots=4) == 4
    assert record() == 0


@pytest.mark.parametrize("length", [0, 10, 1000])
def test_a_recording_that_is_cut_off_is_named(record, capsys, tmp_path, length):
    record()
    (path,) = (tmp_path / "cache").iterdir()
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(SystemExit) as caught:
        record()
    assert caught.value.code == 2
    assert f"{path}: damaged" in capsys.readouterr().err


# ---------------------------------------------------------------- sweeps that are drawn again

SWEEP = """
base = "walk.toml"
seeds = 2
[axes.speed]
values = [0.1, 0.3]
unit = "m/s"
[set]
"command.times" = [0.0]
"command.v_x" = ["= speed"]
[figure]
metrics = ["success"]
title = "one"
"""


@pytest.fixture
def drawn(tmp_path):
    """Draw a finished sweep with a file of this text."""
    (tmp_path / "walk.toml").write_text("")
    file = tmp_path / "sweep.toml"

    def config(text):
        file.write_text(text)
        return load_config(SweepConfig, file)

    made = config(SWEEP)
    xr.Dataset(
        {name: (("speed", "seed"), np.zeros((2, 2))) for name in ("fell", "velocity_rmse_mps")},
        {"speed": [0.1, 0.3], "seed": [0, 1]},
        attrs={"sweep": json.dumps(to_dict(made)), "provenance": "{}"},
    ).to_netcdf(tmp_path / "sweep.nc", engine="h5netcdf")
    return lambda text: sweep.draw(config(text), tmp_path, str(file))


def test_a_sweep_may_be_drawn_with_another_figure(drawn, tmp_path):
    drawn(SWEEP.replace('"one"', '"two"').replace("seeds = 2", "seeds = 4"))
    assert (tmp_path / "figure.png").exists()


@pytest.mark.parametrize(
    ("old", "new"),
    [("[0.1, 0.3]", "[0.1, 0.4]"), ('"= speed"', '"= 2 * speed"'), ("walk.toml", "other.toml")],
)
def test_a_sweep_is_not_drawn_as_another_one(drawn, capsys, tmp_path, old, new):
    with pytest.raises(SystemExit) as caught:
        drawn(SWEEP.replace(old, new))
    assert caught.value.code == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "holds another sweep" in text
    assert not (tmp_path / "figure.png").exists()
