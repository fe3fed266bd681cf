"""The page of the reproduction: its table, its figures, its notes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kjax import cli
from kjax.options import StudyOptions
from kjax.runs.cache import Cache
from kjax.sim.intervals import wilson
from kjax.sim.series import Series, load_series
from kjax.studies.reproduce.paper_results import (
    ACCELERATION,
    EXPERIMENTS,
    FIT,
    HELD,
    base_config,
    cycle,
)
from kjax.viz.tables import markdown_table

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
    "Times are of workers that share the machine; kjax bench measures them alone.",
)


def save_page(folder: Path, record: dict[str, Any], args: StudyOptions, cache: Cache) -> None:
    """Write table.md, index.html and the figures.

    Args:
      folder: of the study.
      record: what results.json holds.
      args: of the command line.
      cache: of the episodes.
    """
    from kjax.viz.page import Page, write_page

    rows = _table(record["experiments"])
    notes = list(NOTES)
    if record["quick"]:
        notes.insert(0, "A quick check of the machinery: this is no result.")
    text = "\n".join([markdown_table(HEADER, rows), *(f"{note}\n" for note in notes)])
    cli.write_text(folder / "table.md", text)
    title = "Koopman LMPC for a quadruped: the paper's results, reproduced"
    figures = _figures(folder, record["experiments"], args, cache)
    write_page(
        folder / "index.html",
        Page(
            title=title, notes=notes, header=HEADER, rows=rows,
            figures=[(folder / name, caption) for name, caption in figures],
            provenance=record["provenance"],
        ),
    )  # fmt: skip


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
    return [
        [name, base, label, "", "", value, interval, "", "", ""] for label, value, interval in shown
    ]


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
    folder: Path, experiments: dict[str, Any], args: StudyOptions, cache: Cache
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
