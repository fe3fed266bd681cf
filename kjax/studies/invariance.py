"""Does the closed loop depend on where zero is? Start, floor and heading varied, all else equal.

Three checks, each for every prediction model in trot (6 steps of 1 ms and 10 of 20 ms) and in the
bound within a stance:

- place: starts of 0 to 10 km times floors of -2 to 3 m, float64, the same noise in every cell. In
  trot the RMSE of the velocity is that at (0, 0) to three digits; in the bound every cell's median
  over the seeds lies within the interval of the median at (0, 0).
- float32: the same up to 1 km with a controller in float32, within 5 %.
- heading: the free base at 0, 1 and 2 rad without noise, with elliptic friction cones (a pyramid's
  axes are the world's), within 1 %.

Leaves results.json, table.md and figure.png in the output folder. A finished batch is kept there:
the same command goes on after Ctrl-C, and several with other --models, --gaits or --checks may work
in one folder. Everything takes about 20 minutes on two quiet cores.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax import cli
from kjax.config import ConfigError, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import Count, File, Options, fail, parse, require, require_names
from kjax.runs.batches import batch_key, run_batch
from kjax.runs.cache import Cache, open_cache
from kjax.sim.intervals import median_interval
from kjax.studies.prediction_models import MODELS, residual
from kjax.viz.tables import markdown_table

STARTS = (0.0, 10.0, 1e3, 1e4)  # m
FLOORS = (0.0, -2.0, -0.27, 3.0)  # m
HEADINGS = (0.0, 1.0, 2.0)  # rad
FLOAT32_REACH = 1e3  # m
STEPS = {"command.times": [0.0, 1.0, 2.5], "command.v_x": [0.0, 0.1, 0.3]}
# Gait -> file and duration [s].
GAITS = {
    "trot": ("trot_velocity.toml", 5.0),
    "trot_long": ("trot_velocity_long.toml", 5.0),
    "bound": ("bound_velocity.toml", 4.0),
}
TITLES = {"trot": "trot, 6 x 1 ms", "trot_long": "trot, 10 x 20 ms", "bound": "bound, in stance"}
# koopman.model -> its row in the tables of the other studies.
ROWS = {
    "linear": "linear (the paper)",
    "srb_hover": "SRB at hover",
    "srb": "SRB re-linearised",
    "planted": "planted SRB",
    "exact": "exact bilinear",
    "bilinear": "bilinear EDMD",
}
# Largest relative difference of the RMSE that a check allows; in the bound at (0, 0), float64, it
# is the interval of the median instead.
LIMITS = {"place": 1e-3, "float32": 0.05, "heading": 0.01}
NUMBER = "velocity_rmse_mps"


@dataclass(frozen=True, kw_only=True)
class Part:
    """One check of one model in one gait: a batch.

    Attributes:
      check: key of ``LIMITS``.
      model: koopman.model.
      gait: key of ``GAITS``.
      cells: (start [m], floor [m], heading [rad]) of each cell; the first is what the others are
        compared with.
      configs: of each cell, one for each seed.
    """

    check: str
    model: str
    gait: str
    cells: tuple[tuple[float, float, float], ...]
    configs: tuple[tuple[RunConfig, ...], ...]

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.check}_{self.model}_{self.gait}"

    @property
    def dtype(self) -> type:
        """Floating type of the controller."""
        return np.float32 if self.check == "float32" else np.float64


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run what is missing, write table and figure; 0 if all was run."""
    args = _parse(argv)
    folder = cli.output_folder(args, "invariance")
    cli.configure_jax()
    cache = open_cache(folder)
    parts = list(_parts(args))
    try:
        for number, part in enumerate(parts, start=1):
            configs = [config for row in part.configs for config in row]
            run_batch(
                cache, configs, torques="every_step", chunk=len(configs), threads=args.threads,
                dtype=part.dtype, label=part.name,
            )  # fmt: skip
            one = judged(part, cache)
            print(f"[{number}/{len(parts)}] {_sentence(one)}", flush=True)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    everything = dataclasses.replace(
        args, models=_known(args), gaits=tuple(GAITS), checks=tuple(LIMITS)
    )
    found = []
    for part in _parts(everything):
        cells = [config for row in part.configs for config in row]
        if all(batch_key(cache, one, "every_step", part.dtype) in cache for one in cells):
            found.append(judged(part, cache))
    record = {"quick": args.quick, "limits": LIMITS, "parts": found}
    text = table(found, quick=args.quick)
    cli.save_study(folder, record, text, lambda path: figure(found, path), file="results.json")
    return 0


@dataclass(kw_only=True)
class InvarianceOptions(Options):
    """Options of the study."""

    models: tuple[str, ...] = tuple(ROWS)
    """Prediction models."""

    gaits: tuple[str, ...] = tuple(GAITS)
    """Which of them."""

    checks: tuple[str, ...] = tuple(LIMITS)
    """What is varied."""

    residual: File = None
    """File of a residual of whole_body.py: run it in trot as well."""

    learned: File = None
    """File of a model of learn_control.py: run it as well."""

    seeds: int = 16
    """Of the bound in float64."""

    threads: Count = None
    """One per core if left out."""

    quick: bool = False
    """2 cells, 2 seeds, 0.8 s: to check the script."""


def _parse(argv: Sequence[str] | None) -> InvarianceOptions:
    args = parse(InvarianceOptions, argv, __doc__.split("\n\n")[0])
    for name, known in (("models", ROWS), ("gaits", GAITS), ("checks", LIMITS)):
        require_names(args, name, known)
    require(args, "seeds", "threads", least=1)
    for name in ("residual", "learned"):
        file = getattr(args, name)
        if file is not None and not file.is_file():
            fail(f"--{name}: no file {file}")
        if file is not None:
            args.models += (name,)
    if args.quick:
        args.seeds = min(args.seeds, 2)
    return args


def _known(args: InvarianceOptions) -> tuple[str, ...]:
    """All models that this call could run."""
    return (*ROWS, *(name for name in ("residual", "learned") if getattr(args, name) is not None))


def _parts(args: InvarianceOptions) -> Iterator[Part]:
    """The batches of a call, check by check, so that the first ones are whole early on."""
    for check in args.checks:
        for model in args.models:
            for gait in args.gaits:
                if model == "residual" and gait == "bound":
                    continue  # its step of 5 ms is no bound's
                try:
                    yield part_of(check, model, gait, args)
                except ConfigError as error:
                    fail(f"{model}, {gait}: {error}")


def part_of(check: str, model: str, gait: str, args: InvarianceOptions) -> Part:
    """Cells and configs of a check."""
    seeds = 1 if gait != "bound" or check == "heading" else args.seeds
    if check == "float32" and not args.quick:
        seeds = max(1, seeds // 4)
    base = _base(check, model, gait, args)
    if check == "heading":
        cells = [(0.0, 0.0, heading) for heading in HEADINGS]
    else:
        starts = STARTS if check == "place" else [s for s in STARTS if s <= FLOAT32_REACH]
        cells = [(start, floor, 0.0) for start in starts for floor in FLOORS]
    if args.quick:
        cells = [cells[0], cells[-1]]
    return Part(
        check=check,
        model=model,
        gait=gait,
        cells=tuple(cells),
        configs=tuple(
            tuple(_placed(dataclasses.replace(base, seed=s), *cell) for s in range(seeds))
            for cell in cells
        ),
    )


def _base(check: str, model: str, gait: str, args: InvarianceOptions) -> RunConfig:
    file, duration = GAITS[gait]
    keys: dict[str, Any] = {"duration": duration, **STEPS}
    if model in ROWS:
        keys |= MODELS[ROWS[model]]
    else:
        keys |= residual(str(getattr(args, model).resolve()))
        keys["koopman.model"] = model
        if model == "learned":
            del keys["koopman.dataset.dt"]
    if model == "residual" and gait == "trot":
        keys["lmpc.model_dt"] = 0.005  # of its file
    if check == "heading":
        keys |= {"sim.base": "free", "sim.cone": "elliptic", "noise.enabled": False}
    if args.quick:
        keys |= {"duration": 0.8, "command.times": [0.0, 0.5], "command.v_x": [0.0, 0.1]}
    return load_config(RunConfig, shipped_config(file), keys)


def _placed(config: RunConfig, start: float, floor: float, heading: float) -> RunConfig:
    sim = dataclasses.replace(config.sim, start=(start, 0.0), floor=floor, heading=heading)
    return dataclasses.replace(config, sim=sim)


def judged(part: Part, cache: Cache) -> dict[str, Any]:
    """What a finished part shows: RMSE of each cell, largest difference, whether it is met.

    ``largest`` is over the cells, of the medians over the seeds; ``largest_of_a_seed`` compares
    each seed with itself at the first cell, which chaos would show in.
    """
    done = [
        [cache[batch_key(cache, config, "every_step", part.dtype)] for config in row]
        for row in part.configs
    ]
    falls = [sum(one["fell"] for one in row) for row in done]
    rmse = np.array([[one.get(NUMBER, np.nan) for one in row] for row in done], float)
    medians = np.median(rmse, axis=1)
    off = np.abs(medians / medians[0] - 1.0)
    worst = int(np.argmax(np.where(np.isfinite(off), off, np.inf)))
    interval = median_interval(rmse[0]) if part.check == "place" and part.gait == "bound" else None
    if interval is None:
        within = bool((off <= LIMITS[part.check]).all())
    else:
        within = bool(((medians >= interval[0]) & (medians <= interval[1])).all())
    return {
        "check": part.check,
        "model": part.model,
        "gait": part.gait,
        "seeds": rmse.shape[1],
        "cells": [
            {"start_m": cell[0], "floor_m": cell[1], "heading_rad": cell[2], "rmse_mps": median,
             "falls": fell}
            for cell, median, fell in zip(part.cells, medians, falls, strict=True)
        ],
        "rmse_mps": medians[0],
        "interval_mps": interval,
        "largest": off[worst],
        "largest_at": part.cells[worst],
        "largest_of_a_seed": np.max(np.abs(rmse / rmse[0] - 1.0)),
        "falls": sum(falls),
        "equal_falls": len(set(falls)) == 1,
        "met": within and len(set(falls)) == 1,
    }  # fmt: skip


def _sentence(one: dict[str, Any]) -> str:
    return (
        f"{one['check']}, {one['model']}, {TITLES[one['gait']]}: {one['rmse_mps']:.4f} m/s, "
        f"differs by {one['largest']:.1e} at most, of one seed {one['largest_of_a_seed']:.1e}"
        + (f", {one['falls']} falls" if one["falls"] else "")
        + f": {'met' if one['met'] else 'NOT met'}"
    )


def table(found: Sequence[dict[str, Any]], *, quick: bool) -> str:
    """Markdown: one row per check, model and gait."""
    header = ("check", "model", "gait", "episodes", "falls", "RMSE at (0, 0) [m/s]",
              "largest relative difference", "at (start [m], floor [m], heading [rad])",
              "of one seed", "limit", "met")  # fmt: skip
    rows = []
    for one in found:
        limit = f"{LIMITS[one['check']]:g}"
        if one["interval_mps"] is not None:
            limit = "{:.4f} to {:.4f} m/s".format(*one["interval_mps"])
        place = ", ".join(f"{value:g}" for value in one["largest_at"])
        rows.append(
            (one["check"], one["model"], TITLES[one["gait"]],
             str(one["seeds"] * len(one["cells"])), str(one["falls"]), f"{one['rmse_mps']:.4f}",
             f"{one['largest']:.1e}", place, f"{one['largest_of_a_seed']:.1e}", limit,
             "yes" if one["met"] else "NO")
        )  # fmt: skip
    lines = [
        markdown_table(header, rows),
        "Medians over the seeds. The limit in the bound is the 95 % interval of the median at "
        "(0, 0). Falls must be the same in every cell as well.",
    ]
    if quick:
        lines.append("\nA quick check of the machinery: this is no result.")
    return "\n".join(lines) + "\n"


def figure(found: Sequence[dict[str, Any]], path: Path) -> None:
    """Largest relative difference of each part on a logarithmic axis, with the limits."""
    from kjax.viz.style import BLUE, DARK, GREY, RED, STYLE

    colours = dict(zip(GAITS, (BLUE, DARK, RED), strict=True))
    checks = [check for check in LIMITS if any(one["check"] == check for one in found)]
    if not checks:
        return
    models = [m for m in (*ROWS, "residual", "learned") if any(one["model"] == m for one in found)]
    titles = {
        "place": "start up to 10 km, floor -2 to 3 m\nfloat64",
        "float32": "start up to 1 km, floor -2 to 3 m\nfloat32",
        "heading": "heading 0, 1, 2 rad\nfree base, float64",
    }
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(
            1, len(checks), figsize=(2.6 * len(checks) + 1.0, 0.3 * len(models) + 1.6),
            sharey=True, squeeze=False,
        )  # fmt: skip
        for axis, check in zip(axes[0], checks, strict=True):
            for one in found:
                if one["check"] != check:
                    continue
                row = models.index(one["model"]) + 0.2 * (list(GAITS).index(one["gait"]) - 1)
                # A cross: not met.
                axis.plot(
                    max(one["largest"], 1e-16), row, "o" if one["met"] else "X",
                    color=colours[one["gait"]], ms=4,
                )  # fmt: skip
            axis.axvline(LIMITS[check], color=GREY, lw=1.0, ls="--")
            axis.set_xscale("log")
            axis.set_xlim(1e-16, 2.0)
            axis.set_title(titles[check], loc="left", fontsize=8)
            axis.set_xlabel("largest relative difference\nof the velocity RMSE")
        axes[0, 0].set_yticks(range(len(models)), models)
        axes[0, 0].set_ylim(len(models) - 0.5, -0.5)
        marks = [plt.Line2D([], [], marker="o", ls="", color=c, ms=4) for c in colours.values()]
        marks.append(plt.Line2D([], [], color=GREY, ls="--", lw=1.0))
        fig.legend(marks, [*(TITLES[g] for g in GAITS), "limit (bound, float64: its interval)"],
                   ncol=4, loc="lower center", fontsize=7)  # fmt: skip
        fig.tight_layout(rect=(0, 0.09, 1, 1))
        fig.savefig(path, dpi=150)
        plt.close(fig)
