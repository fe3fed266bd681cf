"""Many episodes on the batch engine, each chunk of robots kept as soon as it ends.

Results lie in a ``Cache`` beside those of single runs; so the same command goes on where it
stopped.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from kjax.config import RunConfig
from kjax.runs.cache import Cache
from kjax.runs.pool import Record
from kjax.sim.engines.contract import Engine, Torques, get_engine
from kjax.sim.resolve import batch_spec, resolve_episodes
from kjax.sim.trajectory import Trajectory

Measure = Callable[[Trajectory, RunConfig], dict[str, Any]]


def batch_key(
    cache: Cache,
    config: RunConfig,
    torques: Torques,
    dtype: Any = np.float64,
    measure: Measure | None = None,
    engine: str = "mujoco_batch",
) -> str:
    """Key of an episode's result in the cache."""
    more = [] if measure is None else [measure.__name__]
    return cache.key(config, "batch", engine, torques, np.dtype(dtype).name, *more)


def run_batch(
    cache: Cache,
    configs: Sequence[RunConfig],
    *,
    torques: Torques,
    chunk: int = 32,
    threads: int | None = None,
    record: Record | None = None,
    recorded: int = 0,
    measure: Measure | None = None,
    dtype: Any = np.float64,
    engine: str = "mujoco_batch",
    label: str = "",
) -> list[dict[str, Any]]:
    """Metrics of the episodes, in order; what the cache holds is not run again.

    Eleven arguments: what is run and where it is kept, and options by keyword.

    Args:
      cache: of results.
      configs: of the robots, with one ``sim.resolve.batch_spec`` and one duration.
      torques: ``"every_step"``, as on the robot, or ``"held"`` over a control tick.
      chunk: robots of one batch, which are kept together.
      threads: of the engine; one per core if ``None``.
      record: called with a run and the path of a file of its own,
      recorded: for the first so many configs.
      measure: metrics of a run besides the usual ones; the cache must know its file.
      dtype: floating type of the controller.
      engine: whose physics; a name of ``sim.engines``.
      label: of the progress bar.

    Raises:
      KeyboardInterrupt: on Ctrl-C; finished chunks are kept.
    """
    keys = [batch_key(cache, config, torques, dtype, measure, engine) for config in configs]
    files = [cache.path(key, ".npz") for key in keys]
    kept = recorded if record is not None else 0
    missing = [
        number for number, key in enumerate(keys)
        if key not in cache or (number < kept and not files[number].exists())
    ]  # fmt: skip
    walker: Engine | None = None
    size = min(chunk, len(missing))
    with tqdm(
        total=len(configs), initial=len(configs) - len(missing), desc=label, unit="episode",
        disable=None, leave=False,
    ) as bar:  # fmt: skip
        for first in range(0, len(missing), max(size, 1)):
            some = missing[first : first + size]
            if walker is None:
                build = get_engine(engine)
                walker = build(
                    batch_spec(configs[0]), torques=torques, threads=threads, dtype=dtype
                )
            # All chunks have one number of robots, so that one compilation serves them.
            padded = [configs[number] for number in [*some, *[some[-1]] * (size - len(some))]]
            recording = walker.run(resolve_episodes(padded))
            if recording.interrupted:
                raise KeyboardInterrupt
            for robot, number in enumerate(some):
                if record is not None and number < kept:
                    files[number].parent.mkdir(parents=True, exist_ok=True)
                    record(recording.trajectory(robot), files[number])
            rows = list(recording.metrics())[: len(some)]
            if measure is not None:
                for robot, number in enumerate(some):
                    rows[robot] |= measure(recording.trajectory(robot), configs[number])
            cache.add({keys[n]: row for n, row in zip(some, rows, strict=True)})
            bar.update(len(some))
    return [cache[key] for key in keys]
