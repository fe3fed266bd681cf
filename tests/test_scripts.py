"""Every script in experiments/: it has help, refuses mistakes in one line, starts as a program.

Two tests start one as a user does; all others, here and in tests/studies and tests/bench, run in
this process through ``main``.
"""

import json
import os
import runpy
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

PLANAR = str(Path(__file__).parents[1] / "configs" / "trot_velocity.toml")
SCRIPTS = sorted((Path(__file__).parents[1] / "experiments").glob("*.py"))
# Script -> words that are a mistake, and what is said of them; of a new one any unknown option.
UNKNOWN = (["--nothing-of-that-name"], "--nothing-of-that-name")
MISTAKES = {
    "benchmark": (["speed"], "which benchmark? one of: controller, qp,"),
    "closed_loop": (["configs/trot_velocty.toml"], "did you mean"),
    "envelope": (["--only", "speed"], "wanted some of speed_trot"),
    "invariance": (["--residual", "nowhere.npz"], "--residual: no file nowhere.npz"),
    "koopman_fit": (["--test_stats", "3"], "did you mean --test_states"),
    "koopman_study": (["--whole-body", "nowhere"], "--whole-body: no results of whole_body.py"),
    "learn_control": (["--updates", "0"], "--updates: got 0, wanted more than 0"),
    "model_walks": (["--draw"], "--draw: no metrics.json in"),
    "raw_steps": (["--threads", "0"], "--threads: got 0, wanted at least 1"),
    "reproduce": (["--only", "trott"], "--only: got 'trott', wanted some of koopman_fit"),
    "sweep": (["nowhere.toml"], "nowhere.toml"),
    "tune": ([PLANAR, "--keys", "lmpc.weights"], "--keys: 'lmpc.weights' is no variable"),
    "whole_body": (["--robots", "3"], "--robots: got 3, wanted at least 10"),
}


@pytest.fixture(scope="module")
def main_of():
    """The ``main`` that a script's file has."""
    return lambda script: runpy.run_path(str(script))["main"]


def test_the_scripts_that_have_a_mistake_here_are_there():
    assert {script.stem for script in SCRIPTS} >= set(MISTAKES)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_an_unknown_option_is_one_line_and_exit_code_2(script, main_of, call, capsys):
    words, said = UNKNOWN
    first = {"benchmark": ["qp"], "sweep": ["sweep.toml"]}.get(script.stem, [])
    assert call(main_of(script), *first, *words) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1, err
    assert said in err


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_is_thin_and_names_its_command(script):
    text = script.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 20
    assert f"\n    python experiments/{script.name}" in text


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_help_ends_well(script, main_of, call, capsys):
    assert call(main_of(script), "--help") == 0
    out, err = capsys.readouterr()
    assert out.startswith("usage: ")
    assert err == ""


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_mistake_is_one_line_and_exit_code_2(script, main_of, call, capsys, tmp_path):
    words, said = MISTAKES.get(script.stem, UNKNOWN)
    more = [] if script.stem == "benchmark" else ["--out", tmp_path]
    assert call(main_of(script), *words, *more) == 2
    out, err = capsys.readouterr()
    assert err.count("\n") == 1, err
    assert err.startswith("error: ")
    assert said in err
    assert out == ""


@pytest.mark.parametrize("name", ["closed_loop", "envelope", "koopman_fit", "raw_steps"])
def test_a_folder_that_cannot_be_written_to_is_one_line(name, repository, main_of, call, capsys):
    main = main_of(repository / "experiments" / f"{name}.py")
    assert call(main, "--out", "/dev/null/x") == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "--out /dev/null/x: cannot be written to" in err


@pytest.fixture
def start(repository):
    """Start a script as a user does."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(repository / ".cache" / "jax")}

    def start(name, *words):
        return subprocess.Popen(
            [sys.executable, str(repository / "experiments" / name), *map(str, words)],
            env=environment,
            cwd=repository,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


def finish(process):
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


@pytest.mark.slow
def test_a_run_leaves_metrics_config_trajectory_and_figure(start, tmp_path):
    code, out, err = finish(
        start("closed_loop.py", "configs/trot_velocity.toml", "--duration", 1, "--out", tmp_path)
    )
    assert code == 0, err
    assert {p.name for p in tmp_path.iterdir()} == {
        "metrics.json",
        "config.toml",
        "trajectory.npz",
        "figure.png",
    }
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["fell"] is False
    assert metrics["simulated_s"] == 1.0
    assert tomllib.loads((tmp_path / "config.toml").read_text())["duration"] == 1.0
    assert "velocity RMSE" in out
    assert str(tmp_path) in out


@pytest.mark.slow
def test_ctrl_c_writes_what_was_simulated(start, tmp_path):
    box = ("--lmpc.friction", "inf", "--lmpc.torque_fraction", "inf")
    process = start("closed_loop.py", "--duration", 2000, *box, "--out", tmp_path)
    assert "compiled" in process.stdout.readline()
    time.sleep(2)  # in the loop, far from its end
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == 130
    assert "Traceback" not in err
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["interrupted"] is True
    assert 0.0 < metrics["simulated_s"] < 2000.0
    assert (tmp_path / "figure.png").exists()
