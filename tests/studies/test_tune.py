import json
import os
import subprocess
import sys

import pytest

from kjax import RunConfig, load_config

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tune(repository):
    """Run tune.py with these words."""

    def call(*words):
        return subprocess.run(
            [sys.executable, os.fspath(repository / "experiments" / "tune.py"), *words],
            capture_output=True,
            text=True,
            cwd=repository,
            env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(repository / ".cache" / "jax")},
            timeout=900,
        )

    return call


SMALL = (
    "configs/trot_velocity_long.toml", "--seconds", "0.2", "--scenarios", "2", "--held-out", "2",
    "--updates", "5", "--worsen", "3", "--seeds", "2", "--duration", "0.6",
    "--command.times", "[0.0]", "--command.v_x", "[0.2]",
)  # fmt: skip


def test_a_tuning_leaves_a_config_a_verdict_and_pictures_and_is_not_done_twice(tune, tmp_path):
    done = tune(*SMALL, "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert set(record["mujoco"]) == {"own", "start", "gradient"}
    assert all(entry["runs"] == 2 for entry in record["mujoco"].values())
    assert record["held_out_cost"]["gradient"] <= record["held_out_cost"]["start"]
    assert record["descent"]["updates"] == 5
    assert len(record["values"]["start"]["lmpc.Q"]) == 6
    assert {p.name for p in tmp_path.iterdir()} >= {"tuned.toml", "table.md", "figure.png"}
    tuned = load_config(RunConfig, tmp_path / "tuned.toml")
    assert list(tuned.lmpc.Q) == pytest.approx(record["values"]["gradient"]["lmpc.Q"])
    # Again: the descent is found. Other speeds are another tuning, and leave the first one.
    assert len(list((tmp_path / "cache").iterdir())) == 1
    assert tune(*SMALL, "--out", str(tmp_path)).returncode == 0
    assert len(list((tmp_path / "cache").iterdir())) == 1
    other = tune(*SMALL, "--command.v_x", "[0.1]", "--out", str(tmp_path))
    assert other.returncode == 0, other.stderr
    assert len(list((tmp_path / "cache").iterdir())) == 2


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--keys", "lmpc.weights"], "--keys: 'lmpc.weights' is no variable"),
        (["--scenarios", "0"], "--scenarios: got 0, wanted more than 0"),
        (["--sim.base", "free"], "wanted 'planar'"),
        (["--worsn", "3"], "did you mean --worsen"),
    ],
    ids=["key", "count", "base", "option"],
)
def test_a_mistake_is_one_line(tune, tmp_path, words, text):
    done = tune("configs/trot_velocity.toml", *words, "--out", str(tmp_path))
    assert done.returncode == 2
    assert text in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
