"""What the models are asked to walk, and what is measured of it."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kjax.config import CommandConfig, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import Count, Options
from kjax.sim.trajectory import Trajectory
from kjax.studies.spatial.cases import Row
from kjax.studies.spatial.measures import walked

MODELS = ("momentum", "convex", "present", "edmd", "bilinear")
# v_x, v_y [m/s] and yaw rate [rad/s] of the steady walks, which the weights are tuned on as well.
STEADY = ((1.0, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 1.5), (0.8, 0.3, 1.5))
IMPULSE, PHASES = 15.0, 8  # N s; phases of a cycle at which a push begins
THROWN = {  # 1 sigma of the start; of roll there is no such key
    "noise.initial_pitch": 0.2, "noise.initial_velocity": 0.5, "noise.initial_pitch_rate": 2.0,
}  # fmt: skip
# Errors that cost 1: of v_x, v_y [m/s], of the yaw rate over a cycle [rad/s], of roll, pitch [deg].
UNIT = np.array([0.02, 0.02, 0.02, 1.0, 1.0])
FALL = 1000.0
DURATION = 3.5  # s, of what is reported: one batch has one duration


@dataclass(kw_only=True)
class SpatialWalksOptions(Options):
    """Options of the study."""

    models: tuple[str, ...] = MODELS
    """Which of them."""

    cases: tuple[str, ...] = ("steady", "turning", "pushed", "thrown", "bound", "long")
    """What they report on."""

    generations: int = 8
    """Of CMA-ES, for every model."""

    population: int = 10
    """Candidates of a generation."""

    tuning_seeds: int = 1
    """Episodes of every candidate and command."""

    seeds: int = 8
    """Episodes of every case that is reported."""

    push_seeds: int = 2
    """Episodes of every push."""

    threads: Count = None
    """One per core if left out."""

    quick: bool = False
    """2 models, 1 generation of 2 candidates, 2 seeds, short: to check the script."""


def walk_config(
    model: str,
    command: tuple[float, float, float],
    duration: float,
    keys: dict[str, Any] | None = None,
    name: str = "omni_trot",
) -> RunConfig:
    """A shipped config with this model, and a command that is held from 0.5 s on."""
    own = {"gait.also": [], "spatial.model": model, **(keys or {})}
    v_x, v_y, yaw_rate = command
    asked = CommandConfig(
        times=(0.0, 0.5), v_x=(0.0, v_x), v_y=(0.0, v_y), yaw_rate=(0.0, yaw_rate)
    )
    one = load_config(RunConfig, shipped_config(name), own)
    # Of no strength: with as many pushes as the walks that are pushed, one program serves both.
    push = dataclasses.replace(one.push, times=(1.0,), forward=0.0, lateral=0.0)
    return dataclasses.replace(one, command=asked, push=push, duration=duration)


def with_seeds(configs: Sequence[RunConfig], seeds: Sequence[int]) -> list[RunConfig]:
    """Each config with every seed: seed by seed."""
    return [dataclasses.replace(one, seed=seed) for seed in seeds for one in configs]


def tuning_configs(model: str, args: SpatialWalksOptions) -> list[RunConfig]:
    """Episodes of a candidate; seeds of their own."""
    walks = [walk_config(model, command, 3.0) for command in STEADY]
    return with_seeds(walks[:2] if args.quick else walks, range(100, 100 + args.tuning_seeds))


def _steady(model: str, args: SpatialWalksOptions) -> list[RunConfig]:
    return with_seeds([walk_config(model, one, DURATION) for one in STEADY], range(args.seeds))


def _turning(model: str, args: SpatialWalksOptions) -> list[RunConfig]:
    return with_seeds([walk_config(model, (1.0, 0.0, 2.5), DURATION)], range(args.seeds))


def _pushed(model: str, args: SpatialWalksOptions) -> list[RunConfig]:
    one = walk_config(model, (0.5, 0.0, 0.0), DURATION)
    period, out = one.gaits[one.gait.names[0]].period, []
    for forward, lateral in ((IMPULSE, 0.0), (0.0, IMPULSE)):
        for phase in range(1 if args.quick else PHASES):
            begin = round(1.6 + phase * period / PHASES, 3)
            push = dataclasses.replace(
                one.push, times=(begin,), forward=forward, lateral=lateral, duration=0.1
            )
            out.append(dataclasses.replace(one, push=push))
    return with_seeds(out, range(args.push_seeds))


def _thrown(model: str, args: SpatialWalksOptions) -> list[RunConfig]:
    return with_seeds([walk_config(model, (0.5, 0.0, 0.0), DURATION, THROWN)], range(args.seeds))


def _bound(model: str, args: SpatialWalksOptions) -> list[RunConfig]:
    one = walk_config(model, (0.6, 0.0, 0.0), DURATION, name="omni_bound")
    return with_seeds([one], range(args.seeds))


def _long(model: str, args: SpatialWalksOptions) -> list[RunConfig]:
    keys = {"spatial.horizon": 0.4, "gaits.trot.period": 0.4}
    return with_seeds([walk_config(model, STEADY[-1], DURATION, keys)], range(args.seeds))


@dataclass(frozen=True, kw_only=True)
class WalkCase:
    """A case that is reported.

    Attributes:
      title: of it, in table and figure.
      configs: its episodes with a model.
      program: what its controller is compiled for; cases with one program walk side by side.
      is_disturbed: whether falls and the largest tilt are reported, not errors.
      together: episodes of a seed, whose mean is one value.
    """

    title: str
    configs: Callable[[str, SpatialWalksOptions], list[RunConfig]]
    program: str = "trot"
    is_disturbed: bool = False
    together: int = 1


CASES = {
    "steady": WalkCase(title="steady commands", configs=_steady, together=len(STEADY)),
    "turning": WalkCase(title="1 m/s, 2.5 rad/s", configs=_turning),
    "pushed": WalkCase(title="pushed, 15 N s", configs=_pushed, is_disturbed=True),
    "thrown": WalkCase(title="thrown", configs=_thrown, is_disturbed=True),
    "bound": WalkCase(title="bound, 0.6 m/s", configs=_bound, program="bound"),
    "long": WalkCase(title="horizon of 0.4 s", configs=_long, program="long"),
}


def observed(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """Errors against the command, the largest tilt, and what the errors cost."""
    row = walked(run, config)
    x, y = run.qpos[:, 4], run.qpos[:, 5]
    up = np.clip(1.0 - 2.0 * (x**2 + y**2), -1.0, 1.0)  # R_zz of the trunk's quaternion
    tilt = None if run.fell else float(np.degrees(np.arccos(up)).max())
    return row | {"largest_tilt_deg": tilt, "cost": cost(row)}


def cost(row: Row) -> float:
    """Sum of squared errors in their units; of a fall ``FALL``."""
    if row["errors"] is None:
        return FALL
    v_x, v_y, _ = row["errors"]
    errors = np.array([v_x, v_y, row["errors_of_cycles"][2], *row["tilt_p95_deg"]])
    return float(min(((errors / UNIT) ** 2).sum(), FALL))
