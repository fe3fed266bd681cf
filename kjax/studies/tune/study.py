"""Tune the controller by gradients through its closed loop, then see what MuJoCo says.

Adam descends on random scenarios of a differentiable plant (``kjax.tuning``: a rigid body, planar
or in three dimensions as the controller is, its own plan, 200 QPs a second), with others held out.
With --baseline CMA-ES (pycma) tunes the same parameters in MuJoCo itself, for the same wall time;
with --refine it goes on from the descent's result. All results, the start and the config's own
parameters then run the config's whole command in MuJoCo on other seeds.

Leaves tuned.toml, metrics.json, table.md and figure.png in the output folder. The state is kept
there as well: the same command goes on after Ctrl-C or a kill.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from kjax import cli
from kjax.config import CommandConfig, RunConfig
from kjax.options import fail
from kjax.runs.cache import Cache, open_cache
from kjax.sim.closed_cost import recording_costs
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.resolve import batch_spec, resolve_episodes
from kjax.sim.summary import summarise
from kjax.studies.tune import evolution, report
from kjax.studies.tune.options import DRAWN, Task, parse_task
from kjax.tuning import loop
from kjax.tuning.optimise import Descent, build_objective, descend
from kjax.tuning.space import Space, Variables, build_space, tuned_config

TRAIN_SEED, HELD_OUT_SEED = 100, 200  # the reported MuJoCo seeds are 0 to 15
POPULATION_SEEDS = 4  # MuJoCo episodes per candidate of the baseline


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run; exit code 0 if all went well."""
    config, args = parse_task(argv, __doc__.splitlines()[0])
    cli.configure_jax()
    folder = cli.output_folder(args, "tune")
    try:
        tune(config, args, folder)
    except KeyboardInterrupt:
        print(f"interrupted; the same command goes on from what {folder}/ holds", file=sys.stderr)
        return 130
    return 0


def tune(config: RunConfig, args: Task, folder: Path) -> None:
    """Descend, search, compare; leaves everything in the folder."""
    short, space = shortened(config, args), None
    try:
        space = build_space(short, args.keys)
    except ValueError as error:
        fail(f"--{error}" if str(error).startswith("keys") else str(error))
    begin = worsened(space, args.worsen, args.worsen_seed)
    cache = open_cache(folder, Path(__file__), Path(evolution.__file__))
    key = cache.key(short, _settings(args))
    cache.folder.mkdir(exist_ok=True)
    train, held_out = (
        loop.draw_scenarios(short, seed, count, speeds=args.speeds, pieces=args.pieces)
        for seed, count in ((TRAIN_SEED, args.scenarios), (HELD_OUT_SEED, args.held_out))
    )
    objective = build_objective(short, space, memory=args.memory)
    look = jax.jit(lambda z: jax.vmap(objective, (None, 0))(z, held_out).mean())
    own_cost, begin_cost = float(look(space.start)), float(look(begin))
    print(f"cost on {args.held_out} held-out scenarios: the config's own {own_cost:.3f}, "
          f"the start {begin_cost:.3f}", flush=True)  # fmt: skip
    result = _descend(objective, space, (train, held_out), begin, args, cache.path(key, ".npz"))
    print(f"descent: {len(result.cost)} updates in {result.seconds:.0f} s, held-out cost "
          f"{result.best_cost:.3f} after update {result.best_update} (ended by: {result.stopped})",
          flush=True)  # fmt: skip
    sets = {"own": space.start, "start": begin, "gradient": result.best}
    searches: dict[str, dict[str, Any]] = {}
    for name, first in evolutions(args, begin, result.best).items():
        own = cache.key(key, name, [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(first)])
        searches[name] = evolve(short, space, first, args, result.seconds, cache, own)
        sets[name] = searches[name]["best"]
        print(f"{name}: {searches[name]['generations']} generations of "
              f"{searches[name]['population']} in MuJoCo in {searches[name]['seconds']:.0f} s",
              flush=True)  # fmt: skip
    costs = {name: float(look(z)) for name, z in sets.items()}
    verdict = {name: verdict_of(config, space.overrides(z), args.seeds) for name, z in sets.items()}
    cli.save_config(folder / "tuned.toml", tuned_config(config, space.overrides(result.best)))
    record = {
        **_record(args, result, searches),
        "held_out_cost": costs,
        "cost_over_own": {name: value / costs["own"] for name, value in costs.items()},
        "values": {name: space.overrides(z) for name, z in sets.items()},
        "mujoco": verdict,
    }
    runs = traces(short, space, sets, held_out)
    cli.save_study(
        folder, record, report.table(record), lambda path: report.figure(record, runs, short, path)
    )
    if not result.healthy:
        fail(f"the descent broke off: {result.stopped}; tuned.toml is the last good point")


def _descend(
    objective: Any,
    space: Space,
    scenarios: tuple[loop.Scenario, loop.Scenario],
    begin: Variables,
    args: Task,
    checkpoint: Path,
) -> Descent:
    """The descent on the training scenarios, with a bar of its progress; kept as it goes.

    Args:
      objective: cost of variables on a scenario.
      space: of the variables.
      scenarios: to descend on, and held out.
      begin: where it starts.
      args: of the command line.
      checkpoint: file that it is kept in, named by the key of all that it depends on.
    """
    with tqdm(total=args.updates, unit="update", disable=None) as bar:

        def show(number: int, value: float, best: float) -> None:
            bar.n = number
            bar.set_postfix_str(f"cost {value:.3f}, held out {best:.3f}")

        try:
            return descend(
                objective, space, *scenarios, start=begin, updates=args.updates,
                rate=args.rate, patience=args.patience, seconds=60.0 * args.minutes,
                checkpoint=checkpoint, identity=checkpoint.stem, on_update=show,
            )  # fmt: skip
        except ValueError as error:
            fail(str(error))


def _record(args: Task, result: Descent, searches: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What metrics.json says of how the parameters were found."""
    return {
        "keys": list(args.keys),
        "worsen": args.worsen,
        "scenarios": {"train": args.scenarios, "held_out": args.held_out, "seconds": args.seconds},
        "descent": {
            "updates": len(result.cost), "seconds": result.seconds, "stopped": result.stopped,
            "best_update": result.best_update, "cost": result.cost,
            "checks": result.checks, "held_out": result.held_out,
        },
        "searches": {
            name: {k: v for k, v in found.items() if k != "best"}
            for name, found in searches.items()
        },
    }  # fmt: skip


def _settings(args: Task) -> list[Any]:
    """Options that the descent depends on."""
    names = ("keys", "scenarios", "held_out", "seconds", "pieces", "updates", "rate", "patience",
             "worsen", "worsen_seed", "memory", "speeds")  # fmt: skip
    return [getattr(args, name) for name in names]


def shortened(config: RunConfig, args: Task) -> RunConfig:
    """The config of a scenario."""
    command = CommandConfig(times=(0.0,), v_x=(0.0,))
    return dataclasses.replace(config, duration=args.seconds, command=command)


def worsened(space: Space, factor: float, seed: int) -> Variables:
    """The config's variables, each number off by a factor, up or down at random."""
    rng = np.random.default_rng(seed)
    out = {}
    for key, one in space.start.items():
        if space.kinds[key].unit is None:
            out[key] = one + np.log(factor) * rng.choice([-1.0, 1.0], np.shape(one))
        else:
            out[key] = one / factor
    return space.inside(out)


def evolutions(args: Task, begin: Variables, tuned: Variables) -> dict[str, Variables]:
    """What CMA-ES is asked to do: names, and where it begins."""
    asked = {"CMA-ES": begin} if args.baseline else {}
    return asked | ({"gradient, then CMA-ES": tuned} if args.refine else {})


def evolve(
    config: RunConfig, space: Space, begin: Variables, args: Task, seconds: float,
    cache: Cache, key: str,
) -> dict[str, Any]:  # fmt: skip
    """CMA-ES on batches of MuJoCo episodes for some wall time [s]; kept after every generation."""
    leaves, tree = jax.tree.flatten(begin)
    sizes = np.cumsum([np.size(leaf) for leaf in leaves])[:-1]

    def unflat(vector: np.ndarray) -> Variables:
        parts = np.split(np.asarray(vector), sizes)
        shaped = [p.reshape(np.shape(a)) for p, a in zip(parts, leaves, strict=True)]
        return space.inside(jax.tree.unflatten(tree, shaped))

    scenarios = mujoco_scenarios(config, args)
    engine = BatchEngine(batch_spec(scenarios[0]), torques="held")

    def cost(asked: Sequence[np.ndarray]) -> np.ndarray:
        candidates = [tuned_config(config, space.overrides(unflat(one))) for one in asked]
        recording = engine.run(resolve_episodes([
            dataclasses.replace(c, command=w.command, seed=w.seed, sim=w.sim)
            for c in candidates for w in scenarios
        ]))  # fmt: skip
        if recording.interrupted:
            raise KeyboardInterrupt
        return recording_costs(recording).reshape(len(asked), len(scenarios)).mean(axis=1)

    mean = np.concatenate([np.ravel(leaf) for leaf in leaves])
    found = evolution.evolve(cost, mean, cache=cache, key=key, seconds=seconds)
    return {
        "best": unflat(found.favourite),
        "generations": len(found.costs),
        "population": found.population,
        "episodes": found.costs.size * len(scenarios),
        "seconds": float(found.seconds.sum()),
        "cost": found.costs.min(axis=1).tolist(),
    }


def mujoco_scenarios(config: RunConfig, args: Task) -> list[RunConfig]:
    """Episodes of a candidate of the baseline: the descent's commands, in MuJoCo."""
    rng = np.random.default_rng(TRAIN_SEED)
    low, high = args.speeds
    times = tuple(float(i) * args.seconds / args.pieces for i in range(args.pieces))
    names = DRAWN[config.controller]

    def drawn() -> dict[str, tuple[float, ...]]:
        columns = rng.uniform(low, high, (args.pieces, len(names))).T
        return {name: tuple(column.tolist()) for name, column in zip(names, columns, strict=True)}

    return [
        dataclasses.replace(
            config,
            seed=TRAIN_SEED + i,
            sim=dataclasses.replace(config.sim, contacts="feet"),
            command=CommandConfig(times=times, **drawn()),
        )
        for i in range(POPULATION_SEEDS)
    ]


def verdict_of(config: RunConfig, overrides: dict[str, Any], seeds: int) -> dict[str, Any]:
    """The config's whole command in MuJoCo with some values, torques at every step."""
    chosen = tuned_config(config, overrides)
    configs = [dataclasses.replace(chosen, seed=seed) for seed in range(seeds)]
    recording = BatchEngine(batch_spec(chosen)).run(resolve_episodes(configs))
    if recording.interrupted:
        raise KeyboardInterrupt
    rows = summarise(recording.metrics())
    keep = ("velocity_rmse_mps", "velocity_y_rmse_mps", "yaw_rate_rmse_radps", "roll_p95_deg",
            "pitch_p95_deg", "pitch_max_deg", "foot_slip_m",
            "torque_saturation_fraction")  # fmt: skip
    costs = recording_costs(recording)
    return {
        "runs": rows["runs"],
        "falls": rows["falls"],
        "cost_median": float(np.median(costs)),
        **{key: rows[key] for key in keep if key in rows},
    }


def traces(
    config: RunConfig, space: Space, sets: dict[str, Variables], scenarios: loop.Scenario
) -> dict[str, Any]:
    """The first held-out scenario with every set of parameters."""
    run = jax.jit(loop.build_loop(config))
    one = jax.tree.map(lambda a: a[0], scenarios)
    return {name: jax.device_get(run(space.params(z), one)) for name, z in sets.items()}
