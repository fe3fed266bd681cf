"""Which models of the rigid body in three dimensions predict how far: attitude and its rate.

Place and velocity are exact in most of them; what they differ in is the attitude. Each is asked
what an LMPC asks: from the present state, under forces that it is given, node after node of 25 ms.

Held-out states tilt by up to 0.3 rad and turn by up to 3 rad/s, vertical forces are 0.3 to 1.7 of
their share, horizontal ones up to 0.4 of them, feet up to 8 cm from where they should stand. EDMD
learns from states of the same ranges, with any heading and place near the origin. All is drawn
anew for each of the seeds. Leaves results.json, table.md and figure.png.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax import cli
from kjax.options import Options, parse, require
from kjax.sim.intervals import median_interval
from kjax.studies.spatial_models.models import AT, LEGS, NODE, TITLES, predicted
from kjax.viz.tables import markdown_table

_BRIEF = {  # where the rows of the table lean on the one before
    "edmd_wrench": "linear EDMD, wrench of the measured feet",
    "momentum_plan": "momentum, about a plan with 20 % force error",
}


@dataclass(kw_only=True)
class SpatialModelsOptions(Options):
    """Options of the study."""

    seeds: int = 8
    """Draws of training and test data."""

    train: int = 8000
    """Steps that EDMD learns from."""

    test: int = 1000
    """Roll-outs that errors are taken over."""

    quick: bool = False
    """2 seeds of a tenth of the data: to check the script."""


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, draw, fit, predict, write table and figure."""
    args = parse(SpatialModelsOptions, argv, __doc__.split("\n\n")[0])
    require(args, "seeds", "train", "test", least=1)
    if args.quick:
        args.seeds, args.train, args.test = min(args.seeds, 2), 1000, 100
    folder = cli.output_folder(args, "spatial_models")
    cli.configure_jax()
    errors: dict[str, dict[str, list[Any]]] = {mode: {} for mode in LEGS}
    for seed in range(args.seeds):
        for mode in LEGS:
            for name, found in predicted(seed, mode, args.train, args.test).items():
                errors[mode].setdefault(name, []).append(found)
        print(f"[{seed + 1}/{args.seeds}]", flush=True)
    record = {"quick": args.quick, "node_s": NODE, "models": summary(errors)} | vars(args)
    record.pop("out")
    cli.save_study(
        folder, record, table(record), lambda path: figure(record, path), file="results.json"
    )
    return 0


def summary(errors: dict[str, dict[str, list[Any]]]) -> dict[str, Any]:
    """Medians over the seeds with their intervals, by mode and model."""
    out: dict[str, Any] = {}
    for mode, models in errors.items():
        out[mode] = {}
        for name, seeds in models.items():
            values = np.array(seeds)  # (seeds, AT, 2)
            out[mode][name] = {
                quantity: [
                    {
                        "time_s": k * NODE,
                        "median": float(np.median(values[:, i, column])),
                        "interval": median_interval(values[:, i, column].tolist()),
                    }
                    for i, k in enumerate(AT)
                ]
                for column, quantity in enumerate(("attitude_deg", "rate_radps"))
            }
    return out


def table(record: dict[str, Any]) -> str:
    """Markdown: attitude [deg] / rate [rad/s]."""
    columns = [("trot", i) for i in range(len(AT))] + [("stand", len(AT) - 1)]
    header = (
        "error of attitude [deg] / rate [rad/s]",
        *(f"{mode} {1e3 * NODE * AT[i]:.0f} ms" for mode, i in columns),
    )

    def cell(name: str, mode: str, i: int) -> str:
        found = record["models"][mode][name]
        return " / ".join(f"{found[q][i]['median']:.2g}" for q in ("attitude_deg", "rate_radps"))

    rows = [
        (title, *(cell(name, mode, i) for mode, i in columns)) for name, title in TITLES.items()
    ]
    text = markdown_table(header, rows)
    if record["quick"]:
        text += "\nA quick check of the machinery: this is no result.\n"
    return text


def figure(record: dict[str, Any], path: Path) -> None:
    """Error of the attitude against the time that is predicted, trot."""
    from kjax.viz.style import BLUE, DARK, GREEN, ORANGE, RED, STYLE

    lines = {
        "convex": (RED, "o-"), "present": (ORANGE, "o-"), "edmd_wrench": (DARK, "s--"),
        "bilinear": (GREEN, "s--"), "momentum": (BLUE, "o-"), "momentum_plan": (BLUE, "o:"),
    }  # fmt: skip
    found = record["models"]["trot"]
    last = {name: found[name]["attitude_deg"][-1]["median"] for name in lines}
    with plt.rc_context(STYLE):
        fig, ax = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
        for name, (colour, style) in lines.items():
            points = found[name]["attitude_deg"]
            time = [1e3 * one["time_s"] for one in points]
            ax.semilogy(time, [one["median"] for one in points], style, color=colour,
                        label=_BRIEF.get(name, TITLES[name]))  # fmt: skip
        ax.set(xlabel="time that is predicted [ms]", ylabel="error of the attitude [deg]")
        ax.legend(fontsize="small")
        ratio = last["convex"] / last["momentum_plan"]
        ax.set_title(
            f"After {1e3 * NODE * AT[-1]:.0f} ms the momentum about the last plan is {ratio:.0f} "
            "times nearer\nthan the convex model"
        )
        fig.savefig(path)
        plt.close(fig)
