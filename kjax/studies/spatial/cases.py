"""What the parts of the study have in common: their options, their configs, their record."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from kjax.config import RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import Count, Options
from kjax.runs.batches import Measure
from kjax.sim.intervals import median_interval, wilson

Row: TypeAlias = dict[str, Any]
Done: TypeAlias = Callable[[list[RunConfig]], list[Row]]

# The bound whose footholds suit a plan through flight.
GAITS = {"trot": "trot", "flying_trot": "flying_trot", "bound": "bound_multiphase"}
NAMES = ("commands", "grounds", "random", "pushes", "speeds", "switches", "laps", "paper")


@dataclass(kw_only=True)
class SpatialOptions(Options):
    """Options of the study."""

    parts: tuple[str, ...] = NAMES
    """Which of them."""

    seeds: int = 16
    """Episodes per command, ground, push and speed."""

    robots: int = 1024
    """Episodes of random commands, and of each crossing of the paper's field."""

    engine: Literal["mujoco_batch", "mjx"] = "mujoco_batch"
    """Whose physics: MuJoCo in C, or MJX (a GPU's; feet only touch the ground)."""

    chunk: int = 64
    """Robots that walk side by side, and are kept together."""

    threads: Count = None
    """One per core if left out; of the C engine."""

    quick: bool = False
    """2 seeds, one value each, short: to check the script."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One part of the study.

    Attributes:
      name: of it, for ``--parts`` and in results.json.
      summary: record of the part, from the rows of all its walks.
      table: Markdown of that record.
      batches: what walks side by side: labels, and configs of one scene and controller.
      measure: of such a walk, besides its usual metrics.
      alone: what walks one after the other, in a loop of its own.
      walk: of one of these.
    """

    name: str
    summary: Callable[[SpatialOptions, Done], Any]
    table: Callable[[Any], str]
    batches: Callable[[SpatialOptions], Sequence[tuple[str, list[RunConfig]]]] = lambda args: ()
    measure: Measure | None = None
    alone: Callable[[SpatialOptions], Sequence[RunConfig]] = lambda args: ()
    walk: Callable[[RunConfig], Row] | None = None


def base(args: SpatialOptions, keys: dict[str, Any], name: str = "omni_trot") -> RunConfig:
    """A shipped config with other values, for the engine that is asked for."""
    own: dict[str, Any] = {"gait.also": [], **keys}
    if args.engine == "mjx":
        own["sim.contacts"] = "feet"
    return load_config(RunConfig, shipped_config(name), own)


def share(hits: int, count: int) -> Row:
    """A number of successes with Wilson's interval."""
    return {"count": hits, "episodes": count, "interval": wilson(hits, count)}


def median(rows: Sequence[Row], name: str, key: str, index: int | None = None) -> Row:
    """Median and interval of a number of each row."""
    values = [float(row[key] if index is None else row[key][index]) for row in rows]
    return {
        name: float(np.median(values)) if values else None,
        f"{name}_interval": median_interval(values) if values else None,
    }


def number(value: float | None, digits: int) -> str:
    """For a table; empty where there is none."""
    return "" if value is None else f"{value:.{digits}f}"


def percent(interval: Sequence[float], digits: int = 0) -> str:
    """Ends of the interval of a share [%]."""
    low, high = (100 * end for end in interval)
    return f"{low:.{digits}f} to {high:.{digits}f}"
