"""Sweeps with a stand-in for the engine: chunks, resuming, refusals, kills."""

import dataclasses
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from kjax.config import ConfigError, SweepConfig, load_config
from kjax.prediction import storage
from kjax.runs.cache import CacheError, lock
from kjax.runs.sweeps import runner
from kjax.runs.sweeps.runner import chunks_of, run_sweep
from kjax.types import Mode

SWEEP = """
base = "walk.toml"
seeds = 5
chunk = 4
[axes.speed]
values = [0.1, 0.3]
unit = "m/s"
[set]
"sim.contacts" = "feet"
"duration" = 0.8
"command.times" = [0.0]
"command.v_x" = ["= speed"]
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "walk.toml").write_text("[lmpc]\nfriction = inf\ntorque_fraction = inf\n")
    path = tmp_path / "sweep.toml"
    path.write_text(SWEEP)
    return path


@pytest.fixture
def calls(monkeypatch):
    """Seeds of every chunk that a stand-in engine walked; it stops at the chunk ``stop_at``."""
    log = SimpleNamespace(chunks=[], stop_at=None)

    class Engine:
        def run(self, episodes, on_progress):
            if log.stop_at == len(log.chunks):
                raise KeyboardInterrupt
            seeds = [int(one.params.seed) for one in episodes]
            log.chunks.append(seeds)
            rows = [
                {"fell": seed == 3, "velocity_rmse_mps": float(one.goal.command.values[0, 0])}
                | ({} if seed == 3 else {"pitch_max_deg": float(seed)})
                for seed, one in zip(seeds, episodes, strict=True)
            ]
            return SimpleNamespace(interrupted=False, metrics=lambda: iter(rows))

    monkeypatch.setattr(runner, "build_engine", lambda sweep, spec, threads: Engine())
    return log


def walk(file, folder, **more):
    return run_sweep(load_config(SweepConfig, file), file, folder, **more)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('torques = "held"\n', r"sim\.delay must be a multiple of lmpc\.control_dt 0\.005"),
        ('engine = "mjx"\n', r"MJX needs sim\.contacts = 'feet'.*got 'all'"),
    ],
)
def test_what_the_engine_cannot_walk_is_refused_before_anything_is_written(
    file, tmp_path, line, message
):
    text = SWEEP.replace('"feet"', '"all"') if "mjx" in line else SWEEP + '"sim.delay" = 0.002\n'
    file.write_text(line + text)
    with pytest.raises(ConfigError, match=message):
        run_sweep(load_config(SweepConfig, file), file, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_dataset_has_every_case_in_its_place(file, tmp_path, calls):
    data = walk(file, tmp_path / "out")
    assert data["fell"].dims == ("speed", "seed")
    np.testing.assert_array_equal(data["fell"].sel(seed=3), [1, 1])
    assert float(data["fell"].sum()) == 2
    np.testing.assert_array_equal(data["velocity_rmse_mps"].sel(speed=0.3), 0.3)
    assert np.isnan(data["pitch_max_deg"].sel(seed=3)).all()
    assert data["velocity_rmse_mps"].attrs["units"] == "m/s"
    assert data["speed"].attrs["units"] == "m/s"
    for key in ("sweep", "base", "provenance"):
        assert key in data.attrs
    assert [len(chunk) for chunk in calls.chunks] == [4, 4, 4]  # the last one is filled up
    with xr.open_dataset(tmp_path / "out" / "sweep.nc") as kept:
        assert kept.identical(data)


def test_an_interrupted_sweep_goes_on_and_a_finished_one_does_nothing(file, tmp_path, calls):
    whole = walk(file, tmp_path / "whole")
    calls.chunks.clear()
    calls.stop_at = 2
    with pytest.raises(KeyboardInterrupt):
        walk(file, tmp_path / "out")
    calls.stop_at = None
    data = walk(file, tmp_path / "out")
    assert len(calls.chunks) == 3
    xr.testing.assert_equal(data, whole)
    calls.chunks.clear()
    xr.testing.assert_equal(walk(file, tmp_path / "out"), whole)
    assert calls.chunks == []


def test_another_config_walks_anew_and_what_was_finished_stays(file, tmp_path, calls):
    first = walk(file, tmp_path / "out")
    file.write_text(SWEEP.replace("0.8", "0.9"))
    calls.chunks.clear()
    walk(file, tmp_path / "out")
    assert len(calls.chunks) == 3
    file.write_text(SWEEP)
    calls.chunks.clear()
    xr.testing.assert_equal(walk(file, tmp_path / "out"), first)
    assert calls.chunks == []
    walk(file, tmp_path / "out", fresh=True)
    assert len(calls.chunks) == 3


def test_more_seeds_walk_only_what_is_new(file, tmp_path, calls):
    walk(file, tmp_path / "out")
    calls.chunks.clear()
    file.write_text(SWEEP.replace("seeds = 5", "seeds = 9"))
    data = walk(file, tmp_path / "out")
    assert data.sizes["seed"] == 9
    assert {seed for chunk in calls.chunks for seed in chunk} >= set(range(5, 9))
    assert len(calls.chunks) < 5


def test_a_retrained_model_under_the_same_name_walks_anew(file, tmp_path, calls):
    model = tmp_path / "model.npz"

    def train(value):
        spread = np.full((len(Mode), 6), value)
        storage.save(model, storage.Stored("residual", 0.005, np.zeros((len(Mode), 6, 17)), spread))

    train(1e-3)
    keys = (
        f'"koopman.model" = "residual"\n"koopman.file" = "{model}"\n"koopman.dataset.dt" = 0.005\n'
    )
    file.write_text(SWEEP + keys + '"lmpc.model_dt" = 0.005\n')
    walk(file, tmp_path / "out")
    calls.chunks.clear()
    walk(file, tmp_path / "out")
    assert calls.chunks == []
    train(2e-3)
    walk(file, tmp_path / "out")
    assert len(calls.chunks) == 3


def test_other_code_walks_anew(file, tmp_path, calls, monkeypatch):
    walk(file, tmp_path / "out")
    monkeypatch.setattr("kjax.runs.cache.code_version", lambda *files: "other")
    calls.chunks.clear()
    walk(file, tmp_path / "out")
    assert len(calls.chunks) == 3


def test_a_damaged_chunk_is_named_and_only_it_is_repeated(file, tmp_path, calls):
    whole = walk(file, tmp_path / "out")
    path = sorted((tmp_path / "out" / "cache").iterdir())[1]
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(CacheError, match=rf"{path.name}: damaged"):
        walk(file, tmp_path / "out")
    path.unlink()
    calls.chunks.clear()
    xr.testing.assert_equal(walk(file, tmp_path / "out"), whole)
    assert len(calls.chunks) == 1


def test_two_runs_on_one_folder_are_refused(file, tmp_path, calls):
    with lock(tmp_path / "out"), pytest.raises(CacheError, match="in use by another run"):
        walk(file, tmp_path / "out")


def test_a_full_disk_at_the_end_keeps_what_was_finished(file, tmp_path, calls, monkeypatch):
    def full(self, path, **more):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", full)
    with pytest.raises(CacheError, match="No space left on device"):
        walk(file, tmp_path / "out")
    monkeypatch.undo()
    assert [path.name for path in (tmp_path / "out").iterdir() if path.is_file()] == [".lock"]
    assert len(list((tmp_path / "out" / "cache").iterdir())) == 3


def test_processes_share_the_chunks(file, tmp_path, calls):
    whole = walk(file, tmp_path / "whole")
    calls.chunks.clear()
    shared = tmp_path / "out"
    assert walk(file, shared, process=0, processes=1) is not None
    shutil.rmtree(shared / "cache")
    calls.chunks.clear()

    def second(name):
        if name == "opened" and not calls.chunks:
            calls.chunks.append("second")
            assert walk(file, shared, process=1, processes=2) is None

    data = walk(file, shared, process=0, processes=2, barrier=second)
    xr.testing.assert_equal(data, whole)
    assert len(calls.chunks) == 4  # three of them, and the word


def test_chunks_do_not_mix_what_cannot_walk_together(file):
    sweep = load_config(SweepConfig, file)
    cases = runner.plan(sweep, file).cases
    longer = [dataclasses.replace(case, duration=2.0) for case in cases[:3]]
    made = chunks_of([*cases, *longer], 4)
    assert [chunk.cases.tolist() for chunk in made] == [
        [0, 1, 2, 3], [4, 5, 6, 7], [8, 9], [10, 11, 12]
    ]  # fmt: skip
    assert [len(chunk.configs) for chunk in made] == [4, 4, 4, 3]


# A sweep whose engine is a stand-in that takes its time over a chunk.
STUB = """
import time
from types import SimpleNamespace
from kjax import cli
from kjax.runs.sweeps import runner
from kjax.studies.sweep import main

class Engine:
    def run(self, episodes, on_progress):
        time.sleep(0.1)
        rows = [
            {"fell": False, "velocity_rmse_mps": int(e.params.seed) + e.goal.command.values[0, 0]}
            for e in episodes
        ]
        return SimpleNamespace(interrupted=False, metrics=lambda: iter(rows))

runner.build_engine = lambda sweep, spec, threads: Engine()
if __name__ == "__main__":
    cli.run(main)
"""


@pytest.mark.slow
def test_a_sweep_killed_three_times_equals_one_that_was_not(file, tmp_path, repository):
    """Processes that are killed without warning, while a chunk is walked or kept."""
    script = tmp_path / "stub.py"
    script.write_text(STUB)
    file.write_text(SWEEP.replace("seeds = 5", "seeds = 16").replace("chunk = 4", "chunk = 2"))
    environment = {**os.environ, "PYTHONPATH": str(repository)}

    def start():
        return subprocess.Popen(
            [sys.executable, str(script), str(file), "--out", str(tmp_path / "out")],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment,
        )  # fmt: skip

    chunks = tmp_path / "out" / "cache"
    for kill in (3, 6, 9):
        process = start()
        while process.poll() is None and len(list(chunks.glob("*.json"))) < kill:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        text, _ = process.communicate()
        assert process.returncode == -signal.SIGKILL, text
    assert 9 <= len(list(chunks.glob("*.json"))) < 16
    last = start()
    text, _ = last.communicate(timeout=300)
    assert last.returncode == 0, text
    assert "chunks are there already" in text
    with xr.open_dataset(tmp_path / "out" / "sweep.nc") as data:
        expected = data["seed"] + data["speed"]  # as the stand-in has it
        xr.testing.assert_equal(data["velocity_rmse_mps"].drop_attrs(),
                                expected.transpose("speed", "seed"))  # fmt: skip
        assert not data["fell"].any()


@pytest.mark.slow
def test_two_processes_over_jax_distributed_equal_one(file, tmp_path, repository):
    script = repository / "experiments" / "sweep.py"

    def start(folder, *more):
        return subprocess.Popen(
            [sys.executable, str(script), str(file), "--threads", "1", "--out", str(folder), *more],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    alone = [start(tmp_path / "one")]
    pair = [
        start(tmp_path / "two", "--coordinator", address, "--processes", "2",
              "--process", str(number))
        for number in range(2)
    ]  # fmt: skip
    for process in (*alone, *pair):
        text, _ = process.communicate(timeout=400)
        assert process.returncode == 0, text
    with (
        xr.open_dataset(tmp_path / "one" / "sweep.nc") as one,
        xr.open_dataset(tmp_path / "two" / "sweep.nc") as two,
    ):
        xr.testing.assert_equal(one.drop_attrs(), two.drop_attrs())
