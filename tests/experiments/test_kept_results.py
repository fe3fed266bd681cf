"""What a study finds in its folder is shown again only where it would come out the same."""

import dataclasses
import importlib
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from kjax.config import SweepConfig, load_config, to_dict
from kjax.prediction import storage
from kjax.types import Mode

MODELS = ("linear (the paper)", "SRB re-linearised")


@pytest.fixture(scope="module")
def scripts(repository):
    sys.path.insert(0, str(repository / "experiments"))
    names = ("model_walks", "whole_body_recordings", "reproduce", "sweep")
    yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
    sys.path.remove(str(repository / "experiments"))


@pytest.fixture
def walks(scripts, monkeypatch, tmp_path):
    """Run model_walks.py --quick on trots with a stand-in for episodes; returns those it walked."""
    module = scripts.model_walks
    monkeypatch.setattr(module.cli, "configure_jax", lambda **more: None)
    walked = []

    def run(configs):
        walked.extend(configs)
        return [{"fell": False, "velocity_rmse_mps": 0.1, "pitch_p95_deg": 1.0} for _ in configs]

    monkeypatch.setattr(module, "run", run)
    monkeypatch.setattr(module, "figure", lambda walks, path: None)

    def call(*words):
        walked.clear()
        monkeypatch.setattr(
            sys, "argv",
            ["model_walks", "--quick", "--gaits", "trot", "--out", str(tmp_path), *map(str, words)],
        )  # fmt: skip
        module.main()
        return list(walked)

    return call


def refusal(capsys, call, *words):
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        call(*words)
    assert caught.value.code == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1, text
    assert "--out" in text
    return text


def test_walks_are_found_again(walks, tmp_path):
    assert len(walks()) > 0
    before = (tmp_path / "walks.json").read_text()
    assert walks() == []
    assert (tmp_path / "walks.json").read_text() == before


@pytest.mark.parametrize("name", ["SPEEDS", "TUNE_SEEDS", "REPORT_SEEDS"])
def test_walks_of_edited_lists_are_refused(walks, scripts, monkeypatch, capsys, name):
    walks()
    other = {"SPEEDS": {"trot": (0.0, 0.4), "bound": (0.0, 0.5)}}.get(name, range(50, 60))
    monkeypatch.setattr(scripts.model_walks, name, other)
    assert MODELS[0] in refusal(capsys, walks)


def test_walks_of_a_model_with_other_keys_are_refused(walks, scripts, monkeypatch, capsys):
    walks()
    monkeypatch.setitem(scripts.model_walks.MODELS, MODELS[1], {"koopman.model": "planted"})
    assert MODELS[1] in refusal(capsys, walks)


def test_a_model_that_is_added_to_the_lists_walks_alone(walks, scripts, monkeypatch):
    first = walks()
    real = scripts.model_walks.models_of
    more = {"another": {"koopman.model": "planted"}}
    monkeypatch.setattr(scripts.model_walks, "models_of", lambda *a: real(*a) | more)
    assert 0 < len(walks()) < len(first)


def test_walks_with_another_or_a_retrained_residual_are_refused(walks, capsys, tmp_path):
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
    assert "residual" in refusal(capsys, walks, "--residual", other)
    train(one, 3e-3)
    assert "residual" in refusal(capsys, walks, "--residual", one)


def test_walks_of_other_code_are_refused(walks, scripts, monkeypatch, capsys):
    walks()
    monkeypatch.setattr(scripts.model_walks, "code_version", lambda *files: "other")
    assert "other code" in refusal(capsys, walks)


# ---------------------------------------------------------------- recordings


@pytest.fixture
def record(scripts, monkeypatch, tmp_path):
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
        assert len(scripts.whole_body_recordings.record(kind, args, tmp_path)) == robots
        return sum(count)

    return call


def test_recordings_are_found_again(record):
    assert record() == 3
    assert record() == 0


def test_recordings_of_other_code_are_refused_and_kept(
    record, scripts, monkeypatch, capsys, tmp_path
):
    record()
    before = (tmp_path / "episodes_trot.npz").read_bytes()
    monkeypatch.setattr(scripts.whole_body_recordings, "code_version", lambda *files: "other")
    assert "another config or other code" in refusal(capsys, record)
    assert (tmp_path / "episodes_trot.npz").read_bytes() == before


def test_recordings_of_another_config_are_refused_and_kept(record, capsys, tmp_path):
    record()
    before = (tmp_path / "episodes_trot.npz").read_bytes()
    assert "another config or other code" in refusal(capsys, lambda: record(robots=4))
    assert (tmp_path / "episodes_trot.npz").read_bytes() == before


@pytest.mark.parametrize("length", [0, 10, 1000])
def test_a_recording_that_is_cut_off_is_named(record, capsys, tmp_path, length):
    record()
    path = tmp_path / "episodes_trot.npz"
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
def drawn(scripts, tmp_path):
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
    return lambda text: scripts.sweep.draw(config(text), tmp_path, str(file))


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


# ---------------------------------------------------------------- the table of the paper's results


def test_a_fit_of_another_config_does_not_stay_on_the_page(scripts, monkeypatch):
    module = scripts.reproduce
    args = SimpleNamespace(quick=False, only=["trot_velocity"], bases=("planar",))
    one = {"config": module.config_hash(module._fit_config(quick=False))}
    before = {"quick": False, "experiments": {module.FIT: one}}
    assert module._kept(before, args) == {module.FIT: one}
    real = module._fit_config
    monkeypatch.setattr(
        module, "_fit_config",
        lambda *, quick: dataclasses.replace(real(quick=quick), test_seed=7),
    )  # fmt: skip
    assert module._kept(before, args) == {}
    assert json.dumps(one)
