"""The controller in three dimensions: commands, random walks, and grounds that it does not see.

Commands: constant ones, all seeds, errors from 2 s on. Random: v_x, v_y and yaw rate are drawn anew
every 2 to 5 s, as raw steps. Grounds: slopes up, down and across, steps, and tiles of random
heights, each over its inclination or height.

Leaves results.json, table.md and figure.png in the output folder. Every finished batch is kept
there: the same command goes on after Ctrl-C. A second of a robot takes about 0.1 s of two cores:
commands and grounds a quarter of an hour, the random walks half an hour per thousand.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from kjax import cli
from kjax.config import CommandConfig, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import Count, Options, parse, require, require_names
from kjax.runs.batches import batch_key, run_batch
from kjax.runs.cache import Cache, open_cache
from kjax.sim import free_base
from kjax.sim.intervals import median_interval, wilson
from kjax.sim.trajectory import Trajectory
from kjax.viz.tables import markdown_table

PARTS = ("commands", "grounds", "random")
# v_x, v_y [m/s] and yaw rate [rad/s] that are held.
COMMANDS = (
    (0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 1.5), (0.8, 0.3, 1.5),
)  # fmt: skip
RANGE = (1.0, 0.4, 1.5)  # of the random ones
FROM = 2.0  # s, from which errors count: half a second of standing, and time to get there
_HIGH = {"leg.swing_height": 0.33, "leg.hold_after": 0.6}  # for what feet must clear


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A kind of ground over one number.

    Attributes:
      name: of it.
      title: of its row.
      unit: of the number.
      values: that are tried.
      keys: of the config besides.
      vary: key of the config that the number is for, and a factor.
    """

    name: str
    title: str
    unit: str
    values: tuple[float, ...]
    keys: dict[str, Any]
    vary: dict[str, float]


_ANGLES = (10.0, 15.0, 20.0, 25.0, 30.0)
_HEIGHTS = (0.04, 0.06, 0.08, 0.1, 0.12)
_STEPS = {"terrain.height_min": 1.0, "terrain.height_max": 1.0}
GROUNDS = (
    Ground(name="up", title="slope up, then down", unit="deg", values=_ANGLES,
           keys={"terrain.kind": "slope"}, vary={"terrain.slope": 1.0}),
    Ground(name="down", title="slope down, then up", unit="deg", values=_ANGLES,
           keys={"terrain.kind": "slope"}, vary={"terrain.slope": -1.0}),
    Ground(name="across", title="slope across the way", unit="deg", values=_ANGLES,
           keys={"terrain.kind": "cross_slope"}, vary={"terrain.slope": 1.0}),
    Ground(name="steps", title="four steps up, four down", unit="m", values=_HEIGHTS,
           keys={"terrain.kind": "steps", "command.v_x": [0.0, 0.3], **_HIGH}, vary=_STEPS),
    Ground(name="tiles", title="tiles of up to this height", unit="m", values=_HEIGHTS,
           keys={"terrain.kind": "tiles", "terrain.count": 18, "terrain.height_min": 0.005,
                 **_HIGH}, vary={"terrain.height_max": 1.0}),
)  # fmt: skip


@dataclass(kw_only=True)
class SpatialOptions(Options):
    """Options of the study."""

    parts: tuple[str, ...] = PARTS
    """Which of them."""

    seeds: int = 16
    """Episodes per command and ground."""

    robots: int = 1024
    """Episodes of random commands."""

    threads: Count = None
    """One per core if left out."""

    quick: bool = False
    """2 seeds, one value each, short: to check the script."""


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run what is missing, write table and figure; 0 if all was run."""
    args = parse(SpatialOptions, argv, __doc__.split("\n\n")[0])
    require_names(args, "parts", PARTS)
    require(args, "seeds", "robots", "threads", least=1)
    if args.quick:
        args.seeds, args.robots = min(args.seeds, 2), min(args.robots, 2)
    folder = cli.output_folder(args, "spatial")
    cli.configure_jax()
    cache = open_cache(folder, Path(__file__))
    walk = partial(
        run_batch, cache, torques="every_step", chunk=64, threads=args.threads,
        measure=walked, dtype=np.float32,
    )  # fmt: skip
    try:
        for label, configs in _batches(args):
            walk(configs, label=label)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    record = {"quick": args.quick, "seeds": args.seeds} | measured(args, cache)
    cli.save_study(
        folder, record, table(record), lambda path: figure(record, path), file="results.json"
    )
    return 0


def _batches(args: SpatialOptions) -> Iterator[tuple[str, list[RunConfig]]]:
    """What walks together: labels, and configs of one scene."""
    if "commands" in args.parts:
        yield "commands", [c for one in COMMANDS for c in command_configs(one, args)]
    if "grounds" in args.parts:
        for ground in GROUNDS:
            values = _values(ground, args)
            yield ground.title, [c for v in values for c in ground_configs(ground, v, args)]
    if "random" in args.parts:
        yield "random commands", random_configs(args)


def _values(ground: Ground, args: SpatialOptions) -> tuple[float, ...]:
    return ground.values[:1] if args.quick else ground.values


def command_configs(command: tuple[float, float, float], args: SpatialOptions) -> list[RunConfig]:
    """Episodes of one command, held from 0.5 s on."""
    v_x, v_y, yaw_rate = command
    asked = CommandConfig(
        times=(0.0, 0.5), v_x=(0.0, v_x), v_y=(0.0, v_y), yaw_rate=(0.0, yaw_rate)
    )
    base = dataclasses.replace(_base({}), command=asked, duration=3.0 if args.quick else 8.0)
    return [dataclasses.replace(base, seed=seed) for seed in range(args.seeds)]


def ground_configs(ground: Ground, value: float, args: SpatialOptions) -> list[RunConfig]:
    """Episodes of one kind of ground and value; every seed has its own field."""
    keys = {
        "terrain.start": 0.6, "terrain.end": 3.0, "terrain.width": 2.0, "terrain.count": 8,
        "duration": 3.0 if args.quick else 13.0, "command.times": [0.0, 0.5],
        "command.v_x": [0.0, 0.4], "command.v_y": [], "command.yaw_rate": [],
    }  # fmt: skip
    varied = {key: factor * value for key, factor in ground.vary.items()}
    base = _base(keys | ground.keys | varied)
    return [
        dataclasses.replace(base, seed=seed, terrain=dataclasses.replace(base.terrain, seed=seed))
        for seed in range(args.seeds)
    ]


def random_configs(args: SpatialOptions) -> list[RunConfig]:
    """Episodes of random commands; the seed of each draws its own."""
    base, duration = _base({}), 4.0 if args.quick else 20.0
    out = []
    for seed in range(args.robots):
        rng = np.random.default_rng([seed, 19])
        times = np.cumsum(np.append(0.5, rng.uniform(2.0, 5.0, 10))).round(3)
        times = times[times < duration]
        values = np.array(RANGE) * rng.uniform(-1.0, 1.0, (len(times), 3))
        columns = [(0.0, *column) for column in values.T.tolist()]
        asked = CommandConfig(
            times=(0.0, *times.tolist()), v_x=columns[0], v_y=columns[1], yaw_rate=columns[2]
        )
        out.append(dataclasses.replace(base, seed=seed, command=asked, duration=duration))
    return out


def _base(keys: dict[str, Any]) -> RunConfig:
    return load_config(RunConfig, shipped_config("omni_trot"), {"gait.also": [], **keys})


def walked(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Errors against the command in force, raw and averaged over a cycle, and the attitude."""
    late = run.time >= FROM
    roll, pitch, yaw = free_base.attitude(run.qpos)
    if run.fell or not late.any():
        return {"errors": None}
    c, s = np.cos(yaw), np.sin(yaw)
    rate = np.gradient(np.unwrap(yaw), run.dt)
    moving = np.stack([run.x[:, 3], c * run.qvel[:, 1] - s * run.qvel[:, 0], rate], axis=-1)
    columns = (config.command.v_x, config.command.v_y, config.command.yaw_rate)
    last = np.array([column[-1] if column else 0.0 for column in columns])
    cycle = round(config.gaits[config.gait.names[0]].period / run.dt)
    mean = np.stack(
        [np.convolve(one, np.ones(cycle) / cycle, mode="valid") for one in moving[late].T], axis=-1
    )

    def rmse(values: np.ndarray) -> list[float]:
        return np.sqrt(np.mean((values - last) ** 2, axis=0)).tolist()

    tilt = np.degrees(np.abs(np.stack([roll, pitch])[:, late]))
    return {
        "errors": rmse(moving[late]),
        "errors_of_cycles": rmse(mean),
        "tilt_p95_deg": np.percentile(tilt, 95, axis=1).tolist(),
    }


def measured(args: SpatialOptions, cache: Cache) -> dict[str, Any]:
    """Statistics of all parts that were asked for."""

    def done(configs: list[RunConfig]) -> list[dict[str, Any]]:
        keys = [batch_key(cache, c, "every_step", np.float32, walked) for c in configs]
        return [cache[key] for key in keys]

    record: dict[str, Any] = {}
    if "commands" in args.parts:
        record["commands"] = [
            _of_command(one, done(command_configs(one, args))) for one in COMMANDS
        ]
    if "grounds" in args.parts:
        record["grounds"] = [
            _of_ground(ground, value, done(ground_configs(ground, value, args)))
            for ground in GROUNDS
            for value in _values(ground, args)
        ]
    if "random" in args.parts:
        runs = done(random_configs(args))
        falls = sum(run["fell"] for run in runs)
        up = [run for run in runs if run["errors"] is not None]
        tilt = np.array([run["tilt_p95_deg"] for run in up]).reshape(-1, 2)
        record["random"] = {
            "episodes": len(runs), "falls": falls, "falls_interval": wilson(falls, len(runs)),
            "fallen_seeds": [seed for seed, run in enumerate(runs) if run["fell"]],
            "roll_p95_median_deg": float(np.median(tilt[:, 0])) if len(up) else None,
            "pitch_p95_median_deg": float(np.median(tilt[:, 1])) if len(up) else None,
            "qp_unsolved": sum(run.get("qp_unsolved", 0) for run in runs),
        }  # fmt: skip
    return record


def _of_command(command: Sequence[float], runs: list[dict[str, Any]]) -> dict[str, Any]:
    up = [run for run in runs if run["errors"] is not None]
    falls = sum(run["fell"] for run in runs)
    row: dict[str, Any] = {"command": list(command), "episodes": len(runs), "falls": falls}
    for name, key, index in (
        ("v_x_rmse_mps", "errors", 0), ("v_y_rmse_mps", "errors", 1),
        ("yaw_rate_rmse_radps", "errors", 2), ("yaw_rate_cycle_rmse_radps", "errors_of_cycles", 2),
        ("roll_p95_deg", "tilt_p95_deg", 0), ("pitch_p95_deg", "tilt_p95_deg", 1),
    ):  # fmt: skip
        values = [float(run[key][index]) for run in up]
        row[name] = float(np.median(values)) if len(up) else None
        row[f"{name}_interval"] = median_interval(values) if len(up) else None
    return row


def _of_ground(ground: Ground, value: float, runs: list[dict[str, Any]]) -> dict[str, Any]:
    crossed = sum(run.get("crossed", False) for run in runs)
    up = [run for run in runs if run.get("crossed")]
    paths = [run["path_error_max_m"] for run in up]
    return {
        "ground": ground.name, "value": value, "unit": ground.unit, "episodes": len(runs),
        "crossed": crossed, "crossed_interval": wilson(crossed, len(runs)),
        "falls": sum(run["fell"] for run in runs),
        "path_error_median_m": float(np.median(paths)) if paths else None,
        "roll_median_deg": float(np.median([run["roll_max_deg"] for run in up])) if up else None,
    }  # fmt: skip


def table(record: dict[str, Any]) -> str:
    """Markdown of all parts."""
    parts = []
    if rows := record.get("commands"):
        header: tuple[str, ...]
        header = ("v_x, v_y [m/s], yaw rate [rad/s]", "episodes", "falls", "RMSE v_x [m/s]",
                  "v_y [m/s]", "yaw rate of a cycle [rad/s]", "roll, 95 % [deg]",
                  "pitch, 95 % [deg]")  # fmt: skip
        names = ("v_x_rmse_mps", "v_y_rmse_mps", "yaw_rate_cycle_rmse_radps")
        parts.append(markdown_table(header, [
            (", ".join(f"{part:g}" for part in row["command"]), str(row["episodes"]),
             str(row["falls"]), *(_number(row[name], 4) for name in names),
             _number(row["roll_p95_deg"], 2), _number(row["pitch_p95_deg"], 2))
            for row in rows
        ]))  # fmt: skip
    if rows := record.get("grounds"):
        header = ("ground", "value", "crossed", "95 % interval [%]", "distance from the path [m]")
        titles = {ground.name: ground.title for ground in GROUNDS}
        parts.append(markdown_table(header, [
            (titles[row["ground"]], f"{row['value']:g} {row['unit']}",
             f"{row['crossed']} of {row['episodes']}",
             "{:.0f} to {:.0f}".format(*(100 * end for end in row["crossed_interval"])),
             _number(row["path_error_median_m"], 3))
            for row in rows
        ]))  # fmt: skip
    if row := record.get("random"):
        low, high = (100 * end for end in row["falls_interval"])
        parts.append(
            f"Random commands: {row['falls']} of {row['episodes']} fell (95 % interval {low:.2f} "
            f"to {high:.2f} %).\n"
        )
    if record["quick"]:
        parts.append("A quick check of the machinery: this is no result.\n")
    return "\n".join(parts)


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def figure(record: dict[str, Any], path: Path) -> None:
    """Part of the seeds that cross each kind of ground, with intervals."""
    from kjax.viz.style import BLUE, DARK, GREEN, ORANGE, RED, STYLE

    rows = record.get("grounds", [])
    with plt.rc_context(STYLE):
        fig, axes = plt.subplots(1, 2, figsize=(9.0, 3.4), sharey=True, layout="constrained")
        colours = (BLUE, RED, GREEN, ORANGE, DARK)
        for ground, colour in zip(GROUNDS, colours, strict=True):
            own = [row for row in rows if row["ground"] == ground.name]
            if not own:
                continue
            ax = axes[0] if ground.unit == "deg" else axes[1]
            scale = 1.0 if ground.unit == "deg" else 100.0
            value = scale * np.array([row["value"] for row in own])
            # Beside each other, where they would hide one another.
            kin = [one.name for one in GROUNDS if one.unit == ground.unit]
            gap = 0.12 * (value[1] - value[0]) if len(value) > 1 else 0.0
            value += gap * (kin.index(ground.name) - 0.5 * (len(kin) - 1))
            share = 100 * np.array([row["crossed"] / row["episodes"] for row in own])
            ends = 100 * np.array([row["crossed_interval"] for row in own]).T
            ax.errorbar(value, share, np.abs(ends - share), color=colour, marker="o",
                        capsize=3, label=ground.title)  # fmt: skip
        axes[0].set(xlabel="inclination [deg]", ylabel="crossed [% of the seeds]")
        axes[1].set(xlabel="height [cm]")
        axes[0].set_xticks(_ANGLES)
        axes[1].set_xticks(100 * np.array(_HEIGHTS))
        for ax in axes:
            ax.set_ylim(-5, 105)
            if ax.get_legend_handles_labels()[0]:
                ax.legend(loc="lower left")
        fig.suptitle(_title(rows))
        fig.savefig(path)
        plt.close(fig)


def _title(rows: Sequence[dict[str, Any]]) -> str:
    """The finding: how far every seed came."""
    words = []
    for unit, kinds in (("deg", "slopes"), ("m", "steps and tiles")):
        own = [row for row in rows if row["unit"] == unit]
        whole = [
            value for value in sorted({row["value"] for row in own})
            if all(r["crossed"] == r["episodes"] for r in own if r["value"] <= value)
        ]  # fmt: skip
        if whole:
            most = f"{whole[-1]:g} deg" if unit == "deg" else f"{100 * whole[-1]:g} cm"
            words.append(f"{kinds} of up to {most}")
    return f"Every seed crosses {' and '.join(words)}" if words else "Grounds crossed unseen"
