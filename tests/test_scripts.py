"""The scripts as a user runs them: what they leave, what they say to mistakes, interruption."""

import json
import os
import signal
import subprocess
import sys
import time
import tomllib

import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def script(repository):
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


def test_a_run_leaves_metrics_config_trajectory_and_figure(script, tmp_path):
    code, out, err = finish(
        script("closed_loop.py", "configs/trot_velocity.toml", "--duration", 1, "--out", tmp_path)
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


def test_ctrl_c_writes_what_was_simulated(script, tmp_path):
    process = script("closed_loop.py", "--duration", 2000, "--out", tmp_path)
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


def test_seeds_go_on_where_they_stopped(script, tmp_path):
    words = ("closed_loop.py", "--duration", 0.6, "--out", tmp_path, "--seeds")
    assert finish(script(*words, 1))[0] == 0
    first = json.loads((tmp_path / "seeds.json").read_text())
    code, out, err = finish(script(*words, 2))
    assert code == 0, err
    both = json.loads((tmp_path / "seeds.json").read_text())
    assert both["seeds"]["0"] == first["seeds"]["0"]  # wall times included: it was not run again
    assert set(both["seeds"]) == {"0", "1"}
    assert both["runs"] == 2
    assert "2 runs, 0 falls" in out


def test_a_mistake_is_one_line_and_exit_code_2(script):
    for words, part in (
        (("closed_loop.py", "configs/trot_velocty.toml"), "did you mean"),
        (("closed_loop.py", "--lmpc.horizon", 0), "greater than 0"),
        (("closed_loop.py", "--seeds", 0), "at least 1"),
        (("closed_loop.py", "--out", "/dev/null/x"), "cannot be written"),
        (("koopman_fit.py", "--test_stats", 3), "did you mean --test_states"),
        (("benchmark.py", "speed"), "controller"),
    ):
        code, _, err = finish(script(*words))
        assert code == 2, (words, err)
        assert err.count("\n") == 1, err
        assert part in err


def test_the_fit_study_reports_all_statistics(script, tmp_path):
    code, out, err = finish(script("koopman_fit.py", "--scales", "[1.0, 0.1]", "--out", tmp_path))
    assert code == 0, err
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    for mode in ("trot", "front", "rear"):
        assert set(metrics["error_at_end"][mode]) == {"mean", "variance", "std", "max"}
        assert metrics["fit"][mode]["rank"] == 19
        assert metrics["error_at_end"][mode]["variance"]["v_x"] == pytest.approx(
            metrics["error_at_end"][mode]["std"]["v_x"] ** 2
        )
    assert (tmp_path / "figure.png").exists()
    assert "within 0.0001" in out
