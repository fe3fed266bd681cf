"""Run everything that the paper publishes and set it beside its numbers and our targets.

Leaves results.json, table.md, index.html and figures/ in the output folder. Every finished episode
is kept there: the same command goes on after Ctrl-C, and does nothing when all is done. Rough
ground is walked by the batch engine, on the same fields with torques at every physics step and with
torques held over a control tick. Both bases take about an hour on two quiet cores;
kjax/studies/reproduce/paper_results.py says what is run.
"""

from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kjax import cli
from kjax.config import ConfigError, FitStudyConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.controllers.resolve import build_command
from kjax.runs.batches import batch_key, run_batch
from kjax.runs.cache import Cache, open_cache
from kjax.runs.pool import Run, cached_runner, open_runner
from kjax.sim.engines.contract import Torques
from kjax.sim.intervals import median_interval, paired_difference, wilson
from kjax.sim.series import Series, load_series, save_series
from kjax.sim.summary import summarise, tracking_floor
from kjax.studies import koopman_fit
from kjax.studies.koopman_fit import fit_study, save_figure
from kjax.studies.reproduce.paper_results import (
    EXPERIMENTS,
    RMSE,
    Experiment,
    Row,
    base_config,
    cycle,
    episodes,
)

FIT = "koopman_fit"
NAMES = (FIT, *(experiment.name for experiment in EXPERIMENTS))
GRAVITY = 9.81  # m/s^2
ACCELERATION = 4.0  # m/s^2, of the floor of the tracking error, beside mu g
SHOWN = 64  # fields whose episodes are drawn
# What holding the torques over a control tick costs, beside fields crossed: metric and label.
HELD = (
    (RMSE, "RMSE against the raw step, more by holding [m/s]"),
    ("field_pitch_p95_deg", "pitch in the field, 95 %, more by holding [deg]"),
)
HEADER = (
    "experiment", "base", "", "paper", "target", "median", "95 % interval", "worst", "floor", "met"
)  # fmt: skip
NOTES = (
    "Intervals hold with 95 %: Wilson's for numbers of episodes, that of the order statistics for "
    "medians, Newcombe's for the difference of two shares on the same fields.",
    "Torques are computed at every physics step, as on the robot. The rows on holding them repeat "
    "the same fields with torques held over a control tick; differences are of the fields on which "
    "the robot stayed up both ways.",
    "Median and worst are over the episodes that did not fall; falls are counted apart. The "
    "target is for the number in the column that it stands beside: median, or worst where it says "
    "so.",
    f"RMSE is of the raw centre-of-mass velocity against the step command, from 0.5 s on. Its "
    f"floor is what remains if every step is answered at {ACCELERATION:g} m/s² or, second, at mu g "
    "(a step of dv at an acceleration a costs dv³/(3a)).",
    "Times are of workers that share the machine; experiments/benchmark.py measures them alone.",
)


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
        cli.fail(str(error))
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    _add_finished(record["experiments"], folder, args, cache)
    cli.save_json(folder / "results.json", record)
    _write_page(folder, record, args, cache)
    print((folder / "table.md").read_text(encoding="utf-8"))
    print(f"results in {folder}/: index.html, table.md, results.json, figures/")
    return 0


def _parse(argv: Sequence[str] | None) -> Namespace:
    args = cli.parse_study(
        argv,
        __doc__.split("\n\n")[0],
        NAMES,
        counts={
            "seeds": (16, "episodes on flat ground"),
            "terrains": (256, "episodes on rough ground"),
        },
        base="both",
        quick="2 episodes of 1.5 s each: to check the script",
        default_out="reproduce",
    )
    if args.quick:
        args.seeds, args.terrains = min(args.seeds, 2), min(args.terrains, 2)
    return args


def _add_finished(found: dict[str, Any], folder: Path, args: Namespace, cache: Cache) -> None:
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
    experiment: Experiment, base: str, args: Namespace, cache: Cache, runner: Run, *,
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
        walk = partial(run_batch, cache, chosen, threads=args.jobs)
        results = walk(torques="every_step", record=save_series, recorded=SHOWN, label=label)
        held = walk(torques="held", label=f"{label}, torques held")
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


def _write_page(folder: Path, record: dict[str, Any], args: Namespace, cache: Cache) -> None:
    from kjax.viz.report import write_page

    rows = _table(record["experiments"])
    lines = ["| " + " | ".join(cells) + " |" for cells in (HEADER, *rows)]
    lines.insert(1, "|" + "---|" * len(HEADER))
    notes = list(NOTES)
    if record["quick"]:
        notes.insert(0, "A quick check of the machinery: these numbers are no result.")
    cli.write_text(folder / "table.md", "\n".join(lines) + "\n\n" + "\n\n".join(notes) + "\n")
    title = "Koopman LMPC for a quadruped: the paper's results, reproduced"
    figures = _figures(folder, record["experiments"], args, cache)
    write_page(folder / "index.html", title, HEADER, rows, figures, notes)


def _table(experiments: dict[str, Any]) -> list[list[str]]:
    rows = []
    if FIT in experiments:
        found = experiments[FIT]["largest_scale_within_tolerance"]
        for key in next(iter(found.values())):
            ours = ", ".join(f"{mode} {best[key] or 'none'}" for mode, best in found.items())
            rows.append(
                [f"fit: part of the sampled ranges with the {key} within 1e-4 after 50 ms", "SRB",
                 key, "error within 1e-4, ranges not given", "", ours, "", "", "", ""]
            )  # fmt: skip
    for experiment in EXPERIMENTS:
        for base, one in experiments.get(experiment.name, {}).items():
            count = one["summary"]["runs"]
            for row in one["rows"]:
                whole = row["metric"] in ("falls", "crossed")
                floor = " / ".join(f"{value:.3f}" for value in row["floor"] or ())
                met = {None: "", True: "yes", False: "no"}[row["met"]]
                rows.append(
                    [experiment.title, base, row["label"], row["paper"], _target(row),
                     _count(row, count) if whole else _number(row["median"]),
                     _interval(row, percent=whole),
                     "" if whole else _number(row["worst"]), floor, met]
                )  # fmt: skip
            if "held" in one:
                rows += _held_rows(experiment.title, base, one["held"]["cost"])
    return rows


def _held_rows(title: str, base: str, cost: dict[str, Any]) -> list[list[str]]:
    """What holding the torques costs: fields crossed, lost and gained, speed, pitch."""
    crossed = cost["crossed"]
    name = f"{title}, torques held"
    shown = [
        ("terrains crossed", f"{crossed['held']} of {crossed['fields']}",
         _interval(dict(zip(("low", "high"), wilson(crossed["held"], crossed["fields"]),
                            strict=True)), percent=True)),
        (f"the same terrains, more by holding [%]: {crossed['lost']} lost, {crossed['gained']} "
         "gained", f"{100 * crossed['difference']:+.1f}", _interval(crossed, percent=True)),
        *((label, _number(cost[metric]["median"]), _interval(cost[metric]))
          for metric, label in HELD),
    ]  # fmt: skip
    return [[name, base, label, "", "", value, ends, "", "", ""] for label, value, ends in shown]


def _interval(row: dict[str, Any], *, percent: bool = False) -> str:
    """Ends of an interval; of a share in percent."""
    low, high = row.get("low"), row.get("high")
    if low is None or high is None:
        return ""
    return f"{100 * low:.1f} to {100 * high:.1f} %" if percent else f"{low:.3g} to {high:.3g}"


def _target(row: dict[str, Any]) -> str:
    if row["target"] is None:
        return ""
    if row["metric"] == "falls":
        return "none"
    sign = ">=" if row["metric"] == "crossed" else "<="
    return f"{sign} {row['target']:g}" + (" (worst)" if row["target_of"] == "worst" else "")


def _count(row: dict[str, Any], runs: int) -> str:
    share = row["metric"] == "crossed"
    return f"{round(row['median'] * runs) if share else row['median']} of {runs}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _figures(
    folder: Path, experiments: dict[str, Any], args: Namespace, cache: Cache
) -> list[tuple[str, str]]:
    """Draw what the results hold; (file, caption) of every figure there is."""
    from kjax.viz.report import switch_figure, terrain_figure, tracking_figure

    drawn = []
    if (folder / "figures" / f"{FIT}.png").exists():
        drawn.append((f"figures/{FIT}.png", "Prediction error of the Koopman models (Fig. 3)"))
    for base in ("planar", "free"):
        groups: dict[str, tuple[Sequence[Series], Sequence[float]]] = {}
        for experiment in EXPERIMENTS:
            one = experiments.get(experiment.name, {}).get(base)
            if one is None:
                continue
            config = base_config(experiment, base, quick=args.quick)
            runs, results = _load(cache, one["episodes"])
            title = f"{experiment.title}, {base}"
            if experiment.figure == "switch":
                pairs = [
                    (run, result["switch_time_s"])
                    for run, result in zip(runs, results, strict=True)
                    if result.get("switch_time_s") is not None
                ]
                groups[experiment.title] = ([p[0] for p in pairs], [p[1] for p in pairs])
                continue
            name = f"figures/{experiment.name}_{base}.png"
            draw = tracking_figure if experiment.figure == "tracking" else terrain_figure
            draw(runs, config, folder / name, title, cycle(config, config.gait.names[0]))
            drawn.append((name, title))
        if groups:
            name = f"figures/switches_{base}.png"
            switch_figure(groups, folder / name)
            drawn.append((name, f"Pitch about the switches of gait, {base}"))
    return drawn


def _load(cache: Cache, keys: list[str]) -> tuple[list[Series], list[dict[str, Any]]]:
    return [load_series(cache.path(key, ".npz")) for key in keys], [cache[key] for key in keys]
