"""Figures of sweeps: heat maps over two axes or curves over one, with confidence intervals."""

import warnings
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from scipy import stats

from kjax.config import SweepConfig
from kjax.viz.style import figure_style

_LEVEL = 0.95  # of all intervals


@figure_style
def sweep_figure(dataset: xr.Dataset, sweep: SweepConfig, path: Path) -> None:
    """Draw what the sweep's ``figure`` asks for: success, or medians of metrics, over its axes.

    Intervals hold with 95 %: Wilson's for success, that of the order statistics for a median.

    Raises:
      ValueError: for a metric or an axis that the sweep does not have.
    """
    wish = sweep.figure
    if wish is None:
        return
    dims = [str(dim) for dim in dataset["fell"].dims if dim != "seed"]
    x = wish.x or dims[-1]
    others = [dim for dim in dims if dim not in (x, wish.panels)]
    y = wish.y or (others[-1] if others else "")
    for name in filter(None, (x, y, wish.panels)):
        if name not in dims:
            raise ValueError(f"figure: no axis named '{name}', there are {', '.join(dims)}")
    panels = dataset[wish.panels].values if wish.panels else [None]
    fig, axes = plt.subplots(
        len(panels),
        len(wish.metrics),
        figsize=(1.0 + 4.4 * len(wish.metrics), 0.6 + 3.4 * len(panels)),
        layout="constrained",
        squeeze=False,
    )
    for row, panel in zip(axes, panels, strict=True):
        part = dataset if panel is None else dataset.sel({wish.panels: panel})
        for ax, metric in zip(row, wish.metrics, strict=True):
            rest = [str(d) for d in part["fell"].dims if d not in (x, y)]
            table = _table(part, metric, [name for name in (y, x) if name], rest)
            if y and table[y].dtype.kind in "fiu":
                _heat_map(ax, table, sweep, metric, x, y)
            elif y:  # words, such as rules: a curve for each
                for value in table[y].values:
                    _curve(ax, table.sel({y: value}), sweep, metric, x, label=str(value))
                ax.legend(title=_label(sweep, y), fontsize=7)
            else:
                _curve(ax, table, sweep, metric, x)
            if panel is not None:
                ax.set_title(f"{_label(sweep, wish.panels)}: {panel}")
    if wish.title:
        fig.suptitle(wish.title)
    fig.savefig(path)
    plt.close(fig)


def sweep_summary(dataset: xr.Dataset, sweep: SweepConfig) -> dict[str, Any]:
    """What the figure shows, as values with their intervals over the axes."""
    keep = [str(dim) for dim in dataset["fell"].dims if dim != "seed"]
    metrics = sweep.figure.metrics if sweep.figure else ("success",)
    out: dict[str, Any] = {
        "episodes_per_point": int(dataset.sizes["seed"]),
        "dimensions": keep,
        "success_is": criterion(dataset),
        **{name: dataset[name].values for name in sweep.axes},
    }
    for metric in metrics:
        table = _table(dataset, metric, keep, ["seed"])
        out[metric] = {part: np.round(table[part].values, 5) for part in ("value", "low", "high")}
    return out


def success(dataset: xr.Dataset) -> xr.DataArray:
    """Whether each episode ended without a fall, and across its field where there is one."""
    good = dataset["fell"] == 0
    if "crossed" in dataset:
        # A robot that fell has no such entry.
        good = good & (dataset["crossed"].fillna(0) > 0)
    return good


def criterion(dataset: xr.Dataset) -> str:
    """What counts as a success, in words."""
    return "stayed up and crossed the field" if "crossed" in dataset else "stayed up"


def _table(dataset: xr.Dataset, metric: str, keep: list[str], rest: list[str]) -> xr.Dataset:
    """Value and the ends of its interval over the axes to keep; ``rest`` are the repetitions."""
    if metric == "success":
        good = success(dataset).transpose(*keep, *rest)
        count = int(np.prod([good.sizes[name] for name in rest]))
        hits = good.sum(rest)
        low, high = xr.zeros_like(hits, float), xr.zeros_like(hits, float)
        for index in np.ndindex(*hits.shape):
            test = stats.binomtest(int(hits.values[index]), count)
            interval = test.proportion_ci(_LEVEL, method="wilson")
            low.values[index], high.values[index] = interval.low, interval.high
        return xr.Dataset({"value": hits / count, "low": low, "high": high})
    if metric not in dataset:
        known = ", ".join(sorted(map(str, dataset.data_vars)))
        raise ValueError(f"figure: no metric named '{metric}'; wanted 'success' or one of {known}")
    upright = dataset[metric].where(dataset["fell"] == 0)
    count = int(np.prod([upright.sizes[name] for name in rest]))
    # Ranks between which the median lies with 95 %, by the binomial distribution.
    edge = stats.binom.ppf(0.5 * (1.0 - _LEVEL), count, 0.5) / max(count - 1, 1)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # where all fell
        quantiles = upright.quantile([0.5, edge, 1.0 - edge], rest)
    value, low, high = (quantiles.isel(quantile=i, drop=True) for i in range(3))
    return xr.Dataset({"value": value, "low": low, "high": high}).transpose(*keep)


def _heat_map(ax: Any, table: xr.Dataset, sweep: SweepConfig, metric: str, x: str, y: str) -> None:
    values = table["value"].values
    fraction = metric == "success"
    image = ax.imshow(
        values,
        origin="lower",
        aspect="auto",
        cmap="viridis" if fraction else "magma_r",
        vmin=0.0 if fraction else None,
        vmax=1.0 if fraction else None,
    )
    for index in np.ndindex(*values.shape):
        value = values[index]
        if not np.isfinite(value):
            continue
        half = 0.5 * (table["high"].values[index] - table["low"].values[index])
        text = f"{100 * value:.0f}\n±{100 * half:.0f}" if fraction else f"{value:.2g}\n±{half:.1g}"
        red, green, blue, _ = image.cmap(image.norm(value))
        bright = 0.3 * red + 0.6 * green + 0.1 * blue > 0.5
        color = "black" if bright else "white"
        ax.text(index[1], index[0], text, ha="center", va="center", color=color, fontsize=6.5)
    for axis, name in ((ax.xaxis, x), (ax.yaxis, y)):
        labels = [f"{v:g}" if isinstance(v, float | int) else str(v) for v in table[name].values]
        axis.set_ticks(range(len(labels)), labels)
        if axis is ax.xaxis and len(labels) > 8:
            ax.tick_params(axis="x", rotation=60)
        axis.set_label_text(_label(sweep, name))
    ax.figure.colorbar(image, ax=ax, label=_quantity(metric))


def _curve(
    ax: Any, table: xr.Dataset, sweep: SweepConfig, metric: str, x: str, label: str | None = None
) -> None:
    at = table[x].values
    if at.dtype.kind not in "fiu":
        ax.set_xticks(range(len(at)), [str(a) for a in at])
        at = np.arange(len(at))
    ax.fill_between(at, table["low"], table["high"], alpha=0.25, lw=0)
    ax.plot(at, table["value"], "o-", ms=3, label=label)
    ax.set(xlabel=_label(sweep, x), ylabel=_quantity(metric))
    if metric == "success":
        ax.set_ylim(-0.03, 1.03)
    else:
        ax.relim()
        ax.autoscale(axis="y")  # a curve before this one may have set the limits
        ax.set_ylim(bottom=0.0)
    ax.grid(alpha=0.3)


def _quantity(metric: str) -> str:
    """A metric's name with its unit apart: pitch_max_deg becomes "pitch max [deg]"."""
    for suffix, unit in (("_deg", "deg"), ("_mps", "m/s"), ("_m", "m"), ("_s", "s")):
        if metric.endswith(suffix):
            return f"{metric.removesuffix(suffix).replace('_', ' ')} [{unit}]"
    return f"{metric.replace('_', ' ')} [-]"


def _label(sweep: SweepConfig, name: str) -> str:
    axis = sweep.axes[name]
    unit = "" if axis.unit == "-" else f" [{axis.unit}]"
    return (axis.label or name.replace("_", " ")) + unit
