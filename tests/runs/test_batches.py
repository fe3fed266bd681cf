"""Episodes on the batch engine: chunks are kept, what is kept is not repeated. A stand-in walks."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from kjax.config import RunConfig, load_config
from kjax.runs import batches
from kjax.runs.cache import Cache


@pytest.fixture
def calls(monkeypatch):
    """Seeds that the stand-in engine walked, chunk by chunk; it stops at the chunk ``stop_at``."""
    log = SimpleNamespace(chunks=[], engines=[], names=[], stop_at=None)

    class Engine:
        def __init__(self, spec, *, torques, threads, dtype):
            log.engines.append((torques, threads, np.dtype(dtype)))
            self.torques = torques

        def run(self, episodes):
            stopped = log.stop_at == len(log.chunks)
            log.chunks.append([int(one.params.seed) for one in episodes])
            held = self.torques == "held"
            rows = [{"fell": False, "seed": int(one.params.seed), "held": held} for one in episodes]
            return SimpleNamespace(
                interrupted=stopped, metrics=lambda: iter(rows), trajectory=lambda i: rows[i]
            )

    def get_engine(name):
        log.names.append(name)
        return Engine

    monkeypatch.setattr(batches, "get_engine", get_engine)
    return log


@pytest.fixture
def cache(tmp_path):
    return Cache(tmp_path)


@pytest.fixture(scope="module")
def configs():
    config = load_config(RunConfig, None, {"duration": 1.0})
    return [dataclasses.replace(config, seed=seed) for seed in range(7)]


def seeds(rows):
    return [row["seed"] for row in rows]


def test_all_chunks_have_one_number_of_robots_and_results_keep_their_order(cache, configs, calls):
    rows = batches.run_batch(cache, configs, torques="held", chunk=3, threads=2)
    assert seeds(rows) == list(range(7))
    assert calls.chunks == [[0, 1, 2], [3, 4, 5], [6, 6, 6]]
    assert calls.engines == [("held", 2, np.dtype("float64"))]


def test_ctrl_c_keeps_finished_chunks_and_the_same_call_goes_on(cache, configs, calls, tmp_path):
    calls.stop_at = 1
    with pytest.raises(KeyboardInterrupt):
        batches.run_batch(cache, configs, torques="held", chunk=3)
    calls.stop_at = None
    again = Cache(tmp_path)
    calls.chunks.clear()
    assert seeds(batches.run_batch(again, configs, torques="held", chunk=3)) == list(range(7))
    assert calls.chunks == [[3, 4, 5], [6, 6, 6]]
    calls.chunks.clear()
    batches.run_batch(again, configs, torques="held", chunk=3)
    assert calls.chunks == []


def test_what_one_engine_walked_is_no_result_of_another(cache, configs, calls):
    batches.run_batch(cache, configs[:2], torques="held")
    batches.run_batch(cache, configs[:2], torques="held", engine="mjx")
    batches.run_batch(cache, configs[:2], torques="held", engine="mjx")
    assert calls.names == ["mujoco_batch", "mjx"]
    assert calls.chunks == [[0, 1], [0, 1]]


def test_torques_held_and_at_every_step_are_other_episodes(cache, configs, calls):
    held = batches.run_batch(cache, configs, torques="held")
    every = batches.run_batch(cache, configs, torques="every_step")
    assert all(row["held"] for row in held)
    assert not any(row["held"] for row in every)
    assert not any(cache.key(config) in cache for config in configs)  # those of single runs


def test_what_is_recorded_is_made_again_where_it_is_missing(cache, configs, calls, tmp_path):
    def record(run, path):
        path.write_text(str(run["seed"]))

    def call():
        calls.chunks.clear()
        batches.run_batch(cache, configs, torques="held", record=record, recorded=2)
        return calls.chunks

    assert call() == [list(range(7))]
    files = [cache.path(batches.batch_key(cache, config, "held"), ".npz") for config in configs]
    assert [file.exists() for file in files] == [True] * 2 + [False] * 5
    assert files[1].read_text() == "1"
    assert call() == []
    files[1].unlink()
    assert call() == [[1]]
    assert files[1].read_text() == "1"
