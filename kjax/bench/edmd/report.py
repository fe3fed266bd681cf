"""What benchmark.py edmd tabulates and draws."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax.bench.edmd.data import DICTIONARIES, LOOP, PAPER, SEEDS, VELOCITIES
from kjax.types import STATE_NAMES
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table


def table(result: dict[str, Any]) -> str:
    """All of it as Markdown."""
    parts = [_fits(result)]
    if result["missing"]:
        parts.append(f"Not measured: {', '.join(result['missing'])}.\n")
    for name, number in result["fits"]["many_timed"].items():
        if number < len(DICTIONARIES) * SEEDS:
            parts.append(
                f"Of the 100 fits of {name}, {number} were timed; the rest by proportion.\n"
            )
    return "\n".join([*parts, _rollouts(result["rollouts"]), _stream(result["stream"])])


def _fits(result: dict[str, Any]) -> str:
    found = result["fits"]
    names = list(found["fit_ms"])
    titles = [f"{name} {result['peers'].get(name, '')}".strip() for name in names]
    rows = [
        [title, *(f"{found[key][name]:.3g} {unit}" for name in names)]
        for key, title, unit in (
            ("fit_ms", "10,000 snapshots, from states", "ms"),
            ("regression_ms", "the regression alone, from lifted states", "ms"),
            ("many_s", "100 fits, from states", "s"),
            ("many_lifted_s", "100 fits, each data set lifted once", "s"),
        )
    ]
    for i, velocity in enumerate(STATE_NAMES[VELOCITIES]):
        unit = "rad/s" if velocity == "omega" else "m/s"
        values = [f"{found['error'][name]['max'][i]:.2e}" for name in names]
        rows.append([f"largest error of {velocity} after 50 ms [{unit}]", *values])
    return markdown_table([f"one fit, {PAPER.size} observables", *titles], rows)


def _rollouts(rates: dict[str, float]) -> str:
    titles = {
        "kjax": "kjax, one compiled call",
        "numpy_vectorised": "NumPy, vectorised over rollouts",
        "numpy_loop": f"NumPy, rollout by rollout and step by step ({LOOP} timed)",
    }
    rows = [(title, f"{rates[name]:,.0f}") for name, title in titles.items()]
    return markdown_table(("rollouts of 100 steps", "per second"), rows)


def _stream(flow: dict[str, Any]) -> str:
    rows = [
        ("lifted and into the QR factor", f"{flow['snapshots_per_s']:,.0f} per second"),
        ("with their drawing", f"{flow['snapshots_per_s_with_drawing']:,.0f} per second"),
        ("peak memory, programs included", f"{flow['peak_MB']:.0f} MB"),
        ("of it after the first hundredth", f"{flow['growth_MB']:.0f} MB"),
        ("what all rows would take", f"{flow['all_rows_MB']:,.0f} MB"),
        ("coefficients, relative to one factorisation",
         f"{flow['coefficients_difference']:.1e}"),
    ]  # fmt: skip
    return markdown_table((f"stream of {flow['snapshots']:,} snapshots", ""), rows)


@figure_style
def figure(result: dict[str, Any], path: Path) -> None:
    """Times of the fits and rates of the rollouts."""
    fig, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    found, data = result["fits"], result["rollouts"]
    panels = (
        ("fit_ms", "regression_ms", "regression alone", "one fit, 10,000 snapshots", "ms"),
        ("many_s", "many_lifted_s", "lifted once", "10 data sets x 10 dictionaries", "s"),
    )
    for ax, (*keys, label, title, unit) in zip(axes[:2], panels, strict=True):
        labels = ("from states", label)
        names = list(found[keys[0]])
        place = np.arange(len(names))
        for i, (key, label) in enumerate(zip(keys, labels, strict=True)):
            ax.bar(place + 0.4 * i - 0.2, [found[key][n] for n in names], 0.4, label=label)
        ax.set_xticks(place, names)
        ax.set(title=title, ylabel=f"time [{unit}]")
        ax.legend()
    rivals = ("kjax", "NumPy,\nvectorised", "NumPy,\nloop")
    axes[2].bar(rivals, [data[n] for n in ("kjax", "numpy_vectorised", "numpy_loop")])
    axes[2].set(title="data: rollouts of 100 steps", ylabel="rollouts per second", yscale="log")
    fig.savefig(path)
    plt.close(fig)
