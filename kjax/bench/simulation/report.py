"""What benchmark.py simulation tabulates and draws."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table


def table(result: dict[str, Any]) -> str:
    """All of it as Markdown."""
    entries = [(f"C, {name}", entry) for name, entry in result["c"].items()]
    entries += [(f"MJX, trot, every_step, {name}", entry) for name, entry in result["mjx"].items()]
    rows = [
        (name, f"{entry['robot_steps_per_s']:,.0f}", f"{entry['bare_robot_steps_per_s']:,.0f}",
         f"{entry['over_bare']:.2f}", f"{entry['resident_MB']:,.0f}")
        for name, entry in entries
    ]  # fmt: skip
    alone = result["python_loop"]["robot_steps_per_s"]
    rows.append(("C, trot, every step, one robot in a Python loop", f"{alone:,.0f}", "", "", ""))
    header = ("engine, gait, torques, robots", "robot-steps/s", "bare engine", "part of it",
              "memory, MB")  # fmt: skip
    return markdown_table(header, rows)


@figure_style
def figure(result: dict[str, Any], path: Path) -> None:
    """Robot-steps per second against the number of robots."""
    fig, ax = plt.subplots(figsize=(6, 4), layout="constrained")
    for torques, color in (("held", "C0"), ("every_step", "C1")):
        points = {
            int(key.split(", ")[-1]): entry
            for key, entry in result["c"].items()
            if key.startswith(f"trot, {torques}")
        }
        for kind, style in (("robot_steps_per_s", "o-"), ("bare_robot_steps_per_s", ":")):
            label = f"C, torques {torques.replace('_', ' ')}" + (", bare" if style == ":" else "")
            ax.loglog(list(points), [e[kind] for e in points.values()], style, color=color,
                      label=label)  # fmt: skip
    points = {int(key): entry for key, entry in result["mjx"].items()}
    for kind, style in (("robot_steps_per_s", "o-"), ("bare_robot_steps_per_s", ":")):
        label = "MJX, every step" + (", bare" if style == ":" else "")
        ax.loglog(list(points), [e[kind] for e in points.values()], style, color="C2", label=label)
    alone = result["python_loop"]["robot_steps_per_s"]
    ax.axhline(alone, color="0.5", lw=1, label="one robot in a Python loop")
    ax.set(xlabel="robots", ylabel="robot-steps per second",
           title=f"Flat trot, {result['threads']} threads")  # fmt: skip
    ax.legend(fontsize=7, loc="center right")
    fig.savefig(path)
    plt.close(fig)
