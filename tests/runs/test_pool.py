"""Many episodes: what is finished is kept, what is kept is not repeated, what changed is."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from kjax.config import PushConfig, RunConfig, load_config
from kjax.prediction import storage
from kjax.runs import pool
from kjax.runs.cache import Cache
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.metrics import metrics
from kjax.sim.resolve import batch_spec, resolve_episode, resolve_goal
from kjax.types import Mode

SHORT = {
    "sim.base": "planar",
    "duration": 0.7,
    "command.times": [0.0, 0.3],
    "command.v_x": [0.0, 0.2],
}
WALL = {"plan_ms_median", "plan_ms_p99", "act_ms_median", "act_ms_p99", "realtime_factor"}


@pytest.fixture(scope="module")
def config():
    return load_config(
        RunConfig, None, SHORT | {"gait.names": ["trot", "bound"], "gait.times": [0.0, 0.5]}
    )


@pytest.fixture(scope="module", autouse=True)
def simulation(config):
    """Built once; the runner finds it where a worker would have left it."""
    pool._engines.clear()
    return pool._engine(batch_spec(config))


def seeds(config, count):
    return [dataclasses.replace(config, seed=seed) for seed in range(count)]


def without_times(results):
    return [{k: v for k, v in result.items() if k not in WALL} for result in results]


def test_killed_and_resumed_equals_uninterrupted(config, tmp_path, monkeypatch):
    chosen = seeds(config, 3)
    with pool.open_runner(Cache(tmp_path / "whole")) as run:
        expected = run(chosen)

    real, started = pool.simulate, []

    def killed(simulation, episode, on_tick=None):
        if len(started) == 2:
            raise KeyboardInterrupt
        started.append(int(episode.params.seed))
        return real(simulation, episode)

    monkeypatch.setattr(pool, "simulate", killed)
    with pytest.raises(KeyboardInterrupt), pool.open_runner(Cache(tmp_path)) as go:
        go(chosen)
    assert len(Cache(tmp_path)) == 2
    started[:] = [None]
    with pool.open_runner(Cache(tmp_path)) as go:
        resumed = go(chosen)
        assert started == [None, 2]
        assert go(chosen) == resumed  # finished: nothing runs, or `killed` would have ended it
    assert without_times(resumed) == without_times(expected)
    assert pool.cached_runner(Cache(tmp_path))(chosen) == resumed


def test_a_runner_that_reads_only_says_what_is_missing(config, tmp_path):
    with pytest.raises(KeyError):
        pool.cached_runner(Cache(tmp_path))(seeds(config, 1))


def test_another_config_is_another_episode(config, tmp_path):
    cache = Cache(tmp_path)
    with pool.open_runner(cache) as run:
        run(seeds(config, 1))
        run([dataclasses.replace(config, push=PushConfig(times=(0.2,), forward=1.0))])
    assert len(cache) == 2


def retrain(path, value):
    spread = np.full((len(Mode), 6), value)
    return storage.save(
        path, storage.Stored("residual", 0.005, np.zeros((len(Mode), 6, 17)), spread)
    )


def with_file(path):
    return load_config(
        RunConfig,
        None,
        {
            "koopman.model": "residual",
            "koopman.file": str(path),
            "koopman.dataset.dt": 0.005,
            "lmpc.model_dt": 0.005,
        },
    )


def test_a_program_is_compiled_anew_from_a_retrained_model(tmp_path, monkeypatch):
    built = []
    monkeypatch.setattr("kjax.sim.engines.mujoco.build_program", lambda c, *a, **k: built.append(c))
    config = with_file(retrain(tmp_path / "model.npz", 1e-3))
    engine = MujocoEngine(batch_spec(config))
    for value, count in ((1e-3, 1), (2e-3, 2), (2e-3, 2)):
        retrain(tmp_path / "model.npz", value)
        engine.program(resolve_episode(config))
        assert len(built) == count


def test_a_call_ends_when_enough_is_known(config, tmp_path):
    cache = Cache(tmp_path)
    with pool.open_runner(cache) as run:
        results = run(seeds(config, 3), enough=lambda results: len(results) >= 1)
    assert [result is None for result in results] == [False, True, True]


def test_a_call_of_which_enough_is_kept_runs_nothing(config, tmp_path, monkeypatch):
    cache = Cache(tmp_path)
    chosen = seeds(config, 3)
    cache.add({cache.key(chosen[1]): {"interrupted": False}})
    monkeypatch.setattr(pool, "_episode", lambda *a: pytest.fail("an episode was run"))
    with pool.open_runner(cache) as run:
        results = run(chosen, enough=lambda results: len(results) >= 1)
    assert [result is None for result in results] == [True, False, True]


def test_what_is_recorded_of_a_run_is_made_again_where_it_is_missing(config, tmp_path):
    cache = Cache(tmp_path)
    (one,) = seeds(config, 1)

    def record(run, path):
        np.savez(path, x=run.x)

    with pool.open_runner(cache, record=record) as run:
        run([one])
        file = cache.path(cache.key(one), ".npz")
        assert np.load(file)["x"].shape == (700, 6)
        file.unlink()
        run([one])
        assert file.exists()


def test_one_simulation_serves_other_requests_speeds_frictions_and_pushes(config, simulation):
    """As if it had been built for them; the compiled calls are the same."""
    other = load_config(
        RunConfig,
        None,
        {
            "sim.base": "planar",
            "duration": 0.7,
            "seed": 4,
            "command.times": [0.0, 0.1],
            "command.v_x": [0.1, 0.3],
            "gait.names": ["trot", "bound"],
            "gait.times": [0.0, 0.4],
            "sim.friction": 0.6,
            "push.times": [0.2],
            "push.forward": 1.0,
        },
    )
    shared, own = (
        simulate(simulation, resolve_episode(other)),
        simulate(MujocoEngine(batch_spec(other)), resolve_episode(other)),
    )
    assert shared.time[np.argmax(np.diff(shared.gait) != 0)] == pytest.approx(0.399)
    # 1e-9: constants that the compiler folds in one of the two round differently
    np.testing.assert_allclose(shared.qpos, own.qpos, atol=1e-9)
    np.testing.assert_allclose(shared.velocity_command, own.velocity_command, atol=1e-12)
    first, second = metrics(shared, resolve_goal(other)), metrics(own, resolve_goal(other))
    assert first["fell"] == second["fell"]


def test_a_config_that_needs_another_engine_is_refused(config, simulation):
    longer = dataclasses.replace(config, lmpc=dataclasses.replace(config.lmpc, horizon=7))
    with pytest.raises(ValueError, match=r"controller\.horizon is 7, the engine's 6"):
        simulate(simulation, resolve_episode(longer))


PARENT = """
import multiprocessing, os, signal
from concurrent.futures import ProcessPoolExecutor
from kjax.runs import pool
from kjax.runs.cache import Cache

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    shared = context.Value("i", 0), context.RawValue("i", 0)
    pool = ProcessPoolExecutor(1, context, initializer=pool._begin_worker, initargs=shared)
    print(pool.submit(os.getpid).result(), flush=True)
    signal.pause()
"""


def test_workers_end_when_their_parent_is_killed(tmp_path, repository):
    script = tmp_path / "parent.py"
    script.write_text(PARENT, encoding="utf-8")
    env = {**os.environ, "PYTHONPATH": str(repository)}
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=env)
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline and is_alive(worker):
        time.sleep(0.05)
    ended = not is_alive(worker)
    if not ended:
        os.kill(worker, signal.SIGKILL)
    assert ended


def is_alive(process):
    """Whether it runs; one that nobody has waited for yet is no more."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{process}/stat")
    return not (status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z")
