"""The main script in this process, with stand-ins for what takes long."""

import importlib
import json
import sys

import numpy as np
import pytest
import xarray as xr


@pytest.fixture(scope="module")
def scripts(repository):
    sys.path.insert(0, str(repository / "experiments"))
    yield {name: importlib.import_module(name) for name in ("closed_loop", "sweep")}
    sys.path.remove(str(repository / "experiments"))


@pytest.fixture
def closed_loop(scripts, monkeypatch, standing_run):
    """The script; its runs stand still, are ``seconds`` long and interrupted where ``cut``."""
    module = scripts["closed_loop"]
    module.seconds, module.cut, module.compiled, module.walked = 2.0, False, 0, 0

    def build(config):
        module.compiled += 1
        return config

    def simulate(config, *_, **more):
        module.walked += 1
        return standing_run(config, module.seconds, interrupted=module.cut)

    monkeypatch.setattr(module.cli, "configure_jax", lambda **more: None)
    monkeypatch.setattr(module, "MujocoEngine", build)
    monkeypatch.setattr(module, "simulate", simulate)
    monkeypatch.setattr(
        "kjax.viz.plots.closed_loop_figure",
        lambda run, config, path, title="": path.write_text(title),
    )
    return module


def call(module, monkeypatch, *words):
    """Run the script with these words; its exit code."""
    monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, words)])
    try:
        module.main()
    except SystemExit as end:
        return end.code
    return 0


def test_an_interrupted_run_says_when_and_shows_no_metrics(
    closed_loop, monkeypatch, capsys, tmp_path
):
    closed_loop.cut = True
    assert call(closed_loop, monkeypatch, "--duration", 20.0, "--out", tmp_path) == 130
    out = capsys.readouterr().out
    assert "interrupted at 2.00 s of 20 s" in out
    assert "RMSE" not in out
    assert "s in all" not in out
    kept = json.loads((tmp_path / "metrics.json").read_text())
    assert kept == {
        "interrupted": True, "simulated_s": 2.0, "fell": False, "fall_time_s": None
    }  # fmt: skip
    assert "interrupted at 2.00 s" in (tmp_path / "figure.png").read_text()
    assert (tmp_path / "trajectory.npz").exists()


def test_a_whole_run_shows_its_metrics(closed_loop, monkeypatch, capsys, tmp_path):
    assert call(closed_loop, monkeypatch, "--duration", 2.0, "--out", tmp_path) == 0
    out = capsys.readouterr().out
    assert "velocity RMSE" in out
    assert "interrupted" not in out
    assert json.loads((tmp_path / "metrics.json").read_text())["velocity_rmse_mps"] == 0.0


def test_a_run_too_short_for_metrics_says_so(closed_loop, monkeypatch, capsys, tmp_path):
    closed_loop.seconds = 0.3
    assert call(closed_loop, monkeypatch, "--duration", 0.3, "--out", tmp_path) == 0
    assert "no metrics: the first 0.5 s" in capsys.readouterr().out


def test_an_interrupted_seed_is_not_kept(closed_loop, monkeypatch, capsys, tmp_path):
    words = ("--duration", 2.0, "--out", tmp_path, "--seeds", 2)
    closed_loop.cut = True
    assert call(closed_loop, monkeypatch, *words) == 130
    assert "interrupted in seed 0 at 2.00 s of 2 s" in capsys.readouterr().out
    assert not (tmp_path / "seeds.json").exists()
    closed_loop.cut = False
    assert call(closed_loop, monkeypatch, *words) == 0
    assert "2 runs, 0 falls" in capsys.readouterr().out


def test_seeds_of_another_config_walk_anew_and_finished_ones_stay(
    closed_loop, monkeypatch, capsys, tmp_path
):
    def seeds():
        return json.loads((tmp_path / "seeds.json").read_text())

    words = ("--out", tmp_path, "--seeds", 2, "--duration")
    assert call(closed_loop, monkeypatch, *words, 2.0) == 0
    before = seeds()
    assert list(before["seeds"]) == ["0", "1"]
    closed_loop.walked = 0
    closed_loop.seconds = 3.0
    assert call(closed_loop, monkeypatch, *words, 3.0) == 0
    assert closed_loop.walked == 2
    assert seeds()["seeds"]["0"]["simulated_s"] == 3.0
    closed_loop.walked = 0
    assert call(closed_loop, monkeypatch, *words, 2.0) == 0
    assert closed_loop.walked == 0  # the first ones are there still
    assert seeds()["seeds"] == before["seeds"]
    assert call(closed_loop, monkeypatch, *words, 2.0, "--restart") == 0
    assert closed_loop.walked == 2


def test_a_view_without_a_display_is_refused_before_anything_is_compiled(
    closed_loop, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr("glfw.init", lambda: False)
    assert call(closed_loop, monkeypatch, "--view", "--out", tmp_path / "run") == 2
    assert "no window can be opened here" in capsys.readouterr().err
    assert closed_loop.compiled == 0
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--view", "--seeds", 2), "--view: shows a single run"),
        (("--restart",), "--restart: belongs to --seeds"),
        (("--duration", 0.001), "duration is 0.001 s, shorter than lmpc.control_dt"),
    ],
)
def test_options_that_contradict_each_other_are_one_line(
    closed_loop, monkeypatch, capsys, words, said
):
    assert call(closed_loop, monkeypatch, *words) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert said in err
    assert closed_loop.compiled == 0


@pytest.mark.parametrize("script", ["closed_loop", "sweep"])
def test_a_config_of_another_kind_is_one_line_and_exit_code_2(
    scripts, monkeypatch, capsys, repository, script
):
    other = {"closed_loop": "sweeps/push_trot.toml", "sweep": "trot_velocity.toml"}[script]
    assert call(scripts[script], monkeypatch, repository / "configs" / other) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "which experiments/" in err


def test_a_sweep_says_what_success_is(scripts):
    cases = {"fell": ("case", [1.0, 0.0, 0.0]), "velocity_rmse_mps": ("case", [9.0, 0.1, 0.3])}
    line = scripts["sweep"].summary_line(xr.Dataset(cases))
    assert "3 episodes, 2 succeeded (stayed up), 1 fell; median RMSE of the others 0.2000" in line
    cases["crossed"] = ("case", [np.nan, 0.0, 0.0])
    line = scripts["sweep"].summary_line(xr.Dataset(cases))
    assert "0 succeeded (stayed up and crossed the field)" in line
    cases["fell"] = ("case", [1.0, 1.0, 1.0])
    assert "nan" not in scripts["sweep"].summary_line(xr.Dataset(cases))
