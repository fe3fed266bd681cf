"""Run a sweep: chunk by chunk, on one process or several, and keep each chunk as it ends."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import xarray as xr
from tqdm import tqdm

from kjax import cli
from kjax.config import ConfigError, RunConfig, SweepConfig, load_config, to_dict
from kjax.files import own_module_hash
from kjax.runs.cache import Cache, lock
from kjax.runs.sweeps.dataset import merged, write
from kjax.runs.sweeps.grid import base_of, plan
from kjax.sim.engines.contract import Engine, get_engine
from kjax.sim.episode import BatchSpec
from kjax.sim.resolve import batch_spec, resolve_episodes, resolve_scene


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Cases that walk together; all chunks of a sweep have one number of robots.

    Attributes:
      cases: their indices in the plan.
      configs: of the robots; the last one is repeated to fill the chunk.
    """

    cases: np.ndarray
    configs: list[RunConfig]


def chunks_of(cases: Sequence[RunConfig], size: int) -> list[Chunk]:
    """Cases in chunks, in order; those of one chunk have one ``batch_spec`` and one duration."""
    groups: dict[tuple[BatchSpec, float], list[int]] = {}
    for number, config in enumerate(cases):
        groups.setdefault((batch_spec(config), config.duration), []).append(number)
    out = []
    for indices in groups.values():
        own = min(size, len(indices))
        for first in range(0, len(indices), own):
            some = indices[first : first + own]
            filled = [*some, *[some[-1]] * (own - len(some))]
            out.append(Chunk(cases=np.array(some), configs=[cases[i] for i in filled]))
    return out


def run_sweep(
    sweep: SweepConfig,
    file: Path,
    folder: Path,
    *,
    threads: int | None = None,
    process: int = 0,
    processes: int = 1,
    barrier: Callable[[str], None] | None = None,
    fresh: bool = False,
) -> xr.Dataset | None:
    """Run what is missing of a sweep, and merge it.

    Eight arguments: a sweep and its folder, and how processes share it by keyword.

    Args:
      sweep: its config.
      file: that it came from.
      folder: of its results.
      threads: of the C engine; as many as cores if ``None``.
      process: number of this process.
      processes: number of processes that share the sweep; each runs every ``processes``-th chunk.
      barrier: waits until all processes have come to the same name.
      fresh: drop what the folder holds.

    Returns:
      The dataset, on process 0; ``None`` on others, and where Ctrl-C stopped it.

    Raises:
      ConfigError: for cases that are none.
      CacheError: for a folder or file that cannot be used.
      KeyboardInterrupt: on Ctrl-C; finished chunks are kept.
    """
    cases = plan(sweep, file)
    try:
        engine = get_engine(sweep.engine)
        for config in cases.cases:
            engine.check(batch_spec(config), resolve_scene(config)[1], sweep.torques)
    except ValueError as error:
        raise ConfigError(f"{file}: {error}") from None
    chunks = chunks_of(cases.cases, sweep.chunk)
    meet = barrier or (lambda name: None)
    with lock(folder, f"lock.{process}" if processes > 1 else "lock"):
        if fresh and process == 0:
            Cache(folder, fresh=True)
        meet("restarted")
        cache = Cache(folder)
        keys = _keys(cache, sweep, cases.cases)
        meet("opened")
        todo = [
            number for number, chunk in enumerate(chunks)
            if any(keys[case] not in cache for case in chunk.cases)
        ]  # fmt: skip
        own = [number for number in todo if number % processes == process]
        _run_chunks(sweep, cache, keys, chunks, own, len(todo), threads)
        meet("finished")
        if process > 0:
            return None
        cache.refresh()
        attributes = {
            "sweep": to_dict(sweep),
            "base": to_dict(load_config(RunConfig, base_of(sweep, file))),
            "provenance": cli.provenance(),
        }
        dataset = merged(cases, [cache[key] for key in keys], attributes)
        write(dataset, folder / "sweep.nc")
        return dataset


def _keys(cache: Cache, sweep: SweepConfig, cases: Sequence[RunConfig]) -> list[str]:
    """Key of each case's result."""
    how = [sweep.engine, own_module_hash(sweep.engine), sweep.torques, sweep.precision]
    keys = {config: cache.key(config, "sweep", how) for config in dict.fromkeys(cases)}
    return [keys[config] for config in cases]


def _run_chunks(
    sweep: SweepConfig,
    cache: Cache,
    keys: Sequence[str],
    chunks: list[Chunk],
    todo: list[int],
    missing: int,
    threads: int | None,
) -> None:
    engines: dict[BatchSpec, Engine] = {}
    steps = [_robot_steps(chunk.configs) for chunk in chunks]
    total = sum(steps[number] for number in todo)
    there = len(chunks) - missing
    if there:
        print(f"{there} of {len(chunks)} chunks are there already", flush=True)
    with tqdm(
        total=total, desc="walking", unit="step", unit_scale=True, disable=None, leave=False,
        bar_format="{desc} {percentage:3.0f}% |{bar}| {n_fmt}/{total_fmt} robot-steps "
        "[{elapsed}<{remaining}, {rate_fmt}]{postfix}",
    ) as bar:  # fmt: skip
        before = 0
        for place, number in enumerate(todo):
            chunk = chunks[number]
            spec = batch_spec(chunk.configs[0])
            if spec not in engines:
                engines[spec] = build_engine(sweep, spec, threads)

            def on_progress(done: int, whole: int, here: int = before, n: int = number) -> None:
                bar.update(here + round(steps[n] * done / whole) - bar.n)

            bar.set_postfix_str(f"chunk {place + 1} of {len(todo)}")
            clock = time.perf_counter()
            recording = engines[spec].run(resolve_episodes(chunk.configs), on_progress)
            if recording.interrupted:
                raise KeyboardInterrupt
            rows = list(recording.metrics())[: len(chunk.cases)]
            cache.add({keys[case]: row for case, row in zip(chunk.cases, rows, strict=True)})
            before += steps[number]
            if bar.disable:
                rate = steps[number] / (time.perf_counter() - clock)
                print(
                    f"chunk {place + 1} of {len(todo)}: {len(chunk.cases)} robots, "
                    f"{rate / 1e3:.1f} k robot-steps/s, "
                    f"{sum(row['fell'] for row in rows)} fell",
                    flush=True,
                )


def build_engine(sweep: SweepConfig, spec: BatchSpec, threads: int | None = None) -> Engine:
    """The engine that a sweep asks for."""
    dtype = np.dtype(sweep.precision)
    if dtype == np.float64 and not jax.config.read("jax_enable_x64"):
        raise ValueError("precision = 'float64' needs jax_enable_x64")
    return get_engine(sweep.engine)(spec, torques=sweep.torques, threads=threads, dtype=dtype)


def _robot_steps(configs: Sequence[RunConfig]) -> int:
    return sum(round(config.duration / config.sim.sim_dt) for config in configs)
