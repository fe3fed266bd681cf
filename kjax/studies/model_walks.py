"""Is a better prediction better in closed loop? Every model, its weights tuned alike.

For each gait and model the same number of random weight sets is tried on tuning seeds, and the best
one reports on other seeds, beside the config's own weights. Leaves metrics.json, table.md and
figure.png in the output folder. Every finished model is kept: the same command goes on. One
of other code, or whose episodes would be others now, is run again.
"""

import dataclasses
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from kjax import cli
from kjax.config import Gaits, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import File, Options, fail, parse, require_names
from kjax.runs.cache import Cache, open_cache
from kjax.sim.intervals import bootstrap
from kjax.studies.prediction_models import MODELS, residual
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table

GAITS = {"trot": "trot_velocity_long.toml", "bound": "bound_velocity_short.toml"}
SPEEDS = {"trot": (0.0, 0.3, 0.6), "bound": (0.0, 0.5, 0.8)}  # m/s, one after the other
TUNE_SEEDS, REPORT_SEEDS = range(100, 104), range(16)
SETS = 32  # weight sets, the config's own among them
FALL = 10.0  # cost of a fall, in rmse of 1 m/s


@dataclass(kw_only=True)
class ModelWalkOptions(Options):
    """Options of the study."""

    gaits: tuple[str, ...] = tuple(GAITS)
    """Which of them."""

    residual: File = None
    """Folder with results of whole_body.py: run its residuals as well."""

    quick: bool = False
    """Two models, few sets and seeds: to check the script."""

    draw: bool = False
    """Draw finished models again."""


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run what is missing."""
    args = parse(ModelWalkOptions, argv, __doc__.splitlines()[0])
    require_names(args, "gaits", GAITS)
    folder = cli.output_folder(args, "model_walks")
    if args.draw:
        file = folder / "metrics.json"
        if not file.exists():
            fail(f"--draw: no metrics.json in {folder}")
        found = json.loads(file.read_text(encoding="utf-8"))["walks"]
        figure(found, folder / "figure.png")
        return 0
    cli.configure_jax()
    cache = open_cache(folder, Path(__file__))
    clock, found = time.perf_counter(), {}
    studies = {
        f"{gait}, {name}" + (", quick" if args.quick else ""): Study(gait, name, keys, args.quick)
        for gait in args.gaits
        for name, keys in models_of(gait, args).items()
    }
    for label, study in studies.items():
        key = identity(cache, study)
        if key not in cache:
            try:
                cache.add({key: tuned_and_reported(study)})
            except KeyboardInterrupt:
                print(f"interrupted; finished models are kept in {folder}/, run again to go on")
                return 130
        found[label] = {"gait": study.gait, "model": study.name, **cache[key]}
        tuned = found[label]["tuned"]
        print(f"{label}: rmse {tuned['rmse_median']:.4f} m/s, {tuned['falls']} of "
              f"{tuned['episodes']} fell, tuned on {found[label]['sets']} sets "
              f"({time.perf_counter() - clock:.0f} s)", flush=True)  # fmt: skip
    cli.save_study(folder, {"walks": found}, table(found), lambda path: figure(found, path))
    return 0


def models_of(gait: str, args: Any) -> dict[str, dict[str, Any]]:
    """Config keys of the models to run."""
    names = ("linear (the paper)", "SRB re-linearised") if args.quick else MODELS
    models = {name: MODELS[name] for name in names}
    if args.residual is not None and gait == "trot":  # its step of 5 ms is no bound's
        for end, name in (("", "affine"), ("_clock_history", "clock, last force")):
            file = args.residual / f"residual_{gait}{end}.npz"
            if not file.exists():
                fail(f"--residual: no {file.name} in {args.residual}")
            models[f"planted SRB + residual ({name})"] = residual(str(file.resolve()))
    return models


class Study(NamedTuple):
    """A gait with a model.

    Attributes:
      gait: key of ``GAITS``.
      name: of the model, in tables.
      keys: config keys of the model.
      quick: whether few sets and seeds will do.
    """

    gait: str
    name: str
    keys: dict[str, Any]
    quick: bool

    @property
    def sizes(self) -> tuple[int, list[int], list[int]]:
        """Number of weight sets, tuning seeds, reporting seeds."""
        sets, tune, report = SETS, list(TUNE_SEEDS), list(REPORT_SEEDS)
        return (3, tune[:1], report[:2]) if self.quick else (sets, tune, report)


def candidates(study: Study) -> list[RunConfig]:
    """Configs with each set of weights; the first one has the config's own."""
    base = config_of(study.gait, study.keys)
    return [scaled(base, row) for row in weight_scales(study.sizes[0])]


def identity(cache: Cache, study: Study) -> str:
    """Key of all that decides which episodes are run, the content of model files included."""
    _, tune, report = study.sizes
    return cache.key(*candidates(study), tune, report)


def tuned_and_reported(study: Study) -> dict[str, Any]:
    """Tune the weights of a model, then report them and the config's own on other seeds."""
    sets, tune, report = study.sizes
    scales, chosen = weight_scales(sets), candidates(study)
    rows = run([dataclasses.replace(c, seed=s) for c in chosen for s in tune])
    costs = np.array([cost(row) for row in rows]).reshape(sets, len(tune)).mean(axis=1)
    best = int(np.argmin(costs))
    final = run([dataclasses.replace(c, seed=s) for c in (chosen[best], chosen[0]) for s in report])
    return {
        "sets": sets,
        "best_set": best,
        "scales": dict(zip(NAMES, scales[best], strict=True)),
        "tuning_cost": costs,
        "tuned": statistics(final[: len(report)]),
        "own_weights": statistics(final[len(report) :]),
    }


NAMES = ("p_x", "p_z", "theta", "v_x", "v_z", "omega", "input")


def weight_scales(sets: int) -> np.ndarray:
    """Factors of the weights (sets, 7); the first set is the config's own. The same for all."""
    rng = np.random.default_rng(0)
    scales = np.exp(rng.uniform(-np.log(5.0), np.log(5.0), (sets, len(NAMES))))
    scales[0] = 1.0
    return scales


def scaled(config: RunConfig, row: np.ndarray) -> RunConfig:
    """The config with its gait's weights times these factors."""
    name = config.gait.names[0]
    own = config.gaits[name].Q is not None
    part: Any = config.gaits[name] if own else config.lmpc
    weights = tuple(float(w * f) for w, f in zip(part.Q, row[:6], strict=True))
    part = dataclasses.replace(part, Q=weights, R=float(part.R * row[6]))
    if own:
        return dataclasses.replace(config, gaits=Gaits({**config.gaits, name: part}))
    return dataclasses.replace(config, lmpc=part)


def config_of(gait: str, keys: dict[str, Any]) -> RunConfig:
    """Flat ground, three speeds one after the other, feet-only contacts."""
    speeds = SPEEDS[gait]
    own = {
        "duration": 2.0 + 2.0 * len(speeds),
        "sim.contacts": "feet",
        "lmpc.command_slew": 1.0,
        "command.times": [0.0, *(2.0 * i for i in range(1, len(speeds)))],
        "command.v_x": list(speeds),
    }
    return load_config(RunConfig, shipped_config(GAITS[gait]), {**own, **keys})


def run(configs: list[RunConfig]) -> list[dict[str, Any]]:
    """Metrics of the episodes."""
    from kjax.sim.engines.mujoco_batch import BatchEngine
    from kjax.sim.resolve import batch_spec, resolve_episodes

    recording = BatchEngine(batch_spec(configs[0]), torques="held").run(resolve_episodes(configs))
    if recording.interrupted:
        raise KeyboardInterrupt
    return list(recording.metrics())


def cost(row: dict[str, Any]) -> float:
    """Error of the velocity, and a hundredth of a metre per second for each degree of pitch."""
    if row["fell"]:
        return FALL
    return float(row["velocity_rmse_mps"] + 0.01 * row["pitch_p95_deg"])


def statistics(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Falls; medians of those that stayed up, with the interval of the median (95 %, bootstrap)."""
    up = [row for row in rows if not row["fell"]]
    out: dict[str, Any] = {"episodes": len(rows), "falls": len(rows) - len(up)}
    for name, key in (("rmse", "velocity_rmse_mps"), ("pitch", "pitch_p95_deg")):
        values = np.array([row[key] for row in up]) if up else np.array([np.nan])
        out[f"{name}_median"] = float(np.median(values))
        out[f"{name}_low"], out[f"{name}_high"] = bootstrap(partial(np.median, axis=1), values)
    return out


def table(found: dict[str, Any]) -> str:
    """Markdown."""
    rows = []
    for label, entry in found.items():
        tuned, own = entry["tuned"], entry["own_weights"]
        rows.append(
            (label, _interval(tuned, "rmse"), f"{tuned['falls']} of {tuned['episodes']}",
             _interval(tuned, "pitch"), _interval(own, "rmse"), str(own["falls"]))
        )  # fmt: skip
    header = ("gait, model", "rmse of v_x, tuned [m/s]", "fell", "pitch, 95 % [deg]", "not tuned",
              "fell")  # fmt: skip
    return markdown_table(header, rows)


def _interval(entry: dict[str, Any], name: str) -> str:
    parts = (entry[f"{name}_{part}"] for part in ("median", "low", "high"))
    value, low, high = np.array(list(parts), float)  # None, from a file, is NaN
    return "none stayed up" if np.isnan(value) else f"{value:.3g} ({low:.3g} to {high:.3g})"


@figure_style
def figure(found: dict[str, Any], path: Path) -> None:
    """Error of the speed and pitch of each model, tuned and with the config's own weights."""
    gaits = list(dict.fromkeys(entry["gait"] for entry in found.values()))
    panels = (("rmse", "rmse of v_x [m/s]"), ("pitch", "pitch, 95 % [deg]"))
    fig, axes = plt.subplots(
        len(gaits), 2, figsize=(9.5, 0.8 + 3.4 * len(gaits)), sharey="row", layout="constrained",
        squeeze=False,
    )  # fmt: skip
    for row, gait in zip(axes, gaits, strict=True):
        own = [entry for entry in found.values() if entry["gait"] == gait]
        for ax, (name, label) in zip(row, panels, strict=True):
            seen = []
            for shift, key, legend in (
                (-0.12, "own_weights", "config's weights"),
                (0.12, "tuned", "tuned"),
            ):
                value, low, high = (
                    np.array([e[key][f"{name}_{part}"] for e in own], float)
                    for part in ("median", "low", "high")
                )
                # Medians of a few that stayed up would press all others together.
                upright = np.array([2 * e[key]["falls"] < e[key]["episodes"] for e in own])
                value[~upright] = np.nan
                seen.append(value)
                at = np.arange(len(own)) + shift
                ax.errorbar(value, at, xerr=[value - low, high - value], fmt="o", ms=4,
                            label=legend)  # fmt: skip
            # One far beyond the others would press them together: its value stands at the edge.
            shown = np.where(np.array(seen) > 2 * np.nanmedian(seen), np.nan, seen)
            low, high = np.nanmin(shown), np.nanmax(shown)
            ax.set_xlim(low - 0.15 * (high - low), high + 0.15 * (high - low))
            for values, shift in zip(seen, (-0.12, 0.12), strict=True):
                for place in np.flatnonzero(values > 2 * np.nanmedian(seen)):
                    ax.annotate(f"{values[place]:.2g} →", (1.0, place + shift), ha="right",
                                va="center", xycoords=("axes fraction", "data"))  # fmt: skip
            ax.set(xlabel=label, title=gait)
            ax.grid(axis="x", alpha=0.3)
        row[0].set_yticks(range(len(own)), [entry["model"] + _falls(entry) for entry in own],
                          fontsize=8)  # fmt: skip
        row[0].invert_yaxis()
    handles, labels = axes[0][0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=8)
    fig.savefig(path)
    plt.close(fig)


def _falls(entry: dict[str, Any]) -> str:
    """Falls with the config's weights and tuned, where there are any."""
    own, tuned = entry["own_weights"], entry["tuned"]
    if not own["falls"] + tuned["falls"]:
        return ""
    return f"\n{own['falls']} of {own['episodes']}, {tuned['falls']} of {tuned['episodes']} fell"
