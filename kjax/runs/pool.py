"""Many episodes for the experiments: in worker processes, each kept as soon as it ends.

An episode is a ``RunConfig``. Its result is kept under the hash of that config, in a file that is
labelled with a hash of the code; so the same command goes on where it stopped, does nothing when
all is there, and repeats what another config or other code would change.
"""

import hashlib
import itertools
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from tqdm import tqdm

from kjax import cli
from kjax.config import RunConfig, to_dict
from kjax.files import file_hashes
from kjax.sim.engines.mujoco import MujocoEngine, OnTick, simulate
from kjax.sim.episode import Trajectory, metrics
from kjax.sim.resolve import BatchSpec, batch_spec

# Called in the worker with each finished run and the file that belongs to it.
Record = Callable[[Trajectory, Path], None]
# Results in the order of the configs, None where ``enough`` ended the call before.
Run = Callable[..., list[dict[str, Any] | None]]
Task = tuple[str, tuple[RunConfig, Record | None, Path]]  # key, arguments of ``_episode``

_PACKAGE = Path(__file__).resolve().parents[1]
_NO_PHYSICS = ("viz", "runs", "cli.py")  # what cannot change an episode


def code_version(*files: Path) -> str:
    """Hash of everything that an episode's result depends on besides its config.

    Args:
      files: that a result depends on as well, such as a study's own.
    """
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*")):
        inside = path.relative_to(_PACKAGE)
        if path.suffix in (".py", ".xml") and inside.parts[0] not in _NO_PHYSICS:
            digest.update(inside.as_posix().encode() + path.read_bytes())
    for file in files:
        digest.update(file.name.encode() + file.read_bytes())
    for package in ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy"):
        with suppress(PackageNotFoundError):
            digest.update(f"{package} {version(package)}".encode())
    return digest.hexdigest()[:16]


def config_hash(config: Any) -> str:
    """Hash of all values of a config, and of the content of the files that it names."""
    values = to_dict(config)
    text = json.dumps(values, sort_keys=True) + "".join(file_hashes(config).values())
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Store:
    """Finished results in a JSON file, which is rewritten whole after each of them.

    Attributes:
      path: of the file.
      done: key -> result.
      outdated: whether the file holds results of another label: they are not in ``done``, and the
        first result that is added sets the file aside under a name with that label.
    """

    def __init__(self, path: Path, label: str, section: str = "episodes"):
        """Open or begin a store.

        Args:
          path: of the file.
          label: what all its results have in common, e.g. ``code_version()``.
          section: key in the file under which the results lie.
        """
        self.path, self.done, self.outdated = path, dict[str, Any](), False
        self._label, self._section, self._provenance = label, section, cli.provenance()
        if path.exists():
            try:
                old = json.loads(path.read_text(encoding="utf-8"))
            except ValueError:
                cli.fail(f"{path}: not valid JSON; move it away to start afresh")
            if not isinstance(old, dict) or not isinstance(old.get(section, {}), dict):
                cli.fail(f"{path}: holds no {section}; move it away to start afresh")
            self._old_label = str(old.get("label"))
            self.outdated = old.get("label") != label
            if not self.outdated:
                self.done = old.get(section, {})

    def add(self, key: str, result: Any, **more: Any) -> None:
        """Keep a result, with further entries of the file beside all results."""
        self.add_all({key: result}, **more)

    def add_all(self, results: Mapping[str, Any], **more: Any) -> None:
        """Keep several results in one go."""
        if self.outdated and self.path.exists():
            old = hashlib.sha256(self._old_label.encode()).hexdigest()[:8]
            names = (f"{old}{'' if i == 0 else f'-{i}'}" for i in itertools.count())
            places = (self.path.with_name(f"{self.path.stem}.{name}.json") for name in names)
            self.path.replace(next(place for place in places if not place.exists()))
        self.outdated = False
        self.done |= results
        cli.save_json(
            self.path,
            {
                "label": self._label,
                "provenance": self._provenance,
                self._section: self.done,
                **more,
            },
        )


@contextmanager
def open_runner(store: Store, *, jobs: int = 1, record: Record | None = None) -> Iterator[Run]:
    """A function that runs episodes and keeps each in the store.

    ``run(configs, label="", enough=None)`` returns the metrics of each config; what is in the
    store is not run again. ``enough(results so far) -> bool`` ends a call early. On Ctrl-C what
    is finished is kept, and KeyboardInterrupt raised.

    Args:
      store: of results.
      jobs: worker processes, one core each; 1 runs in this process.
      record: called with each run and the path of a file of its own.
    """
    if jobs == 1:
        yield lambda configs, **more: _run(store, configs, _here, record, **more)
        return
    context = multiprocessing.get_context("spawn")  # JAX's threads do not survive a fork
    workers, call = context.Value("i", 0), context.RawValue("i", 0)
    pool = ProcessPoolExecutor(jobs, context, initializer=_begin_worker, initargs=(workers, call))
    execute = partial(_in_pool, pool, call)
    try:
        yield lambda configs, **more: _run(store, configs, execute, record, **more)
    finally:
        pool.shutdown(cancel_futures=True)


def series_file(store: Store, config: RunConfig) -> Path:
    """Where ``record`` is to leave what it keeps of an episode."""
    return store.path.parent / "series" / f"{config_hash(config)}.npz"


def _run(
    store: Store,
    configs: Sequence[RunConfig],
    execute: Callable[[list[Task]], Iterator[tuple[str, dict[str, Any]]]],
    record: Record | None,
    *,
    label: str = "",
    enough: Callable[[list[dict[str, Any]]], bool] | None = None,
) -> list[dict[str, Any] | None]:
    """See ``open_runner``; ``execute`` yields (key, metrics) of tasks as they end."""
    keys = [config_hash(config) for config in configs]
    files = [series_file(store, config) for config in configs]
    results = {
        key: store.done[key]
        for key, file in zip(keys, files, strict=True)
        if key in store.done and (record is None or file.exists())
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
            store.add(key, result)
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
_engines: dict[BatchSpec, MujocoEngine] = {}


def _episode(
    config: RunConfig, record: Record | None, path: Path, on_tick: OnTick | None = None
) -> dict[str, Any]:
    """Run one episode, on an engine that is kept for those to come."""
    spec = batch_spec(config)
    if spec not in _engines:
        while len(_engines) >= _KEPT:
            del _engines[next(iter(_engines))]
        _engines[spec] = MujocoEngine(config)
    run = simulate(_engines[spec], config, on_tick=on_tick)
    if record is not None and not run.interrupted:
        path.parent.mkdir(parents=True, exist_ok=True)
        record(run, path)
    return metrics(run, config)
