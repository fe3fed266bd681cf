"""Run everything that the paper publishes and set it beside its figures and our targets.

Leaves results.json, table.md, index.html and figures/ in the output folder. Every finished episode
is kept there: the same command goes on after Ctrl-C, and does nothing when all is done. Rough
ground is for the batch engine, on the same fields with torques at every physics step and with
torques held over a control tick. Both bases take about an hour on two quiet cores;
kjax/studies/reproduce/paper_results.py says what is run.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kjax import cli
from kjax.config import ConfigError, FitStudyConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.controllers.resolve import build_command
from kjax.options import StudyOptions, fail, parse, require
from kjax.runs.batches import batch_key, run_batch
from kjax.runs.cache import Cache, open_cache
from kjax.runs.pool import Run, cached_runner, open_runner
from kjax.sim.engines.contract import Torques
from kjax.sim.intervals import median_interval, paired_difference, wilson
from kjax.sim.series import save_series
from kjax.sim.summary import summarise, tracking_floor
from kjax.studies import koopman_fit
from kjax.studies.koopman_fit import fit_study, save_figure
from kjax.studies.reproduce.page import save_page
from kjax.studies.reproduce.paper_results import (
    ACCELERATION,
    EXPERIMENTS,
    FIT,
    HELD,
    RMSE,
    Experiment,
    Row,
    base_config,
    episodes,
)
from kjax.types import GRAVITY

NAMES = (FIT, *(experiment.name for experiment in EXPERIMENTS))
SHOWN = 64  # fields whose episodes are drawn


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run what is missing, write the page."""
    args = _parse(argv)
    folder = cli.output_folder(args, "reproduce")
    cli.configure_jax(one_core=args.jobs == 1)
    chosen = [experiment for experiment in EXPERIMENTS if experiment.name in args.only]
    (folder / "figures").mkdir(exist_ok=True)
    cache = open_cache(folder)
    record: dict[str, Any] = {
        "provenance": cli.provenance(), "quick": args.quick, "experiments": {}
    }  # fmt: skip
    if FIT in args.only:
        record["experiments"][FIT] = _fit(folder, quick=args.quick)
    try:
        with open_runner(cache, jobs=args.jobs, record=save_series) as run:
            for experiment in chosen:
                there = record["experiments"].setdefault(experiment.name, {})
                for base in args.bases:
                    there[base] = _measure(experiment, base, args, cache, run)
    except ConfigError as error:
        fail(str(error))
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    _add_finished(record["experiments"], folder, args, cache)
    cli.save_json(folder / "results.json", record)
    save_page(folder, record, args, cache)
    print((folder / "table.md").read_text(encoding="utf-8"))
    print(f"results in {folder}/: index.html, table.md, results.json, figures/")
    return 0


@dataclass(kw_only=True)
class ReproduceOptions(StudyOptions):
    """Options of the reproduction."""

    names = NAMES

    seeds: int = 16
    """Episodes on flat ground."""

    terrains: int = 256
    """Episodes on rough ground."""


def _parse(argv: Sequence[str] | None) -> ReproduceOptions:
    args = parse(ReproduceOptions, argv, __doc__.split("\n\n")[0])
    require(args, "seeds", "terrains", least=1)
    args.out = args.out or Path("results") / "reproduce"
    if args.quick:
        args.seeds, args.terrains = min(args.seeds, 2), min(args.terrains, 2)
    return args


def _add_finished(
    found: dict[str, Any], folder: Path, args: ReproduceOptions, cache: Cache
) -> None:
    """Put on the page what is not asked for now but lies finished in the cache, of this code."""
    left_off = []
    for experiment in EXPERIMENTS:
        for base in ("planar", "free"):
            if base in found.get(experiment.name, {}):
                continue
            try:
                one = _measure(experiment, base, args, cache, cached_runner(cache), run=False)
                found.setdefault(experiment.name, {})[base] = one
            except KeyError:
                left_off.append(f"{experiment.name} ({base})")
    if FIT not in found:
        try:
            found[FIT] = _fit(folder, quick=args.quick, run=False)
        except KeyError:
            left_off.append(FIT)
    if left_off:
        print(f"not finished with these configs and this code, so not on the page: "
              f"{', '.join(left_off)}")  # fmt: skip


def _fit(folder: Path, *, quick: bool, run: bool = True) -> dict[str, Any]:
    """The fit study of Fig. 3; its statistics. ``KeyError`` where it would have to be run first."""
    config = _fit_config(quick=quick)
    cache = open_cache(folder, Path(koopman_fit.__file__))
    key, figure = cache.key(config), folder / "figures" / f"{FIT}.png"
    if key not in cache or not figure.exists():
        if not run:
            raise KeyError(key)
        print(f"{FIT}: fitting", flush=True)
        result, curves = fit_study(config)
        save_figure(config, curves, figure)
        cache.add({key: result})
    return dict(cache[key])


def _fit_config(*, quick: bool) -> FitStudyConfig:
    overrides = {"scales": [1.0], "test_states": 5, "test_profiles": 5} if quick else {}
    return load_config(FitStudyConfig, shipped_config("koopman_fit.toml"), overrides)


def _measure(
    experiment: Experiment, base: str, args: ReproduceOptions, cache: Cache, runner: Run, *,
    run: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """Run what is missing of an experiment on a base; its summary and the rows of the table.

    Without ``run`` a missing episode is a ``KeyError``.
    """
    config = base_config(experiment, base, quick=args.quick)
    chosen = episodes(experiment, config, seeds=args.seeds, terrains=args.terrains)
    label, more = f"{experiment.name} ({base})", {}
    if experiment.vary == "terrain":
        kinds: tuple[Torques, ...] = ("every_step", "held")
        keys = {torques: [batch_key(cache, c, torques) for c in chosen] for torques in kinds}
        if not run:
            missing = [key for one in keys.values() for key in one if key not in cache]
            missing += [key for key in keys["every_step"][:SHOWN]
                        if not cache.path(key, ".npz").exists()]  # fmt: skip
            if missing:
                raise KeyError(missing[0])
        run_fields = partial(run_batch, cache, chosen, threads=args.jobs)
        results = run_fields(torques="every_step", record=save_series, recorded=SHOWN, label=label)
        held = run_fields(torques="held", label=f"{label}, torques held")
        more["held"] = {"summary": summarise(held), "cost": held_cost(results, held)}
        shown = keys["every_step"][:SHOWN]
    else:
        results = [result for result in runner(chosen, label=label) if result is not None]
        shown = [cache.key(one) for one in chosen]
        if not run and not all(cache.path(key, ".npz").exists() for key in shown):
            raise KeyError(experiment.name)
    total = summarise(results)
    floors = {
        name: tracking_floor(build_command(config.command), a, end=config.duration)
        for name, a in (("4_mps2", ACCELERATION), ("mu_g", config.sim.friction * GRAVITY))
    }
    rows = [_row(row, total, floors, results) for row in experiment.rows]
    return {
        "episodes": shown,
        "summary": total,
        "floor_rmse_mps": floors,
        "rows": rows,
        **more,
    }


def held_cost(
    every_step: Sequence[dict[str, Any]], held: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """What torques held over a tick cost, on the same fields.

    Args:
      every_step: metrics of each field with torques at every physics step.
      held: the same fields in the same order with torques held.

    Returns:
      ``crossed``: fields crossed both ways, fields lost and gained by holding, the difference of
      the shares and its interval; and for each metric of ``HELD`` the median of what it is more,
      with its interval, over the fields on which the robot stayed up both ways.
    """
    one, two = ([bool(row.get("crossed")) for row in rows] for rows in (every_step, held))
    difference, low, high = paired_difference(one, two)
    out: dict[str, Any] = {
        "crossed": {
            "fields": len(one), "every_step": sum(one), "held": sum(two),
            "lost": sum(a and not b for a, b in zip(one, two, strict=True)),
            "gained": sum(b and not a for a, b in zip(one, two, strict=True)),
            "difference": difference, "low": low, "high": high,
        }
    }  # fmt: skip
    for metric, _ in HELD:
        more = [
            b[metric] - a[metric]
            for a, b in zip(every_step, held, strict=True)
            if not a["fell"] and not b["fell"]
            and a.get(metric) is not None and b.get(metric) is not None
        ]  # fmt: skip
        low_high = median_interval(more) or (None, None)
        out[metric] = {
            "n": len(more), "median": float(np.median(more)) if more else None,
            "low": low_high[0], "high": low_high[1],
        }  # fmt: skip
    return out


def _row(
    row: Row,
    total: dict[str, Any],
    floors: dict[str, float],
    results: Sequence[dict[str, Any]] = (),
) -> dict[str, Any]:
    """One number: the paper's, the target, ours, its interval, the floor, whether it is met."""
    interval: tuple[float, float] | None = None
    if row.metric == "falls":
        median = worst = total["falls"]
        interval = wilson(median, total["runs"])
    elif row.metric == "crossed":
        median = worst = total.get("crossed", 0) / total["runs"]
        interval = wilson(total.get("crossed", 0), total["runs"])
    else:
        median, worst = (total.get(row.metric, {}).get(key) for key in ("median", "worst"))
        interval = median_interval(
            [r[row.metric] for r in results if not r["fell"] and r.get(row.metric) is not None]
        )
    ours, met = (median if row.of == "median" else worst), None
    if row.target is not None:
        above = row.metric == "crossed"
        met = ours is not None and (ours >= row.target if above else abs(ours) <= row.target)
    low, high = interval or (None, None)
    return {
        "metric": row.metric, "label": row.label, "paper": row.paper, "target": row.target,
        "target_of": row.of, "median": median, "low": low, "high": high, "worst": worst, "met": met,
        "floor": list(floors.values()) if row.metric == RMSE else None,
    }  # fmt: skip
