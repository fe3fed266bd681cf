"""What tune.py tabulates and draws."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax.config import RunConfig
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table


def table(record: dict[str, Any]) -> str:
    """Markdown."""
    rows = []
    for name, entry in record["mujoco"].items():

        def cell(key: str, entry: dict[str, Any] = entry) -> str:
            if key not in entry:
                return "-"
            return f"{entry[key]['median']:.3g} ({entry[key]['worst']:.3g})"

        rows.append(
            (name, f"{record['held_out_cost'][name]:.3f}", f"{entry['falls']} of {entry['runs']}",
             cell("velocity_rmse_mps"), cell("pitch_p95_deg"), f"{entry['cost_median']:.3f}")
        )  # fmt: skip
    header = ("parameters", "held-out cost, rigid body", "MuJoCo: fell", "RMSE of v_x [m/s]",
              "pitch, 95 % [deg]", "cost")  # fmt: skip
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
    first = next(iter(runs.values()))
    time_axis = np.arange(len(first.x)) * dt
    speed.plot(time_axis, first.wanted[:, 0], "k--", lw=0.9, label="reference")
    for name, run in runs.items():
        shown = np.where(run.alive[:, None], run.x, np.nan)
        speed.plot(time_axis, shown[:, 3], lw=0.9, label=name)
        pitch.plot(time_axis, np.degrees(shown[:, 2]), lw=0.9, label=name)
    speed.set(xlabel="time [s]", ylabel="v_x [m/s]", title="a held-out scenario, rigid body")
    pitch.set(xlabel="time [s]", ylabel="pitch [deg]")
    fig.legend(*speed.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    fig.savefig(path)
    plt.close(fig)
