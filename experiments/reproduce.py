"""Run everything that the paper publishes and set it beside its numbers and our targets.

Leaves results.json, table.md, index.html and figures/ in the output folder. Every finished episode
is kept there: the same command goes on after Ctrl-C, and does nothing when all is done. Rough
ground is walked by the batch engine, on the same fields with torques at every physics step and with
torques held over a control tick. Both bases take about an hour on two quiet cores;
experiments/paper_results.py says what is run.
"""

import json
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import koopman_fit
import numpy as np
import paper_results
from koopman_fit import fit_study, save_figure
from paper_results import CONFIGS, EXPERIMENTS, RMSE, Experiment, Row, base_config, cycle, episodes

from kjax import cli
from kjax.config import ConfigError, FitStudyConfig, load_config
from kjax.runs.batches import batch_key, run_batch
from kjax.runs.pool import Run, Store, code_version, config_hash, open_runner
from kjax.sim.intervals import median_interval, paired_difference, wilson
from kjax.sim.series import Series, load_series, save_series
from kjax.sim.summary import summarise, tracking_floor

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


def main() -> None:
    """Parse the command line, run what is missing, write the page."""
    args = _parse()
    folder = cli.output_folder(args, "reproduce")
    cli.configure_jax(one_core=args.jobs == 1)
    chosen = [experiment for experiment in EXPERIMENTS if experiment.name in args.only]
    (folder / "figures").mkdir(exist_ok=True)
    code = code_version(*map(Path, (__file__, paper_results.__file__, koopman_fit.__file__)))
    before = _read(folder / "results.json")
    record: dict[str, Any] = {
        "provenance": cli.provenance(), "code": code, "quick": args.quick, "experiments": {}
    }  # fmt: skip
    if before and before.get("code") != code:
        print(f"{folder}: the code has changed since; the table is made again")
    elif before:  # what is not asked for now stays on the page
        record["experiments"] = _kept(before, args)
    if FIT in args.only:
        record["experiments"][FIT] = _fit(folder, quick=args.quick)
    store = Store(folder / "episodes.json", code_version())
    if store.outdated:
        print(f"{folder}: the simulated code has changed since; all episodes are run again, those "
              "that it holds are set aside")  # fmt: skip
    try:
        with open_runner(store, jobs=args.jobs, record=save_series) as run:
            for experiment in chosen:
                there = record["experiments"].setdefault(experiment.name, {})
                for base in args.bases:
                    there[base] = _measure(experiment, base, args, store, run)
    except ConfigError as error:
        cli.fail(str(error))
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        raise SystemExit(130) from None
    cli.save_json(folder / "results.json", record)
    _write_page(folder, record, args)
    print((folder / "table.md").read_text(encoding="utf-8"))
    print(f"results in {folder}/: index.html, table.md, results.json, figures/")


def _parse() -> Namespace:
    args = cli.parse_study(
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


def _kept(before: dict[str, Any], args: Namespace) -> dict[str, Any]:
    """Earlier results that still hold, or are about to be asked for again; says what does not."""
    if before["quick"] != args.quick:
        return {}
    kept: dict[str, Any] = {}
    for experiment in EXPERIMENTS:
        for base, one in before["experiments"].get(experiment.name, {}).items():
            if one["config"] == config_hash(base_config(experiment, base, quick=args.quick)):
                kept.setdefault(experiment.name, {})[base] = one
            else:
                again = experiment.name in args.only and base in args.bases
                print(f"{experiment.name} ({base}): its config has changed; "
                      + ("it is run again" if again else "its results are dropped"))  # fmt: skip
    fit = before["experiments"].get(FIT, {})
    if fit.get("config") == config_hash(_fit_config(quick=args.quick)):
        kept[FIT] = fit
    return kept


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def _fit(folder: Path, *, quick: bool) -> dict[str, Any]:
    """The fit study of Fig. 3; its statistics and the hash of what they came from."""
    config = _fit_config(quick=quick)
    store = Store(folder / "fit.json", code_version(Path(koopman_fit.__file__)), section="fits")
    key, figure = config_hash(config), folder / "figures" / f"{FIT}.png"
    if key not in store.done or not figure.exists():
        print(f"{FIT}: fitting", flush=True)
        result, curves = fit_study(config)
        save_figure(config, curves, figure)
        store.add(key, result)
    return {"config": key, **store.done[key]}


def _fit_config(*, quick: bool) -> FitStudyConfig:
    overrides = {"scales": [1.0], "test_states": 5, "test_profiles": 5} if quick else {}
    return load_config(FitStudyConfig, CONFIGS / "koopman_fit.toml", overrides)


def _measure(
    experiment: Experiment, base: str, args: Namespace, store: Store, run: Run
) -> dict[str, Any]:
    """Run what is missing of an experiment on a base; its summary and the rows of the table."""
    config = base_config(experiment, base, quick=args.quick)
    chosen = episodes(experiment, config, seeds=args.seeds, terrains=args.terrains)
    label, more = f"{experiment.name} ({base})", {}
    if experiment.vary == "terrain":
        walk = partial(run_batch, store, chosen, threads=args.jobs)
        results = walk(torques="every_step", record=save_series, recorded=SHOWN, label=label)
        held = walk(torques="held", label=f"{label}, torques held")
        more["held"] = {"summary": summarise(held), "cost": held_cost(results, held)}
        shown = [batch_key(one, "every_step") for one in chosen[:SHOWN]]
    else:
        results = [result for result in run(chosen, label=label) if result is not None]
        shown = [config_hash(one) for one in chosen]
    total = summarise(results)
    floors = {
        name: tracking_floor(config.command, a, end=config.duration)
        for name, a in (("4_mps2", ACCELERATION), ("mu_g", config.sim.friction * GRAVITY))
    }
    rows = [_row(row, total, floors, results) for row in experiment.rows]
    return {
        "config": config_hash(config),
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


def _write_page(folder: Path, record: dict[str, Any], args: Namespace) -> None:
    from kjax.viz.report import write_page

    rows = _table(record["experiments"])
    lines = ["| " + " | ".join(cells) + " |" for cells in (HEADER, *rows)]
    lines.insert(1, "|" + "---|" * len(HEADER))
    notes = list(NOTES)
    if record["quick"]:
        notes.insert(0, "A quick check of the machinery: these numbers are no result.")
    cli.write_text(folder / "table.md", "\n".join(lines) + "\n\n" + "\n\n".join(notes) + "\n")
    title = "Koopman LMPC for a quadruped: the paper's results, reproduced"
    figures = _figures(folder, record["experiments"], args)
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


def _figures(folder: Path, experiments: dict[str, Any], args: Namespace) -> list[tuple[str, str]]:
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
            runs, results = _load(folder, one["episodes"])
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


def _load(folder: Path, keys: list[str]) -> tuple[list[Series], list[dict[str, Any]]]:
    done = _read(folder / "episodes.json")["episodes"]
    return [load_series(folder / "series" / f"{key}.npz") for key in keys], [done[k] for k in keys]


if __name__ == "__main__":
    cli.run(main)
