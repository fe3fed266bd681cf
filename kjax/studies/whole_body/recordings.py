"""The closed-loop episodes of the whole Go1 that whole_body.py learns from, kept in its folder."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kjax.config import RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import fail
from kjax.runs.cache import Cache, CacheError, open_cache
from kjax.sysid.transitions import Episode

DT = 0.005  # s, control tick of all these configs


class Kind(NamedTuple):
    """Episodes of one kind: config, range of commanded speeds [m/s], other keys."""

    config: str
    speeds: tuple[float, float]
    keys: dict[str, Any]


KINDS = {
    "trot": Kind("trot_velocity_long.toml", (-0.1, 0.6), {"lmpc.command_slew": 1.0}),
    "trot_rough": Kind("trot_rough.toml", (0.15, 0.4), {}),
    "bound": Kind("bound_multiphase.toml", (-0.1, 0.8), {}),
    "bound_rough": Kind("bound_rough.toml", (0.5, 0.8), {}),
}


def kind_configs(kind: str, robots: int, duration: float, force: float) -> list[RunConfig]:
    """Configs of the robots of a kind: each its own speeds, and obstacles or pushes.

    On flat ground every other robot is pushed.
    """
    chosen, configs = KINDS[kind], []
    for seed in range(robots):
        rng = np.random.default_rng([seed, 17])
        times = [0.0, 1.0, *np.arange(3.0, duration, 2.0)]
        keys = {
            "seed": seed,
            "duration": duration,
            "sim.contacts": "feet",
            "noise.force": force,
            "command.times": times,
            "command.v_x": [0.0, *rng.uniform(*chosen.speeds, len(times) - 1)],
            **chosen.keys,
        }
        if kind.endswith("rough"):
            keys["terrain.seed"] = seed
        elif seed % 2:
            early = np.arange(1.5, duration - 1.0, 2.0)
            at = np.round(early + rng.uniform(0.0, 1.0, len(early)), 3)
            keys["push.times"] = list(at)
            keys["push.forward"] = list(rng.uniform(-4.0, 4.0, len(at)))
        configs.append(load_config(RunConfig, shipped_config(chosen.config), keys))
    return configs


def kept(kind: str, args: Any, folder: Path) -> dict[str, np.ndarray] | None:
    """A kind's recording where it lies in the folder; ends the program where it is damaged."""
    cache = open_cache(folder, Path(__file__))
    try:
        return cache.arrays(_key(cache, kind, args))
    except CacheError as error:
        fail(str(error))


def _key(cache: Cache, kind: str, args: Any) -> str:
    return cache.key(*kind_configs(kind, args.robots, args.duration, args.force))


def record(kind: str, args: Any, folder: Path) -> list[Episode]:
    """Episodes of a kind, from the folder where they lie there already."""
    from kjax.sim.engines.mujoco_batch import BatchEngine
    from kjax.sim.resolve import batch_spec, resolve_episodes

    there = kept(kind, args, folder)
    if there is not None:
        print(f"{kind}: {args.robots} episodes of {args.duration:g} s are there", flush=True)
        return _episodes(there)
    configs = kind_configs(kind, args.robots, args.duration, args.force)
    cache = open_cache(folder, Path(__file__))
    print(f"{kind}: recording {args.robots} episodes of {args.duration:g} s ...", flush=True)
    begin = time.perf_counter()
    run = BatchEngine(batch_spec(configs[0]), torques="held").run(resolve_episodes(configs))
    if run.interrupted:
        raise KeyboardInterrupt
    log, steps = run.log, np.arange(len(run.log.x)) * DT
    disturbed = np.zeros(log.stance.shape[:2], bool)
    for robot, config in enumerate(configs):
        for at in config.push.times:
            # A tick that a push reaches into counts.
            disturbed[:, robot] |= (steps > at - DT) & (steps < at + config.push.duration)
    arrays = {
        **{name: getattr(log, name) for name in ("x", "feet", "force", "stance", "foot_force")},
        "disturbed": disturbed,
        "ticks": run.ticks,
        "fell": run.fell,
    }
    cache.add_arrays(_key(cache, kind, args), arrays)
    print(f"  {run.fell.sum()} falls, {time.perf_counter() - begin:.0f} s", flush=True)
    return _episodes(arrays)


def _episodes(arrays: dict[str, np.ndarray]) -> list[Episode]:
    return [
        Episode(**{name: arrays[name][:count, robot] for name in Episode._fields})
        for robot, count in enumerate(arrays["ticks"])
    ]
