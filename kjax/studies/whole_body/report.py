"""What whole_body.py prints, tabulates and draws."""

from pathlib import Path
from typing import Any

import numpy as np

from kjax.viz.tables import markdown_table

LABELS = {
    "nominal": "rigid body, feet planted",
    "affine": "+ affine residual",
    "clock_history": "+ phase clock, last force",
    "touchdown": "+ ticks around a touchdown",
}


def compact(entry: dict[str, Any]) -> dict[str, Any]:
    """Ratios with their intervals, rms of the nominals: [velocity, pitch rate] for each model."""
    out: dict[str, Any] = {}
    for where in ("inside", "all_starts"):
        for name, horizons in entry[where].items():
            for horizon, groups in horizons.items():
                for group, errors in groups.items():
                    if not isinstance(errors, dict):
                        continue
                    place = out.setdefault(f"{where}, {horizon}, {group}", {})
                    both = [errors["velocity"], errors["omega"]]
                    if name.endswith("nominal"):
                        place[f"{name}, rms"] = [round(float(e["rms"]), 5) for e in both]
                    else:
                        place[name] = [
                            [round(float(v), 4) for v in (e["ratio"], *e["interval"])] for e in both
                        ]
    return out


def table(families: dict[str, Any]) -> str:
    """Rms errors of every model inside a stance, as Markdown."""
    horizons = list(next(iter(next(iter(families.values())).values())))
    heads = [
        f"{gait}, {name}: velocity [m/s], ratio; pitch rate [rad/s], ratio"
        for gait in families
        for name in horizons
    ]
    rows = []
    for label in next(iter(families.values())):
        cells = []
        for models in families.values():
            for name in horizons:
                entry = models[label][name]
                cells.append("; ".join(
                    f"{e['rms']:.3f}, {e['ratio']:.2f} ({e['interval'][0]:.2f} to "
                    f"{e['interval'][1]:.2f})" for e in (entry["velocity"], entry["omega"])
                ))  # fmt: skip
        rows.append([label, *cells])
    header = ["inside a stance of the whole robot, as an LMPC predicts", *heads]
    note = "Ratio: to the error of the planted rigid body, integrated, not linearised.\n"
    return f"{markdown_table(header, rows)}\n{note}"


def show(gait: str, where: str, table: dict[str, Any]) -> None:
    """Print the errors of one gait, inside a stance or over all start points."""
    print(f"\n{gait}, {where.replace('_', ' ')}: error over that of the same scheme's nominal "
          "[95 %], held-out episodes")  # fmt: skip
    print(f"  {'':24}{'':6}{'velocity':>22}{'pitch rate':>22}")
    for name, horizons in table.items():
        for horizon, entry in horizons.items():
            cells = []
            for key, unit in (("velocity", "m/s"), ("omega", "rad/s")):
                one = entry["all"][key]
                low, high = one["interval"]
                text = f"{one['rms']:.3f} {unit}"
                if not name.endswith("nominal"):
                    text = f"{one['ratio']:.3f} [{low:.3f} {high:.3f}]"
                cells.append(f"{text:>22}")
            print(f"  {name:24}{horizon:6}{''.join(cells)}", flush=True)


def save_figure(curves: dict[str, Any], dt: float, path: Path) -> None:
    """Root-mean-square error against the horizon, inside a stance and over all start points.

    Over all start points the predictions follow the schedule, but for the dashed one.
    """
    import matplotlib.pyplot as plt

    from kjax.viz import style

    colours = {"nominal": style.DARK, "affine": style.BLUE, "clock_history": style.GREEN,
               "touchdown": style.RED}  # fmt: skip
    columns = [(gait, where) for gait in curves for where in ("inside", "all_starts")]
    with plt.rc_context(style.STYLE | {"lines.linewidth": 1.3}):
        fig, axes = plt.subplots(
            2, len(columns), figsize=(2.3 * len(columns), 4.6), sharex=True, squeeze=False
        )
        for column, (gait, where) in zip(axes.T, columns, strict=True):
            scheme = "" if where == "inside" else "scheduled "
            for axis, key in zip(column, ("velocity", "omega"), strict=True):
                for name, colour in colours.items():
                    if name == "touchdown" and where == "inside":
                        continue
                    curve = curves[gait][where, scheme + name][key]
                    time_ms = 1e3 * dt * np.arange(1, len(curve) + 1)
                    axis.plot(time_ms, curve, "o-", ms=2.5, color=colour, label=LABELS[name])
                if where == "all_starts":
                    frozen = curves[gait][where, "frozen nominal"][key]
                    axis.plot(time_ms, frozen, "--", color=style.GREY,
                              label="rigid body, present feet kept")  # fmt: skip
                # Feet kept through a bound's flight would press all others flat.
                highest = curves[gait][where, scheme + "nominal"][key][-1]
                axis.set_ylim(0.0, 1.1 * highest if where == "inside" else 1.5 * highest)
            place = "inside a stance" if where == "inside" else "all start points"
            column[0].set_title(f"{gait}, {place}", loc="left", fontsize=8)
            column[1].set_xlabel("horizon [ms]")
        axes[0, 0].set_ylabel("velocity error, rms [m/s]")
        axes[1, 0].set_ylabel("pitch rate error, rms [rad/s]")
        handles, labels = axes[0, 1].get_legend_handles_labels()
        fig.legend(handles, labels, loc="lower center", ncol=3)
        fig.tight_layout(rect=(0.0, 0.1, 1.0, 1.0))
        fig.savefig(path, dpi=160)
        plt.close(fig)
