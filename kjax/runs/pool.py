"""Many episodes for the experiments: in worker processes, each kept as soon as it ends.

An episode is a ``RunConfig``. Its result is kept in a ``Cache``; so the same command goes on where
it stopped, does nothing when all is there, and repeats what another config or other code would
change.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from kjax import cli
from kjax.config import RunConfig
from kjax.prediction.kind import ModelKind, get_kind
from kjax.robots import Robot, get_robot
from kjax.runs.cache import Cache
from kjax.sim.engines.mujoco import MujocoEngine, OnTick, simulate
from kjax.sim.episode import BatchSpec
from kjax.sim.metrics import metrics
from kjax.sim.resolve import resolve_episode
from kjax.sim.trajectory import Trajectory

# Called in the worker with each finished run and the file that belongs to it.
Record = Callable[[Trajectory, Path], None]
# Results in the order of the configs, None where ``enough`` ended the call before.
Run = Callable[..., list[dict[str, Any] | None]]
Task = tuple[str, tuple[RunConfig, Record | None, Path]]  # key, arguments of ``_episode``


@contextmanager
def open_runner(cache: Cache, *, jobs: int = 1, record: Record | None = None) -> Iterator[Run]:
    """A function that runs episodes and keeps each in the cache.

    ``run(configs, label="", enough=None)`` returns the metrics of each config; what is in the
    cache is not run again. ``enough(results so far) -> bool`` ends a call early. On Ctrl-C what
    is finished is kept, and KeyboardInterrupt raised.

    Args:
      cache: of results.
      jobs: worker processes, one core each; 1 runs in this process.
      record: called with each run and the path of a file of its own.
    """
    if jobs == 1:
        yield lambda configs, **more: _run(cache, configs, _here, record, **more)
        return
    context = multiprocessing.get_context("spawn")  # JAX's threads do not survive a fork
    workers, call = context.Value("i", 0), context.RawValue("i", 0)
    pool = ProcessPoolExecutor(jobs, context, initializer=_begin_worker, initargs=(workers, call))
    execute = partial(_in_pool, pool, call)
    try:
        yield lambda configs, **more: _run(cache, configs, execute, record, **more)
    finally:
        pool.shutdown(cancel_futures=True)


def cached_runner(cache: Cache) -> Run:
    """A function as of ``open_runner`` that runs nothing; ``KeyError`` for a missing result."""

    def nothing(tasks: list[Task]) -> Iterator[tuple[str, dict[str, Any]]]:
        raise KeyError(tasks[0][0])

    return lambda configs, **more: _run(cache, configs, nothing, None, **more)


def _run(
    cache: Cache,
    configs: Sequence[RunConfig],
    execute: Callable[[list[Task]], Iterator[tuple[str, dict[str, Any]]]],
    record: Record | None,
    *,
    label: str = "",
    enough: Callable[[list[dict[str, Any]]], bool] | None = None,
) -> list[dict[str, Any] | None]:
    """See ``open_runner``; ``execute`` yields (key, metrics) of tasks as they end."""
    keys = [cache.key(config) for config in configs]
    files = [cache.path(key, ".npz") for key in keys]
    results = {
        key: cache[key]
        for key, file in zip(keys, files, strict=True)
        if key in cache and (record is None or file.exists())
    }
    tasks = [
        (key, (config, record, file))
        for key, config, file in zip(keys, configs, files, strict=True)
        if key not in results
    ]
    if enough is not None and results and enough(list(results.values())):
        tasks = []  # as the call before found that kept them
    with tqdm(
        total=len(keys), initial=len(results), desc=label, unit="episode", disable=None, leave=False
    ) as bar:
        for key, result in execute(tasks) if tasks else ():
            results[key] = result
            cache.add({key: result})
            bar.update()
            if enough is not None and enough(list(results.values())):
                break
    return [results.get(key) for key in keys]


def _here(tasks: list[Task]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Run tasks one after the other in this process."""
    for key, task in tasks:
        result = _episode(*task)
        if result["interrupted"]:
            raise KeyboardInterrupt
        yield key, result


def _in_pool(
    pool: ProcessPoolExecutor, call: Any, tasks: list[Task]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Run tasks in worker processes; what is not done when the caller stops is given up.

    ``call`` is a number that the workers see: once it has moved on, they drop what they do.
    """
    number = call.value
    futures = {pool.submit(_episode_of_call, number, *task): key for key, task in tasks}
    try:
        for future in as_completed(futures):
            if future.result()["interrupted"]:  # Ctrl-C reaches workers too, and may come first
                raise KeyboardInterrupt
            yield futures[future], future.result()
    finally:
        call.value += 1
        for future in futures:
            future.cancel()


_call: Any = None  # in a worker: the number of the parent's present call


def _begin_worker(workers: Any, call: Any) -> None:
    """Give a worker process a core of its own, and leave Ctrl-C to its parent; end with it."""
    global _call
    _call = call
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with workers.get_lock():
        number = workers.value
        workers.value += 1
    cli.configure_jax(one_core=True, core=number)


def _end_with_parent() -> None:
    """End this worker when its parent was killed: it would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # a worker has one
    parent.join()
    os._exit(1)


def _episode_of_call(
    number: int, config: RunConfig, record: Record | None, path: Path
) -> dict[str, Any]:
    """Run an episode, in a worker, for as long as the parent wants it."""

    def go_on(done: int = 0, total: int = 0, data: Any = None) -> None:
        if _call.value != number:
            raise KeyboardInterrupt

    try:
        go_on()
        return _episode(config, record, path, go_on)
    except KeyboardInterrupt:
        return {"interrupted": True}


_KEPT = 4  # engines that a process keeps
_engines: dict[tuple[BatchSpec, Robot, ModelKind], MujocoEngine] = {}


def _episode(
    config: RunConfig, record: Record | None, path: Path, on_tick: OnTick | None = None
) -> dict[str, Any]:
    """Run one episode, on an engine that is kept for those to come."""
    episode = resolve_episode(config)
    run = simulate(_engine(episode.spec), episode, on_tick=on_tick)
    if record is not None and not run.interrupted:
        path.parent.mkdir(parents=True, exist_ok=True)
        record(run, path)
    return metrics(run, episode.goal)


def _engine(spec: BatchSpec) -> MujocoEngine:
    # Names of one's own may stand for another robot or model since, as where a module is reloaded.
    key = (spec, get_robot(spec.scene.robot), get_kind(spec.controller.model.kind))
    if key not in _engines:
        while len(_engines) >= _KEPT:
            del _engines[next(iter(_engines))]
        _engines[key] = MujocoEngine(spec)
    return _engines[key]
