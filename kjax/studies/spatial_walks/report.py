"""Table and figure of the study."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax.studies.spatial.cases import Row, number, percent
from kjax.studies.spatial_walks.cases import CASES
from kjax.viz.style import BLUE, GREY, figure_style
from kjax.viz.tables import markdown_table

WEIGHTS = {"tuned": BLUE, "shipped": GREY}


def table(record: Row) -> str:
    """Markdown: what the models cost, and what they stand."""
    names = record["cases"]
    walks = [name for name in names if not CASES[name].is_disturbed]
    disturbed = [name for name in names if CASES[name].is_disturbed]
    blocks = [_costs(record, walks), _disturbed(record, disturbed)]
    text = "\n".join(block for block in blocks if block)
    if record["quick"]:
        text += "\nA quick check of the machinery: this is no result.\n"
    return text


def _rows(record: Row) -> list[tuple[str, str, Row]]:
    return [
        (model, key, entry[key]) for model, entry in record["models"].items() for key in WEIGHTS
    ]


def _costs(record: Row, names: Sequence[str]) -> str:
    if not names:
        return ""
    header = ("model", "weights", "cost on the tuning seeds", *(CASES[n].title for n in names))
    rows = []
    for model, key, found in _rows(record):
        costs = record["models"][model]["tuning_cost"]
        tuning = costs["best" if key == "tuned" else "shipped"]
        rows.append((model, key, number(tuning, 2), *(_cost(found[name]) for name in names)))
    return markdown_table(header, rows)


def _cost(found: Row) -> str:
    """Median, its interval, and falls where there are any."""
    falls = found["falls"]
    fell = f"{falls['count']} of {falls['episodes']} fell" if falls["count"] else ""
    return "; ".join(part for part in (_interval(found, "cost", 2), fell) if part)


def _interval(found: Row, name: str, digits: int) -> str:
    value, interval = found[name], found[f"{name}_interval"]
    if value is None or interval is None:
        return number(value, digits)
    return f"{value:.{digits}f} ({interval[0]:.{digits}f} to {interval[1]:.{digits}f})"


def _disturbed(record: Row, names: Sequence[str]) -> str:
    if not names:
        return ""
    header = ["model", "weights"]
    for name in names:
        title = CASES[name].title
        header += [f"{title}: fell", "95 % interval [%]", "largest tilt [deg]"]
    rows = []
    for model, key, found in _rows(record):
        cells = [model, key]
        for name in names:
            falls = found[name]["falls"]
            cells += [
                f"{falls['count']} of {falls['episodes']}", percent(falls["interval"]),
                _interval(found[name], "largest_tilt_deg", 1),
            ]  # fmt: skip
        rows.append(tuple(cells))
    return markdown_table(tuple(header), rows)


@figure_style
def figure(record: Row, path: Path) -> None:
    """Each case with every model: what it costs, or the largest tilt; falls beside it."""
    names, models = record["cases"], list(record["models"])
    columns = min(3 if len(names) > 4 else 2, len(names))
    lines = -(-len(names) // columns)
    fig, axes = plt.subplots(
        lines, columns, figsize=(1.4 + 2.7 * columns, 0.9 + 0.35 * lines * (2 + len(models))),
        sharey=True, squeeze=False, layout="constrained",
    )  # fmt: skip
    for ax, name in zip(axes.flat, names, strict=False):
        _draw(ax, record, name)
    for ax in axes.flat[len(names) :]:
        ax.set_axis_off()
    axes[0, 0].set_yticks(range(len(models)), models)
    axes[0, 0].set_ylim(len(models) - 0.5, -0.5)
    fig.suptitle(title(record))
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=2)
    fig.savefig(path)
    plt.close(fig)


def _draw(ax: Any, record: Row, name: str) -> None:
    case = CASES[name]
    what = "largest_tilt_deg" if case.is_disturbed else "cost"
    for shift, (key, colour) in zip((-0.15, 0.15), WEIGHTS.items(), strict=True):
        for place, entry in enumerate(record["models"].values()):
            found = entry[key][name]
            value, interval, falls = found[what], found[f"{what}_interval"], found["falls"]
            label = f"{key} weights" if place == 0 else None
            value = np.nan if value is None else value
            low, high = (value, value) if interval is None else interval
            ax.errorbar([value], [place + shift], xerr=[[value - low], [high - value]], fmt="o",
                        ms=4, color=colour, capsize=2, label=label)  # fmt: skip
            if falls["count"]:
                ax.annotate(f" {falls['count']} of {falls['episodes']} fell",
                            (1.0, place + shift), xycoords=("axes fraction", "data"), ha="right",
                            va="center", fontsize=6, color=colour)  # fmt: skip
    ax.set(title=case.title, xlabel="largest tilt [deg]" if case.is_disturbed else "cost [-]")
    if not case.is_disturbed:
        ax.set_xscale("log")


def title(record: Row) -> str:
    """The finding: which tuned model is the cheapest where, and whether its interval is its own."""
    best: dict[str, list[str]] = {}
    close: list[str] = []
    for name in record["cases"]:
        found = {
            model: entry["tuned"][name] for model, entry in record["models"].items()
            if entry["tuned"][name]["cost"] is not None
        }  # fmt: skip
        if CASES[name].is_disturbed or len(found) < 2:
            continue
        first, *rest = sorted(found, key=lambda model: found[model]["cost"])
        intervals = [found[model]["cost_interval"] for model in (first, *rest)]
        is_apart = all(intervals) and all(one[0] > intervals[0][1] for one in intervals[1:])
        (best.setdefault(first, []) if is_apart else close).append(CASES[name].title)
    said = [f"Tuned alike, {model} costs least: {'; '.join(won)}" for model, won in best.items()]
    if close:
        said.append("No model is clearly best: " + "; ".join(close))
    return "\n".join(said) or "Tuned and shipped weights"
