"""Learn what a rigid body in three dimensions misses of the whole robot, from its own walks.

Records trots at random commands with perturbed forces in C MuJoCo, fits a residual wrench for each
set of standing legs, and predicts held-out episodes under their recorded forces and feet, with and
without it. Half of the episodes are fitted on, a fifth chooses how many ticks a row of the fit is
the mean of, the rest reports. Then both models walk steady commands with the same weights.

Leaves results.json, table.md, figure.png and residual.npz (``spatial.model = "residual"``,
``spatial.file``) in the output folder; recordings and walks stay there and are used again.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kjax import cli
from kjax.dynamics.srb_spatial import SpatialBody
from kjax.options import Count, Options, parse, require
from kjax.prediction import residual_wrench
from kjax.prediction.residual_wrench import ResidualWrench
from kjax.runs.batches import run_batch
from kjax.runs.cache import open_cache
from kjax.sim.intervals import median_interval
from kjax.studies.spatial import commands, measures
from kjax.studies.spatial.cases import Row, SpatialOptions
from kjax.studies.spatial_residual import prediction
from kjax.studies.spatial_residual.prediction import NODE, QUANTITIES
from kjax.studies.spatial_residual.recordings import body_of, record, recorded_configs
from kjax.studies.spatial_residual.report import figure, table
from kjax.sysid import spatial_residual
from kjax.sysid.spatial_residual import SpatialEpisode
from kjax.sysid.transitions import split

HELD_OUT, TUNE = 0.3, 0.2 / 0.7  # of all episodes, of those left
TICKS = (1, 2, 5, 10)  # that a row of the fit is the mean of, to choose from
LEAST = 200  # rows of a set of legs
AT = (1, 2, 4, 8)  # nodes after which errors are told
EVERY = 13  # ticks from one start of a prediction to the next: all places of a stance
COMMANDS = commands.COMMANDS[1:]


@dataclass(kw_only=True)
class SpatialResidualOptions(Options):
    """Options of the study."""

    robots: int = 40
    """Recorded episodes."""

    duration: float = 12.0
    """Of each [s]."""

    seeds: int = 8
    """Walks of every command and model."""

    threads: Count = None
    """One per core if left out."""

    quick: bool = False
    """8 short episodes, 2 seeds, one command: to check the script."""


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, record, fit, predict, walk; 0 if all was run."""
    args = parse(SpatialResidualOptions, argv, __doc__.split("\n\n")[0])
    require(args, "robots", least=8)
    require(args, "seeds", "threads", least=1)
    require(args, "duration", least=3.0)
    if args.quick:
        args.robots, args.duration, args.seeds = 8, 3.0, 2
    folder = cli.output_folder(args, "spatial_residual")
    cli.configure_jax()
    try:
        found, model = _learn(args, folder)
        path = residual_wrench.save(folder / "residual.npz", model)
        found["walks"] = _walk(args, folder, path)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    cli.save_study(
        folder, found, table(found), lambda path: figure(found, path), file="results.json"
    )
    return 0


def _learn(args: SpatialResidualOptions, folder: Path) -> tuple[Row, ResidualWrench]:
    """Fit on some episodes, choose on others, report on the rest."""
    episodes = record(args.robots, args.duration, folder, args.threads)
    config = recorded_configs(1, args.duration)[0]
    body, dt = body_of(config), config.lmpc.control_dt
    rest, held = split(np.arange(len(episodes.phase)), share=HELD_OUT)
    fitted, tuned = split(rest, share=TUNE, seed=1)
    fits = {
        ticks: spatial_residual.fit(_some(episodes, fitted), body, dt=dt, ticks=ticks, least=LEAST)
        for ticks in TICKS
    }
    tuning = {
        ticks: float(_errors(_some(episodes, tuned), body, dt, model)[:, -1, 0].mean())
        for ticks, (model, _) in fits.items()
    }
    best = min(TICKS, key=lambda ticks: tuning[ticks] if np.isfinite(tuning[ticks]) else np.inf)
    model, how = fits[best]
    reported = _some(episodes, held)
    return {
        "quick": args.quick,
        "episodes": {
            "recorded": len(episodes.phase), "fitted": len(fitted), "held_out": len(held),
            "duration_s": args.duration,
        },
        "ticks": best,
        "tuning_attitude_deg": tuning,
        "rows": how.rows.tolist(), "rank": how.rank.tolist(), "columns": how.columns.tolist(),
        "missing_rms": _of_sets(how.before), "missing_rms_after": _of_sets(how.after),
        "prediction": {
            "body": _summary(_errors(reported, body, dt, None), dt),
            "residual": _summary(_errors(reported, body, dt, model), dt),
        },
    }, model  # fmt: skip


def _some(episodes: SpatialEpisode, which: Any) -> SpatialEpisode:
    return jax.tree.map(lambda a: a[np.asarray(which)], episodes)


def _errors(
    episodes: SpatialEpisode, body: SpatialBody, dt: float, model: ResidualWrench | None
) -> np.ndarray:
    """Of each episode (E, nodes, 4)."""
    own = None if model is None else ResidualWrench(jnp.asarray(model.W))
    found = prediction.errors(episodes, body, own, dt, ticks=AT[-1] * NODE, every=EVERY)
    return prediction.of_episodes(found)


def _summary(errors: np.ndarray, dt: float) -> list[Row]:
    """Medians over the episodes with their intervals, after each of ``AT``."""
    rows = []
    for nodes in AT:
        row: Row = {"time_s": nodes * NODE * dt}
        for column, (name, unit) in enumerate(zip(QUANTITIES, prediction.UNITS, strict=True)):
            values = errors[:, nodes - 1, column]
            row[name] = {
                "median": float(np.median(values)), "unit": unit,
                "interval": median_interval(values.tolist()),
            }  # fmt: skip
        rows.append(row)
    return rows


def _of_sets(rms: np.ndarray) -> dict[str, list[float]]:
    """Of the sets of legs that were fitted."""
    return {str(i): row.tolist() for i, row in enumerate(rms) if np.isfinite(row).all()}


def _walk(args: SpatialResidualOptions, folder: Path, path: Path) -> dict[str, list[Row]]:
    """Both models at steady commands, with the shipped weights."""
    options = SpatialOptions(seeds=args.seeds, quick=args.quick)
    asked = COMMANDS[:1] if args.quick else COMMANDS
    models: dict[str, dict[str, Any]] = {
        "body": {},
        "residual": {"model": "residual", "file": str(path.resolve())},
    }
    cache = open_cache(folder, Path(__file__), Path(str(measures.__file__)))
    out: dict[str, list[Row]] = {}
    for name, keys in models.items():
        configs = [
            dataclasses.replace(one, spatial=dataclasses.replace(one.spatial, **keys))
            for command in asked
            for one in commands.command_configs(command, options)
        ]
        rows = run_batch(
            cache, configs, torques="held", chunk=len(configs), threads=args.threads,
            measure=measures.walked, dtype=np.float32, label=name,
        )  # fmt: skip
        out[name] = [
            commands.of_command(command, rows[i * args.seeds : (i + 1) * args.seeds])
            for i, command in enumerate(asked)
        ]
    return out
