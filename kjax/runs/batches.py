"""Many episodes on the batch engine, each chunk of robots kept as soon as it ends.

Results lie in an ``episodes.Store`` beside those of single runs, under the hash of the config and
how torques are computed; so the same command goes on where it stopped.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from kjax.config import RunConfig
from kjax.runs.pool import Record, Store, config_hash
from kjax.sim.engines.contract import Torques
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.episode import Trajectory

Measure = Callable[[Trajectory, RunConfig], dict[str, Any]]


def batch_key(config: RunConfig, torques: Torques, dtype: Any = np.float64) -> str:
    """Key of an episode's result in the store."""
    key = f"{config_hash(config)}-{torques}"
    return key if np.dtype(dtype) == np.float64 else f"{key}-{np.dtype(dtype).name}"


def batch_series_file(store: Store, config: RunConfig, torques: Torques) -> Path:
    """Where ``record`` is to leave what it keeps of an episode."""
    return store.path.parent / "series" / f"{batch_key(config, torques)}.npz"


def run_batch(
    store: Store,
    configs: Sequence[RunConfig],
    *,
    torques: Torques,
    chunk: int = 32,
    threads: int | None = None,
    record: Record | None = None,
    recorded: int = 0,
    measure: Measure | None = None,
    dtype: Any = np.float64,
    label: str = "",
) -> list[dict[str, Any]]:
    """Metrics of the episodes, in order; what the store holds is not run again.

    Args:
      store: of results.
      configs: of the robots, with one ``sim.resolve.batch_spec`` and one duration.
      torques: ``"every_step"``, as on the robot, or ``"held"`` over a control tick.
      chunk: robots of one batch, which are kept together.
      threads: of the engine; one per core if ``None``.
      record: called with a run and the path of a file of its own,
      recorded: for the first so many configs.
      measure: metrics of a run besides the usual ones; the store's label must tell it apart.
      dtype: floating type of the controller.
      label: of the progress bar.

    Raises:
      KeyboardInterrupt: on Ctrl-C; finished chunks are kept.
    """
    keys = [batch_key(config, torques, dtype) for config in configs]
    files = [batch_series_file(store, config, torques) for config in configs]
    kept = recorded if record is not None else 0
    missing = [
        number for number, key in enumerate(keys)
        if key not in store.done or (number < kept and not files[number].exists())
    ]  # fmt: skip
    engine: BatchEngine | None = None
    size = min(chunk, len(missing))
    with tqdm(
        total=len(configs), initial=len(configs) - len(missing), desc=label, unit="episode",
        disable=None, leave=False,
    ) as bar:  # fmt: skip
        for first in range(0, len(missing), max(size, 1)):
            some = missing[first : first + size]
            if engine is None:
                engine = BatchEngine(configs[0], torques=torques, threads=threads, dtype=dtype)
            # All chunks have one number of robots, so that one compilation serves them.
            padded = [configs[number] for number in [*some, *[some[-1]] * (size - len(some))]]
            recording = engine.run(padded)
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
            store.add_all({keys[n]: row for n, row in zip(some, rows, strict=True)})
            bar.update(len(some))
    return [store.done[key] for key in keys]
