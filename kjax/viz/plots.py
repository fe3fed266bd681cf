"""Figures of closed-loop runs and of fit studies."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from kjax.config import RunConfig
from kjax.controllers.walkable import build_gaits
from kjax.sim import free_base
from kjax.sim.metrics import reference_height
from kjax.sim.resolve import resolve_goal
from kjax.sim.series import Series
from kjax.sim.trajectory import Trajectory
from kjax.types import JOINT_NAMES, Leg
from kjax.viz.style import BLUE, DARK, GREEN, GREY, ORANGE, RED, STYLE

_LEG_COLOURS = (RED, BLUE, ORANGE, GREEN)


def closed_loop_figure(run: Trajectory, config: RunConfig, path: Path, title: str = "") -> None:
    """Velocity, pitch, height, forces, torques and gait of one run (the paper's Fig. 4 and more).

    Args:
      run: the episode.
      config: its config.
      path: image file to write.
      title: shown on top.
    """
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            6, 1, figsize=(7.2, 9.0), height_ratios=[2.2, 1.3, 1.1, 1.4, 1.4, 1.3]
        )
        t = run.time
        velocity, pitch, height, force, torque, bars = axes
        window = max(1, round(stride_time(run.gait, config) / config.sim.sim_dt))
        velocity.plot(t, run.x[:, 3], color=GREY, lw=0.6, label="centre of mass")
        velocity.plot(t, moving_mean(run.x[:, 3], window), color=BLUE, label="mean over a stride")
        velocity.plot(t, run.velocity_command, "--", color=DARK, lw=1.1, label="command")
        velocity.set_ylabel("v_x [m/s]")
        _legend_above(velocity)
        velocity.set_title(title, loc="left", fontsize=9)

        if free_base.is_free(run.qpos):
            roll, _, yaw = free_base.attitude(run.qpos)
            pitch.plot(t, np.degrees(roll), color=RED, label="roll")
            pitch.plot(t, np.degrees(np.unwrap(yaw) - yaw[0]), color=GREY, label="yaw")
        pitch.plot(t, np.degrees(run.x[:, 2]), color=BLUE, label="pitch")
        pitch.set_ylabel("pitch [deg]\nnose up +")
        if free_base.is_free(run.qpos):
            pitch.set_ylabel("angles [deg]")
            _legend_above(pitch)

        height.plot(t, run.x[:, 1], color=BLUE)
        height.plot(
            t, reference_height(run.gait, t, resolve_goal(config)), ls="--", color=DARK, lw=0.9
        )
        height.set_ylabel("CoM height [m]")

        for axis in (velocity, pitch, height):
            axis.set_xlim(0, t[-1])
            axis.tick_params(labelbottom=False)
        height.tick_params(labelbottom=True)

        start, stop = zoom_window(t[-1], config)
        part = (t >= start) & (t <= stop)
        _forces(force, run, part)
        for joint, name in enumerate(JOINT_NAMES):
            peak = np.abs(run.torque[part, :, joint]).max(axis=1)
            torque.plot(t[part], peak, color=(GREY, BLUE, RED)[joint], label=name)
        torque.set_ylabel("largest |torque|\nof the legs [N m]")
        _legend_above(torque)
        gait_bars(bars, run, config.sim.contact_threshold, part)
        for axis in (force, torque, bars):
            axis.set_xlim(start, stop)
        bars.set_xlabel("time [s]  (lower three panels: a window)")
        fig.align_ylabels(axes)
        fig.tight_layout(h_pad=0.3)
        fig.savefig(path, dpi=140)
        plt.close(fig)


def stride_time(gait: np.ndarray, config: RunConfig) -> float:
    """Duration of a cycle of the gait that most of a run is in, flights at full length [s]."""
    most = build_gaits(config)[np.bincount(gait).argmax()]
    return sum(phase.duration for phase in most.phases)


def zoom_window(end: float, config: RunConfig) -> tuple[float, float]:
    """Two seconds about the largest step of the command, or the last two [s]."""
    times, velocities = config.command.times, config.command.v_x
    steps = [
        (abs(b - a), t)
        for t, a, b in zip(times[1:], velocities, velocities[1:], strict=False)
        if t < end
    ]
    middle = max(steps)[1] + 0.5 if steps else end - 1.0
    start = max(0.0, min(middle - 1.0, end - 2.0))
    return start, min(end, start + 2.0)


def _legend_above(axis: Axes) -> None:
    """A legend in one row, with room of its own above the curves."""
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.22 * (high - low))
    axis.legend(ncol=4, loc="upper left")


def _forces(axis: Axes, run: Trajectory, part: np.ndarray) -> None:
    for leg in Leg:
        axis.plot(run.time[part], run.force[part, leg, 2], color=_LEG_COLOURS[leg], label=leg.name)
        axis.plot(run.time[part], run.force[part, leg, 0], ":", color=_LEG_COLOURS[leg])
    axis.set_ylabel("planned force [N]\nF_z, dotted F_x")
    _legend_above(axis)


def gait_bars(axis: Axes, run: Trajectory | Series, threshold: float, part: np.ndarray) -> None:
    """Gait diagram: a bar where a foot touches, a thin line where it is scheduled to."""
    t = run.time[part]
    for row, leg in enumerate(reversed(Leg)):
        touching = run.foot_force[part, leg] > threshold
        axis.fill_between(
            t, row + 0.15, row + 0.75, where=touching, color=_LEG_COLOURS[leg], lw=0, step="post"
        )
        stance = np.where(run.stance[part, leg], row + 0.85, np.nan)
        axis.plot(t, stance, color=DARK, lw=1.4)
    axis.set_yticks(np.arange(4) + 0.45, [leg.name for leg in reversed(Leg)])
    axis.set_ylim(0, 4.1)
    axis.grid(False)
    axis.set_ylabel("contact\n(line: schedule)")


def moving_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Centred moving mean that shrinks at the ends."""
    total = np.cumsum(np.r_[0.0, values])
    index = np.arange(len(values))
    low = np.maximum(index - window // 2, 0)
    high = np.minimum(index + (window + 1) // 2, len(values))
    return (total[high] - total[low]) / (high - low)


def fit_figure(
    statistics: dict[str, Any], time: np.ndarray, path: Path, names: tuple[str, ...]
) -> None:
    """Prediction error against time, mean with the band of one standard deviation (Fig. 3).

    Args:
      statistics: per mode, ``mean``, ``std`` and ``max``, each (steps, 6).
      time: (steps,) time since the start of the prediction [s].
      path: image file to write.
      names: of the six states.
    """
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            2, len(statistics), figsize=(2.6 * len(statistics), 4.4), sharex=True, squeeze=False
        )
        colours = (BLUE, RED, "#2f855a")
        for column, (mode, values) in enumerate(statistics.items()):
            for row, states in enumerate(((0, 1, 2), (3, 4, 5))):
                axis = axes[row, column]
                for colour, state in zip(colours, states, strict=True):
                    mean, std = values["mean"][:, state], values["std"][:, state]
                    axis.plot(1e3 * time, mean, color=colour, label=names[state])
                    axis.fill_between(
                        1e3 * time, mean - std, mean + std, color=colour, alpha=0.18, lw=0
                    )
                    axis.plot(1e3 * time, values["max"][:, state], ":", color=colour, lw=0.8)
                axis.axhspan(-1e-4, 1e-4, color=GREY, alpha=0.25, lw=0, zorder=0)
                axis.set_yscale("symlog", linthresh=1e-4)
                axis.set_yticks([-1e-2, -1e-4, 0.0, 1e-4, 1e-2])
                axis.set_ylim(-_error_limit(statistics, states), _error_limit(statistics, states))
                axis.legend(loc="lower left", ncol=3, handlelength=1.0, columnspacing=0.8)
            axes[0, column].set_title(f"{mode}", fontsize=9)
            axes[1, column].set_xlabel("time [ms]")
        axes[0, 0].set_ylabel("error [m], [rad]")
        axes[1, 0].set_ylabel("error [m/s], [rad/s]")
        fig.suptitle(
            "mean (line), one standard deviation (band), largest |error| (dotted); grey: 1e-4",
            fontsize=8,
        )
        fig.tight_layout()
        fig.savefig(path, dpi=140)
        plt.close(fig)


def _error_limit(statistics: dict[str, Any], states: tuple[int, ...]) -> float:
    """Common axis limit of a row of panels: beyond the largest error of those states."""
    return 3.0 * max(float(values["max"][:, list(states)].max()) for values in statistics.values())
