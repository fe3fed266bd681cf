"""Table and figure of the study."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from kjax.studies.spatial.cases import Row, number
from kjax.studies.spatial_residual.prediction import QUANTITIES, UNITS
from kjax.viz.style import BLUE, GREY, figure_style
from kjax.viz.tables import markdown_table

TITLES = {"body": "rigid body", "residual": "with the residual"}
WORDS = {
    "attitude": "attitude", "place": "centre of mass", "rate": "angular velocity",
    "velocity": "velocity",
}  # fmt: skip


def table(record: Row) -> str:
    """Markdown: errors of both predictions, then how both walk."""
    times = [row["time_s"] for row in record["prediction"]["body"]]
    header = ("error of the prediction", "model", *(f"after {1e3 * t:.0f} ms" for t in times))
    rows = [
        (f"{WORDS[name]} [{unit}]", title, *(_cell(row[name]) for row in record["prediction"][key]))
        for name, unit in zip(QUANTITIES, UNITS, strict=True)
        for key, title in TITLES.items()
    ]
    walked = [
        (
            ", ".join(f"{part:g}" for part in row["command"]), title,
            f"{row['falls']} of {row['episodes']}", number(row["v_x_rmse_mps"], 4),
            number(row["v_y_rmse_mps"], 4), number(row["yaw_rate_cycle_rmse_radps"], 4),
            number(row["roll_p95_deg"], 2), number(row["pitch_p95_deg"], 2),
        )
        for rows_of in zip(*(record["walks"][key] for key in TITLES), strict=True)
        for row, title in zip(rows_of, TITLES.values(), strict=True)
    ]  # fmt: skip
    columns = ("v_x, v_y [m/s], yaw rate [rad/s]", "model", "falls", "RMSE v_x [m/s]", "v_y [m/s]",
               "yaw rate of a cycle [rad/s]", "roll, 95 % [deg]", "pitch, 95 % [deg]")  # fmt: skip
    text = markdown_table(header, rows) + "\n" + markdown_table(columns, walked)
    if record["quick"]:
        text += "\nA quick check of the machinery: this is no result.\n"
    return text


def _cell(found: Row) -> str:
    """Median and its interval."""
    text, interval = f"{found['median']:.2g}", found["interval"]
    return text if interval is None else f"{text} ({interval[0]:.2g} to {interval[1]:.2g})"


@figure_style
def figure(record: Row, path: Path) -> None:
    """Each error against the time that is predicted."""
    fig, axes = plt.subplots(1, 4, figsize=(9.5, 2.7), layout="constrained")
    for ax, name, unit in zip(axes, QUANTITIES, UNITS, strict=True):
        for key, colour in (("body", GREY), ("residual", BLUE)):
            _draw(ax, record["prediction"][key], name, colour, TITLES[key])
        ax.set(xlabel="predicted [ms]", ylabel=f"{WORDS[name]} [{unit}]", ylim=(0.0, None))
    axes[0].legend(fontsize="small")
    last = [record["prediction"][key][-1] for key in TITLES]
    times = [last[0][name]["median"] / last[1][name]["median"] for name in ("attitude", "place")]
    fig.suptitle(
        f"After {1e3 * last[0]['time_s']:.0f} ms the residual has divided the error of the "
        f"attitude by {times[0]:.1f}, of the place by {times[1]:.1f}"
    )
    fig.savefig(path)
    plt.close(fig)


def _draw(ax: Any, rows: list[Row], name: str, colour: str, label: str) -> None:
    time = [1e3 * row["time_s"] for row in rows]
    ax.plot(time, [row[name]["median"] for row in rows], "o-", ms=3, color=colour, label=label)
    intervals = [row[name]["interval"] for row in rows]
    if all(intervals):
        ax.fill_between(
            time, [one[0] for one in intervals], [one[1] for one in intervals],
            color=colour, alpha=0.25, lw=0,
        )  # fmt: skip
