"""Constant commands, and such as are drawn anew every few seconds, as raw steps."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from kjax.config import CommandConfig, RunConfig
from kjax.studies.spatial.cases import (
    Done,
    Part,
    Row,
    SpatialOptions,
    base,
    median,
    number,
    percent,
    share,
)  # fmt: skip
from kjax.studies.spatial.measures import walked
from kjax.viz.tables import markdown_table

# v_x, v_y [m/s] and yaw rate [rad/s] that are held.
COMMANDS = (
    (0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 1.5), (0.8, 0.3, 1.5),
)  # fmt: skip
# Of the random ones: ours, and that which MuJoCo Playground's joystick policies are trained on.
RANGES = {"own": (1.0, 0.4, 1.5), "playground": (1.5, 0.8, 1.2)}


def command_configs(command: tuple[float, float, float], args: SpatialOptions) -> list[RunConfig]:
    """Episodes of one command, held from 0.5 s on."""
    v_x, v_y, yaw_rate = command
    asked = CommandConfig(
        times=(0.0, 0.5), v_x=(0.0, v_x), v_y=(0.0, v_y), yaw_rate=(0.0, yaw_rate)
    )
    one = dataclasses.replace(base(args, {}), command=asked, duration=3.0 if args.quick else 8.0)
    return [dataclasses.replace(one, seed=seed) for seed in range(args.seeds)]


def random_configs(name: str, args: SpatialOptions) -> list[RunConfig]:
    """Episodes of random commands; the seed of each draws its own."""
    one, duration = base(args, {}), 4.0 if args.quick else 20.0
    out = []
    for seed in range(args.robots):
        rng = np.random.default_rng([seed, 19])
        times = np.cumsum(np.append(0.5, rng.uniform(2.0, 5.0, 10))).round(3)
        times = times[times < duration]
        values = np.array(RANGES[name]) * rng.uniform(-1.0, 1.0, (len(times), 3))
        columns = [(0.0, *column) for column in values.T.tolist()]
        asked = CommandConfig(
            times=(0.0, *times.tolist()), v_x=columns[0], v_y=columns[1], yaw_rate=columns[2]
        )
        out.append(dataclasses.replace(one, seed=seed, command=asked, duration=duration))
    return out


def _constant(args: SpatialOptions) -> list[tuple[str, list[RunConfig]]]:
    return [("commands", [c for one in COMMANDS for c in command_configs(one, args)])]


def _constant_summary(args: SpatialOptions, done: Done) -> list[Row]:
    return [of_command(one, done(command_configs(one, args))) for one in COMMANDS]


def of_command(command: Sequence[float], runs: list[Row]) -> Row:
    """Record of one command, from the rows of its walks."""
    up = [run for run in runs if run["errors"] is not None]
    falls = sum(run["fell"] for run in runs)
    row: Row = {"command": list(command), "episodes": len(runs), "falls": falls}
    for name, key, index in (
        ("v_x_rmse_mps", "errors", 0), ("v_y_rmse_mps", "errors", 1),
        ("yaw_rate_rmse_radps", "errors", 2), ("yaw_rate_cycle_rmse_radps", "errors_of_cycles", 2),
        ("roll_p95_deg", "tilt_p95_deg", 0), ("pitch_p95_deg", "tilt_p95_deg", 1),
    ):  # fmt: skip
        row |= median(up, name, key, index)
    return row


def _constant_table(rows: list[Row]) -> str:
    header = ("v_x, v_y [m/s], yaw rate [rad/s]", "episodes", "falls", "RMSE v_x [m/s]",
              "v_y [m/s]", "yaw rate of a cycle [rad/s]", "roll, 95 % [deg]",
              "pitch, 95 % [deg]")  # fmt: skip
    names = ("v_x_rmse_mps", "v_y_rmse_mps", "yaw_rate_cycle_rmse_radps")
    return markdown_table(header, [
        (", ".join(f"{part:g}" for part in row["command"]), str(row["episodes"]),
         str(row["falls"]), *(number(row[name], 4) for name in names),
         number(row["roll_p95_deg"], 2), number(row["pitch_p95_deg"], 2))
        for row in rows
    ])  # fmt: skip


def _random(args: SpatialOptions) -> list[tuple[str, list[RunConfig]]]:
    return [("random commands", [c for name in RANGES for c in random_configs(name, args)])]


def _random_summary(args: SpatialOptions, done: Done) -> dict[str, Any]:
    out = {}
    for name, limits in RANGES.items():
        runs = done(random_configs(name, args))
        up = [run for run in runs if run["errors"] is not None]
        out[name] = {
            "range": list(limits),
            "falls": share(sum(run["fell"] for run in runs), len(runs)),
            "fallen_seeds": [seed for seed, run in enumerate(runs) if run["fell"]],
            **median(up, "roll_p95_deg", "tilt_p95_deg", 0),
            **median(up, "pitch_p95_deg", "tilt_p95_deg", 1),
            "qp_unsolved": sum(run.get("qp_unsolved", 0) for run in runs),
        }
    return out


def _random_table(found: dict[str, Any]) -> str:
    header = ("random commands within v_x, v_y [m/s], yaw rate [rad/s]", "episodes", "falls",
              "95 % interval [%]", "roll, 95 % [deg]", "pitch, 95 % [deg]")  # fmt: skip
    return markdown_table(header, [
        (", ".join(f"±{one:g}" for one in row["range"]), str(row["falls"]["episodes"]),
         str(row["falls"]["count"]), percent(row["falls"]["interval"], 2),
         number(row["roll_p95_deg"], 2), number(row["pitch_p95_deg"], 2))
        for row in found.values()
    ])  # fmt: skip


CONSTANT = Part(
    name="commands", batches=_constant, measure=walked, summary=_constant_summary,
    table=_constant_table,
)  # fmt: skip
RANDOM = Part(
    name="random", batches=_random, measure=walked, summary=_random_summary, table=_random_table
)
