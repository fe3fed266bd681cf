"""Table and figure of the study."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax.studies.spatial.cases import Part, Row
from kjax.studies.spatial.grounds import ANGLES, GROUNDS, HEIGHTS
from kjax.studies.spatial.limits import DIRECTIONS, IMPULSES, strongest
from kjax.viz.style import BLUE, DARK, GREEN, ORANGE, RED, STYLE


def table(record: Row, parts: Mapping[str, Part]) -> str:
    """Markdown of all parts that were run."""
    blocks = [parts[name].table(found) for name, found in record["parts"].items()]
    if record["engine"] == "mjx":
        blocks.append("Walked on MJX.\n")
    if record["quick"]:
        blocks.append("A quick check of the machinery: this is no result.\n")
    return "\n".join(blocks)


def figure(record: Row, path: Path) -> None:
    """Grounds that are crossed, with intervals, and pushes that are stood; what was run of both."""
    grounds, pushes = (record["parts"].get(name, []) for name in ("grounds", "pushes"))
    titles = [title for title in (_ground_title(grounds), _push_title(pushes)) if title]
    with plt.rc_context(STYLE):
        count = 2 * bool(grounds) + bool(pushes) or 1
        fig = plt.figure(figsize=(3.0 + 3.2 * count, 3.6), layout="constrained")
        if grounds:
            left = fig.add_subplot(1, count, 1)
            _draw_grounds(left, grounds, "deg", "inclination [deg]", ANGLES)
            right = fig.add_subplot(1, count, 2, sharey=left)
            _draw_grounds(right, grounds, "m", "height [cm]", HEIGHTS)
            left.set_ylabel("crossed [% of the seeds]")
        if pushes:
            _draw_pushes(fig.add_subplot(1, count, count, projection="polar"), pushes)
        fig.suptitle("\n".join(titles))
        fig.savefig(path)
        plt.close(fig)


def _draw_grounds(
    ax: Any, rows: list[Row], unit: str, label: str, ticks: tuple[float, ...]
) -> None:
    kin = [ground for ground in GROUNDS if ground.unit == unit]
    scale = 1.0 if unit == "deg" else 100.0
    colours = (BLUE, RED, GREEN) if unit == "deg" else (ORANGE, DARK)
    for place, (ground, colour) in enumerate(zip(kin, colours, strict=True)):
        own = [row for row in rows if row["ground"] == ground.name]
        value = scale * np.array([row["value"] for row in own])
        # Beside each other, where they would hide one another.
        gap = 0.12 * (value[1] - value[0]) if len(value) > 1 else 0.0
        value += gap * (place - 0.5 * (len(kin) - 1))
        shares = [row["crossed"] for row in own]
        middle = 100 * np.array([one["count"] / one["episodes"] for one in shares])
        interval = 100 * np.array([one["interval"] for one in shares]).T
        ax.errorbar(value, middle, np.abs(interval - middle), color=colour, marker="o", capsize=3,
                    label=ground.title)  # fmt: skip
    ax.set(xlabel=label, ylim=(-5, 105), xticks=scale * np.array(ticks))
    ax.legend(loc="lower left")


def _draw_pushes(ax: Any, rows: list[Row]) -> None:
    angles = np.radians([*DIRECTIONS, DIRECTIONS[0]])
    for gait, colour in zip(IMPULSES, (BLUE, ORANGE), strict=True):
        if not any(row["gait"] == gait for row in rows):
            continue
        _, each = strongest(rows, gait)
        if len(each) != len(DIRECTIONS):
            continue  # a quick check has one direction
        ax.plot(angles, [*each, each[0]], color=colour, marker="o", label=gait)
    ax.set_theta_zero_location("N")
    ax.set_thetagrids(DIRECTIONS, ["ahead", "", "left", "", "behind", "", "right", ""])
    ax.set_rlim(0.0)
    ax.set_rlabel_position(112.0)  # between two of the directions
    ax.set_title("push at the weakest phase [N s]", pad=16)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="lower left", bbox_to_anchor=(-0.2, -0.15))


def _ground_title(rows: list[Row]) -> str:
    """The finding: how far every seed came."""
    words = []
    for unit, kinds in (("deg", "slopes"), ("m", "steps and tiles")):
        own = [row for row in rows if row["unit"] == unit]
        whole = [
            value for value in sorted({row["value"] for row in own})
            if all(
                row["crossed"]["count"] == row["crossed"]["episodes"]
                for row in own if row["value"] <= value
            )
        ]  # fmt: skip
        if whole:
            most = f"{whole[-1]:g} deg" if unit == "deg" else f"{100 * whole[-1]:g} cm"
            words.append(f"{kinds} of up to {most}")
    return f"Every seed crosses {' and '.join(words)}" if words else ""


def _push_title(rows: list[Row]) -> str:
    """The finding: what is stood from everywhere, at every phase."""
    words = [
        f"{strongest(rows, gait)[0]:g} N s in {gait}"
        for gait in IMPULSES
        if any(row["gait"] == gait for row in rows)
    ]
    return f"It stands pushes from all sides of {' and '.join(words)}" if words else ""
