"""Is a better prediction better in closed loop, in three dimensions? Every model, tuned alike.

The weights of each model (``spatial.model``) are tuned by CMA-ES with the same number of
candidates, from the shipped ones, on steady commands and seeds of their own. Tuned and shipped
weights then report on other seeds: steady commands, turning at speed, pushes at 8 phases of a
cycle, a start thrown and tilted, a bound, a long horizon. Torques are held over a control tick, the
controller is in float32.

Leaves results.json, table.md and figure.png in the output folder. Generations and batches that are
finished are kept there: the same command goes on after Ctrl-C.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kjax import cli
from kjax.config import RunConfig
from kjax.options import parse, require, require_names
from kjax.runs.batches import run_batch
from kjax.runs.cache import Cache, open_cache
from kjax.sim.intervals import median_interval
from kjax.studies.spatial import measures
from kjax.studies.spatial.cases import Row, share
from kjax.studies.spatial_walks import cases, tuning
from kjax.studies.spatial_walks.cases import CASES, MODELS, STEADY, SpatialWalksOptions, observed
from kjax.studies.spatial_walks.report import figure, table
from kjax.studies.tune import evolution
from kjax.studies.tune.evolution import Evolution

HELD = ("tuned", "shipped")  # weights


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run what is missing, write table and figure; 0 if all was run."""
    args = parse(SpatialWalksOptions, argv, __doc__.split("\n\n")[0])
    require_names(args, "models", MODELS)
    require_names(args, "cases", CASES)
    require(args, "generations", "tuning_seeds", "seeds", "push_seeds", "threads", least=1)
    require(args, "population", least=2)
    if args.quick:
        args.models, args.seeds, args.push_seeds = args.models[:2], min(args.seeds, 2), 1
        args.generations, args.population, args.tuning_seeds = 1, 2, 1
    folder = cli.output_folder(args, "spatial_walks")
    cli.configure_jax()
    computed_by = (cases, tuning, measures, evolution)
    cache = open_cache(folder, *(Path(str(one.__file__)) for one in computed_by))
    try:
        record = _record(args, cache)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    text = table(record)
    cli.save_study(folder, record, text, partial(figure, record), file="results.json")
    return 0


def _record(args: SpatialWalksOptions, cache: Cache) -> Row:
    """Tune and walk; what is compiled for all models comes before what is not."""
    models: dict[str, Row] = {}
    asked = {name: case for name, case in CASES.items() if name in args.cases}
    for program in dict.fromkeys(case.program for case in asked.values()):
        own = {name: case for name, case in asked.items() if case.program == program}
        for model in args.models:
            found = tuning.tuned(model, args, cache)
            rows = _walk(model, own, found.best, args, cache)
            entry = models.setdefault(model, _of_search(found) | {key: {} for key in HELD})
            for key in HELD:
                for name, case in own.items():
                    entry[key][name] = summary(rows[name, key], case.together)
            print(f"{model}: {', '.join(own)}", flush=True)
    return {
        "quick": args.quick, "seeds": args.seeds, "push_seeds": args.push_seeds,
        "tuning": {
            "generations": args.generations, "population": args.population,
            "commands": [list(one) for one in STEADY], "seeds": args.tuning_seeds,
        },
        "cost_unit": cases.UNIT.tolist(), "cost_of_a_fall": cases.FALL,
        "impulse_Ns": cases.IMPULSE, "thrown": cases.THROWN, "cases": list(asked),
        "models": models,
    }  # fmt: skip


def _of_search(found: Evolution) -> Row:
    """What is told of a search: its costs, and factors on the shipped weights."""
    shipped = tuning.logs_of(cases.walk_config(MODELS[0], STEADY[0], 1.0))
    return {
        "tuning_cost": {
            "shipped": float(found.costs[0, 0]), "best": float(found.costs.min()),
            "of_generations": found.costs.min(axis=1).tolist(),
        },
        "factors": dict(
            zip(tuning.NAMES, np.exp(found.best - shipped).tolist(), strict=True)
        ),
        "tuning_s": float(found.seconds.sum()),
    }  # fmt: skip


def _walk(
    model: str, own: dict[str, cases.WalkCase], logs: np.ndarray, args: Any, cache: Cache
) -> dict[tuple[str, str], list[Row]]:
    """Rows of cases of one program, by case and weights."""
    configs: list[RunConfig] = []
    labels: list[tuple[str, str]] = []
    for name, case in own.items():
        for one in case.configs(model, args):
            # Side by side, so that every chunk has both and one compilation serves all.
            configs += [tuning.weighted(one, logs), one]
            labels += [(name, key) for key in HELD]
    rows = run_batch(
        cache, configs, torques="held", chunk=len(STEADY) * args.population, threads=args.threads,
        measure=observed, dtype=np.float32, label=f"{model}, {', '.join(own)}",
    )  # fmt: skip
    found: dict[tuple[str, str], list[Row]] = {}
    for label, row in zip(labels, rows, strict=True):
        found.setdefault(label, []).append(row)
    return found


def summary(rows: Sequence[Row], together: int) -> Row:
    """Falls with Wilson's interval; medians of what stood, with theirs.

    Args:
      rows: of the episodes, in order.
      together: episodes that one value is the mean of, where all of them stood.
    """
    falls = sum(row["fell"] for row in rows)
    groups = [rows[k : k + together] for k in range(0, len(rows), together)]
    up = [group for group in groups if not any(row["fell"] for row in group)]
    out: Row = {"falls": share(falls, len(rows))}
    for name, value in {
        "cost": lambda row: row["cost"],
        "v_x_rmse_mps": lambda row: row["errors"][0],
        "v_y_rmse_mps": lambda row: row["errors"][1],
        "yaw_rate_cycle_rmse_radps": lambda row: row["errors_of_cycles"][2],
        "roll_p95_deg": lambda row: row["tilt_p95_deg"][0],
        "pitch_p95_deg": lambda row: row["tilt_p95_deg"][1],
        "largest_tilt_deg": lambda row: row["largest_tilt_deg"],
    }.items():
        values = [float(np.mean([value(row) for row in group])) for group in up]
        out[name] = float(np.median(values)) if values else None
        out[f"{name}_interval"] = median_interval(values) if values else None
    return out
