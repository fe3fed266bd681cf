"""Table and figure of the study."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax.studies.robots.cases import CASES
from kjax.studies.spatial.cases import Row, number
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table

ENOUGH = 0.95  # share of episodes


def table(record: Row) -> str:
    """Markdown: a robot a line; of each case successes, RMSE of the speed asked for, tilt."""
    names = _cases(record)
    header = ("robot", "mass [kg]", "leg [m]", *(CASES[name].title for name in names))
    rows = [
        (_short(robot), number(found["mass_kg"], 1), number(found["leg_m"], 2),
         *(_cell(name, found["cases"][name]) for name in names))
        for robot, found in record["robots"].items()
    ]  # fmt: skip
    text = markdown_table(header, rows)
    if record["quick"]:
        text += "\nA quick check of the machinery: this is no result.\n"
    return text


def _cases(record: Row) -> list[str]:
    return list(next(iter(record["robots"].values()))["cases"])


def _short(robot: str) -> str:
    """Name without its package or folder."""
    return Path(robot.rpartition(":")[2]).stem


def _cell(name: str, found: Row) -> str:
    """Successes; RMSE of what was asked; 95 % of the tilt."""
    if "refused" in found:
        return "refused"
    done = found["success"]
    parts = [f"{done['count']} of {done['episodes']}"]
    if done["count"]:
        parts += [one for one in (_error(name, found),) if one]
        parts.append(f"{number(found['tilt_p95_deg'], 1)} deg")
    return ", ".join(parts)


def _error(name: str, found: Row) -> str:
    v_x, v_y, rate = CASES[name].velocity
    if CASES[name].impulse or not (v_x or v_y or rate):
        return ""
    if rate:
        return f"{number(found['yaw_rate_cycle_rmse_radps'], 3)} rad/s"
    return f"{number(found['v_x_rmse_mps' if v_x else 'v_y_rmse_mps'], 3)} m/s"


@figure_style
def figure(record: Row, path: Path) -> None:
    """Share of successes of each robot in each case."""
    names, robots = _cases(record), list(record["robots"])
    shares = np.array(
        [[_share(record["robots"][robot]["cases"][name]) for name in names] for robot in robots]
    )
    fig, ax = plt.subplots(
        figsize=(1.8 + 0.95 * len(names), 1.4 + 0.32 * len(robots)), layout="constrained"
    )
    ax.imshow(shares, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto", alpha=0.75)
    for i, row in enumerate(shares):
        for j, value in enumerate(row):
            text = "too weak" if np.isnan(value) else f"{100 * value:.0f} %"
            ax.text(j, i, text, ha="center", va="center", fontsize=7)
    ax.set_xticks(range(len(names)), [CASES[name].title for name in names], rotation=30, ha="right")
    ax.set_yticks(
        range(len(robots)),
        [f"{_short(robot)}, {record['robots'][robot]['mass_kg']:.0f} kg" for robot in robots],
    )
    ax.tick_params(length=0)
    ax.grid(visible=False)
    ax.set_title(title(record))
    fig.savefig(path)
    plt.close(fig)


def _share(found: Row) -> float:
    """Of the episodes; of a gait that the robot is too weak for there is none."""
    if "refused" in found:
        return float("nan")
    return float(found["success"]["count"] / found["success"]["episodes"])


def title(record: Row) -> str:
    """The finding: how many robots do how many of the cases."""
    names, robots = _cases(record), record["robots"]
    able: dict[str, Any] = {
        name: sum(_share(found["cases"][name]) >= ENOUGH for found in robots.values())
        for name in names
    }
    all_of = [CASES[name].title for name in names if able[name] == len(robots)]
    some = [f"{CASES[n].title}: {able[n]}" for n in names if able[n] < len(robots)]
    text = f"With one config, {len(robots)} robots of {len(robots)} can (95 % of the episodes): "
    text = text + ", ".join(all_of) if all_of else f"Of {len(robots)} robots can, with one config:"
    return text + ("\n" + "; ".join(some) if some else "")
