"""What tune.py tabulates and draws."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax.config import RunConfig
from kjax.tuning.loop import plant_of
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table

# Metrics of MuJoCo in the table; those that one controller alone gives where it gives them.
COLUMNS = {
    "velocity_rmse_mps": "RMSE of v_x [m/s]",
    "velocity_y_rmse_mps": "v_y [m/s]",
    "yaw_rate_rmse_radps": "yaw rate [rad/s]",
    "roll_p95_deg": "roll, 95 % [deg]",
    "pitch_p95_deg": "pitch, 95 % [deg]",
}
ALWAYS = ("velocity_rmse_mps", "pitch_p95_deg")


def table(record: dict[str, Any]) -> str:
    """Markdown."""
    rows = []
    columns = {
        key: title for key, title in COLUMNS.items()
        if key in ALWAYS or any(key in entry for entry in record["mujoco"].values())
    }  # fmt: skip
    for name, entry in record["mujoco"].items():

        def cell(key: str, entry: dict[str, Any] = entry) -> str:
            if key not in entry:
                return "-"
            return f"{entry[key]['median']:.3g} ({entry[key]['worst']:.3g})"

        rows.append(
            (name, f"{record['held_out_cost'][name]:.3f}", f"{entry['falls']} of {entry['runs']}",
             *map(cell, columns), f"{entry['cost_median']:.3f}")
        )  # fmt: skip
    header = ("parameters", "held-out cost, rigid body", "MuJoCo: fell", *columns.values(), "cost")
    return markdown_table(header, rows)


@figure_style
def figure(record: dict[str, Any], runs: dict[str, Any], config: RunConfig, path: Path) -> None:
    """Loss curve; one held-out scenario before and after."""
    fig, (curve, speed, pitch) = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
    descent, costs = record["descent"], record["held_out_cost"]
    curve.plot(descent["cost"], lw=0.8, label="training scenarios")
    curve.plot(descent["checks"], descent["held_out"], "o-", ms=2.5, label="held out")
    curve.axhline(costs["own"], color="k", ls="--", lw=0.8, label="config's own parameters")
    curve.set(xlabel="update of Adam", ylabel="cost [-]", yscale="log")
    curve.legend()
    dt = config.lmpc.control_dt
    first, plant = next(iter(runs.values())), plant_of(config)
    time_axis = np.arange(len(first.x)) * dt
    speed.plot(time_axis, first.wanted[:, 0], "k--", lw=0.9, label="reference")
    for name, run in runs.items():
        shown = np.where(run.alive[:, None], run.x, np.nan)
        speed.plot(time_axis, shown[:, plant.v_x], lw=0.9, label=name)
        pitch.plot(time_axis, np.degrees(shown[:, plant.pitch]), lw=0.9, label=name)
    speed.set(xlabel="time [s]", ylabel="v_x [m/s]", title="a held-out scenario, rigid body")
    pitch.set(xlabel="time [s]", ylabel="pitch [deg]")
    fig.legend(*speed.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    fig.savefig(path)
    plt.close(fig)
