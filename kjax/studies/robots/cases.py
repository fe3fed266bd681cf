"""What each robot is asked: the same in its own units, and what counts as done.

Speeds scale with sqrt(L) (equal Froude numbers), turns with 1 / sqrt(L), the paper's field with L,
pushes with m sqrt(L); 1 for the Go1.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from kjax.config import CommandConfig, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.robots import get_robot
from kjax.sim.trajectory import Trajectory
from kjax.studies.spatial.cases import Row
from kjax.studies.spatial.measures import reached, walked

CONFIG = "omni_trot"
LENGTH, MASS = 0.426, 12.743  # m, kg, of the Go1
SETTLE, DURATION = 0.5, 5.0  # s: standing before the command, and the whole episode
PUSH_AT, PHASES, IMPULSE = 2.5, 8, 12.0  # s; of a cycle; N s of the Go1
SLOW = 0.15  # largest error of the mean speed, in speeds of the case
TILT = {"bound_multiphase": 30.0}  # deg, that a walk on flat ground stays below, by gait
LEVEL = 15.0  # deg, in any other gait
# Of the paper's field, for the Go1 [m].
FIELD = {"start": 0.8, "end": 2.6, "height_min": 0.05, "height_max": 0.07}


class Scale(NamedTuple):
    """A robot against the Go1.

    Attributes:
      length: of its legs [-].
      speed: sqrt of that [-].
      mass: [-].
    """

    length: float
    speed: float
    mass: float


@dataclass(frozen=True, kw_only=True)
class RobotTask:
    """One thing that is asked.

    Attributes:
      title: of its column.
      velocity: v_x, v_y [m/s] and yaw rate [rad/s] of the Go1.
      gait: that it is asked in.
      impulse: of a push to each side in turn, of the Go1 [N s].
      rough: whether the paper's field lies ahead.
    """

    title: str
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gait: str = "trot"
    impulse: float = 0.0
    rough: bool = False


CASES = {
    "stand": RobotTask(title="stand", gait="stand"),
    "trot": RobotTask(title="trot 0.5 m/s", velocity=(0.5, 0.0, 0.0)),
    "fast": RobotTask(title="trot 1.0 m/s", velocity=(1.0, 0.0, 0.0)),
    "sideways": RobotTask(title="sideways 0.3 m/s", velocity=(0.0, 0.3, 0.0)),
    "turn": RobotTask(title="turn 1.5 rad/s", velocity=(0.0, 0.0, 1.5)),
    "push": RobotTask(title=f"push {IMPULSE:g} N s", velocity=(0.3, 0.0, 0.0), impulse=IMPULSE),
    "bound": RobotTask(title="bound 0.5 m/s", velocity=(0.5, 0.0, 0.0), gait="bound_multiphase"),
    "field": RobotTask(title="the paper's field", velocity=(0.3, 0.0, 0.0), rough=True),
}


# What walks side by side, and the gaits of its program.
GROUPS = {
    "flat": ("stand", "trot"), "bound": ("bound_multiphase",), "field": ("stand", "trot"),
}  # fmt: skip


def group_of(name: str) -> str:
    """Group of a case."""
    if CASES[name].rough:
        return "field"
    return "flat" if CASES[name].gait in GROUPS["flat"] else "bound"


def scale_of(robot: str) -> Scale:
    """Size of a robot."""
    params = get_robot(robot).params
    length = float(params.thigh_length + params.calf_length) / LENGTH
    return Scale(length, float(np.sqrt(length)), float(params.mass) / MASS)


def case_configs(robot: str, name: str, seeds: Sequence[int]) -> list[RunConfig]:
    """Episodes of one robot and case."""
    case, scale = CASES[name], scale_of(robot)
    keys: dict[str, Any] = {
        "robot": robot, "gait.also": list(GROUPS[group_of(name)]), "gait.names": [case.gait],
        "gaits.trot.period": 0.4, "duration": DURATION,
    }  # fmt: skip
    if case.rough:
        lengths = {f"terrain.{key}": value * scale.length for key, value in FIELD.items()}
        until = FIELD["end"] * scale.length / (case.velocity[0] * scale.speed)
        keys |= lengths | {
            "terrain.kind": "paper", "leg.swing_height": 0.2817,
            "duration": round(until + 2.5 * scale.speed, 2),
        }  # fmt: skip
    one = load_config(RunConfig, shipped_config(CONFIG), keys)
    v_x, v_y, rate = case.velocity
    asked = CommandConfig(
        times=(0.0, SETTLE), v_x=(0.0, v_x * scale.speed), v_y=(0.0, v_y * scale.speed),
        yaw_rate=(0.0, rate / scale.speed),
    )  # fmt: skip
    out = []
    for seed in seeds:
        # A quarter of the seeds from each side, at all phases of a cycle.
        angle = seed % 4 * np.pi / 2
        impulse = case.impulse * scale.mass * scale.speed
        push = dataclasses.replace(
            one.push,
            times=(round(PUSH_AT + seed // 4 % PHASES * 0.4 / PHASES, 3),),
            forward=round(impulse * np.cos(angle), 9),
            lateral=round(impulse * np.sin(angle), 9),
        )
        terrain = dataclasses.replace(one.terrain, seed=seed)
        out.append(dataclasses.replace(one, seed=seed, command=asked, push=push, terrain=terrain))
    return out


def observed(run: Trajectory, config: RunConfig) -> dict[str, Any]:
    """What the cases are judged by."""
    return walked(run, config) | reached(run, config)


def succeeded(name: str, row: Row, scale: Scale) -> bool:
    """Whether an episode did what its case asks."""
    case = CASES[name]
    if row["fell"] or row["reached"] is None:
        return False
    if case.rough:
        return bool(row["crossed"])
    if case.impulse:
        return True
    unit = np.array([scale.speed, scale.speed, 1.0 / scale.speed])
    wanted = np.array(case.velocity) * unit
    fast = max(np.abs(case.velocity[:2]).max(), 0.3) * scale.speed
    allowed = SLOW * np.array([fast, fast, max(case.velocity[2], 1.0) / scale.speed])
    off = np.abs(np.array(row["reached"]) - wanted)
    return bool((off < allowed).all() and max(row["tilt_max_deg"]) < TILT.get(case.gait, LEVEL))
