"""Figures over many episodes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from kjax.config import RunConfig
from kjax.moved import moved_names
from kjax.sim.resolve import resolve_field
from kjax.sim.series import Series
from kjax.sim.terrain import generate, shapes
from kjax.viz.plots import gait_bars, moving_mean, zoom_window
from kjax.viz.style import BLUE, DARK, GREY, RED, STYLE

__getattr__ = moved_names(__name__)

_BEFORE, _AFTER = 0.5, 2.0  # s about a switch
_THIN = {"color": GREY, "lw": 0.4, "alpha": 0.6}


def tracking_figure(
    runs: Sequence[Series], config: RunConfig, path: Path, title: str, cycle: float
) -> None:
    """Velocity, pitch and contacts on a velocity profile (the paper's figures of trot and bound).

    Args:
      runs: episodes; the first is drawn in full, the others as thin lines.
      config: of them.
      path: image file to write.
      title: shown on top.
      cycle: of the gait, over which the velocity is averaged [s].
    """
    first = runs[0]
    window = max(1, round(cycle / _step(first)))
    with plt.rc_context(STYLE):
        fig, (velocity, pitch, bars) = plt.subplots(
            3, 1, figsize=(7.2, 5.6), height_ratios=[2.0, 1.3, 1.0]
        )
        for run in runs[1:]:
            velocity.plot(run.time, moving_mean(run.x[:, 3], window), **_THIN)
            pitch.plot(run.time, np.degrees(run.x[:, 2]), **_THIN)
        velocity.plot(first.time, first.x[:, 3], color=GREY, lw=0.5, label="centre of mass")
        velocity.plot(
            first.time, moving_mean(first.x[:, 3], window), color=BLUE, label="mean over a cycle"
        )
        _commands(velocity, first)
        pitch.plot(first.time, np.degrees(first.x[:, 2]), color=BLUE)
        velocity.set_ylabel("v_x [m/s]")
        velocity.legend(ncol=4, loc="upper left")
        velocity.set_title(f"{title} (coloured: the first of {len(runs)})", loc="left", fontsize=9)
        pitch.set_ylabel("pitch [deg]\nnose up +")
        for axis in (velocity, pitch):
            axis.set_xlim(0, max(run.time[-1] for run in runs))
        start, stop = zoom_window(float(first.time[-1]), config)
        part = (first.time >= start) & (first.time <= stop)
        gait_bars(bars, first, config.sim.contact_threshold, part)
        bars.set_xlim(start, stop)
        bars.set_xlabel("time [s]  (lowest panel: a window)")
        _finish(fig, path)


def terrain_figure(
    runs: Sequence[Series], config: RunConfig, path: Path, title: str, cycle: float
) -> None:
    """Velocity, pitch and the field along the way (the paper's figure of rough terrain).

    Args:
      runs: episodes, each on a field of its own; the first one's is drawn.
      config: of the first.
      path: image file to write.
      title: shown on top.
      cycle: of the gait, over which the velocity is averaged [s].
    """
    first = runs[0]
    window = max(1, round(cycle / _step(first)))
    with plt.rc_context(STYLE):
        fig, (velocity, pitch, field) = plt.subplots(
            3, 1, figsize=(7.2, 5.6), sharex=True, height_ratios=[1.5, 1.5, 1.0]
        )
        for run in runs[1:]:
            velocity.plot(run.x[:, 0], moving_mean(run.x[:, 3], window), **_THIN)
            pitch.plot(run.x[:, 0], np.degrees(run.x[:, 2]), **_THIN)
        velocity.plot(first.x[:, 0], moving_mean(first.x[:, 3], window), color=BLUE)
        velocity.plot(first.x[:, 0], first.velocity_command, "--", color=DARK, lw=1.0)
        pitch.plot(first.x[:, 0], np.degrees(first.x[:, 2]), color=BLUE)
        pitch.axhspan(-3.0, 3.0, color=GREY, alpha=0.25, lw=0, zorder=0)
        field.plot(first.x[:, 0], first.x[:, 1], color=BLUE, label="centre of mass")
        _obstacles(field, config)
        field.set_ylim(0.0, 0.45)
        velocity.set_ylabel("v_x, mean over\na cycle [m/s]")
        pitch.set_ylabel("pitch [deg]\ngrey: ±3°")
        field.set_ylabel("height [m]")
        field.set_xlabel("way [m]")
        velocity.set_title(
            f"{title} (coloured: the first of {len(runs)}, on the field below)",
            loc="left", fontsize=9,
        )  # fmt: skip
        field.set_xlim(-0.1, config.terrain.end + 0.8)
        _finish(fig, path)


def switch_figure(
    groups: Mapping[str, tuple[Sequence[Series], Sequence[float]]], path: Path
) -> None:
    """Pitch against the time since the switch: all episodes thin, their median bold.

    Args:
      groups: title -> (episodes, time of each one's switch [s]).
      path: image file to write.
    """
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            1, len(groups), figsize=(2.9 * len(groups), 2.9), sharey=True, squeeze=False
        )
        grid = np.arange(-_BEFORE, _AFTER, 0.005)
        for axis, (title, (runs, times)) in zip(axes[0], groups.items(), strict=True):
            rows = []
            for run, at in zip(runs, times, strict=True):
                pitch = np.degrees(run.x[:, 2])
                axis.plot(run.time - at, pitch, **_THIN)
                rows.append(np.interp(grid, run.time - at, pitch, left=np.nan, right=np.nan))
            if rows:
                known = np.isfinite(rows).mean(axis=0) >= 0.5
                median = np.nanmedian(np.array(rows)[:, known], axis=0)
                axis.plot(grid[known], median, color=RED, lw=1.6)
            axis.axvline(0.0, color=DARK, lw=0.8)
            axis.set_title(f"{title}\nn = {len(runs)}", loc="left", fontsize=8)
            axis.set_xlim(-_BEFORE, _AFTER)
            axis.set_xlabel("time since the switch [s]")
        axes[0, 0].set_ylabel("pitch [deg], nose up +")
        _finish(fig, path)


def envelope_figure(axes_found: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """One panel per quantity: a dot at the hardest value that passed, a bar to the first failure.

    Args:
      axes_found: name -> ``title``, ``quantity``, ``unit``, ``easy``, ``passed`` and ``failed``;
        where there are any ``reached_mps``, and ``phases`` with limits of their own.
      path: image file to write.
    """
    panels: dict[str, list[Mapping[str, Any]]] = {}
    for one in axes_found.values():
        panels.setdefault(f"{one['quantity']} [{one['unit']}]", []).append(one)
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            len(panels), 1, squeeze=False, figsize=(6.0, 0.7 + sum(
                0.55 + 0.25 * len(rows) for rows in panels.values())),
            height_ratios=[0.6 + 0.3 * len(rows) for rows in panels.values()],
        )  # fmt: skip
        for axis, (quantity, rows) in zip(axes[:, 0], panels.items(), strict=True):
            for y, one in enumerate(rows):
                _bracket(axis, y, one)
            axis.set_yticks(range(len(rows)), [str(one["title"]) for one in rows])
            axis.set_ylim(len(rows) - 0.4, -0.6)
            axis.set_xlim(0.0, 1.08 * axis.get_xlim()[1])  # room for the numbers
            axis.set_xlabel(quantity)
            axis.set_title(_limits_title(rows), loc="left", fontsize=8)
        fig.suptitle("dot: passed; bar: up to what failed; triangle: the end of the search passed; "
                     "stroke: limit of a phase", fontsize=8)  # fmt: skip
        _finish(fig, path)


def _limits_title(rows: list[Mapping[str, Any]]) -> str:
    """The finding of a panel: its lowest and its highest limit."""
    known = sorted((one for one in rows if one["passed"] is not None), key=lambda o: o["passed"])
    if not known:
        return "nothing passes"

    def value(one: Mapping[str, Any]) -> str:
        unit = "" if one["unit"] == "-" else f" {one['unit']}"
        return f"{'' if one['failed'] is not None else 'at least '}{one['passed']:.3g}{unit}"

    low, high = known[0], known[-1]
    if value(low) == value(high):
        whose = "each" if len(known) == len(rows) > 1 else low["title"]
        return f"{low['quantity']}: {value(low)} ({whose})"
    return f"{low['quantity']}: {value(low)} ({low['title']}) to {value(high)} ({high['title']})"


def _bracket(axis: Axes, y: int, one: Mapping[str, Any]) -> None:
    passed, failed = one["passed"], one["failed"]
    own = [phase["passed"] for phase in one.get("phases", ()) if phase["passed"] is not None]
    axis.plot(own, [y] * len(own), "|", color=DARK, ms=9)
    if passed is None:
        axis.plot(one["easy"], y, "x", color=RED)
        axis.annotate("fails", (one["easy"], y), (6, -3), textcoords="offset points")
        return
    if failed is not None:
        axis.plot([passed, failed], [y, y], color=GREY, lw=4, solid_capstyle="butt")
    axis.plot(passed, y, "o" if failed is not None else ">", color=BLUE)
    reached = one.get("reached_mps") if one["unit"] == "m/s" else None
    text = f"{passed:.3g}" + ("" if reached is None else f", reached {reached:.3g}")
    axis.annotate(text, (passed, y), (0, 5), textcoords="offset points", ha="center")


def _commands(axis: Axes, run: Series) -> None:
    axis.plot(run.time, run.velocity_command, "--", color=DARK, lw=1.1, label="command")
    if np.abs(run.velocity_reference - run.velocity_command).max() > 1e-6:
        axis.plot(run.time, run.velocity_reference, ":", color=RED, lw=1.0, label="reference")


def _obstacles(axis: Axes, config: RunConfig) -> None:
    """Side view of the field: boxes turned about y, capsules as circles."""
    field = resolve_field(config)
    terrain = generate(field)
    for kind, pos, quat, size in zip(
        shapes(field.kind, field.count), terrain.pos, terrain.quat, terrain.size, strict=True
    ):
        x, z = pos[0], pos[2]
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            axis.add_patch(Circle((x, z), size[0], color="#8c6b50", lw=0))
            continue
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, quat)
        corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * size
        seen = corners @ matrix.reshape(3, 3).T
        order = np.argsort(np.arctan2(seen[:, 2], seen[:, 0]))
        axis.add_patch(Polygon(seen[order][:, [0, 2]] + (x, z), color="#8c6b50", lw=0))


def _step(run: Series) -> float:
    return float(run.time[1] - run.time[0])


def _finish(fig: Any, path: Path) -> None:
    fig.align_ylabels()
    fig.tight_layout(h_pad=0.4)
    fig.savefig(path, dpi=140)
    plt.close(fig)
