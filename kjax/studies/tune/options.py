"""Options of a tuning, and what follows from the config that it tunes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from kjax.config import RunConfig
from kjax.options import RunOptions, fail, parse_config, require
from kjax.tuning.contract import Speeds

# Columns of the command that are drawn at random, by controller.
DRAWN = {"planar": ("v_x",), "spatial": ("v_x", "v_y", "yaw_rate")}
SPATIAL_KEYS = (
    "spatial.attitude", "spatial.position", "spatial.omega", "spatial.velocity", "spatial.force",
    "spatial.velocity_time", "lateral.foothold_gain",
)  # fmt: skip


@dataclass(kw_only=True)
class TuneOptions(RunOptions):
    """Options of a tuning."""

    keys: tuple[str, ...] = ()
    """What to tune, e.g. lmpc.Q lmpc.R; the gait's weights if left out."""

    scenarios: int = 16
    """To descend on."""

    held_out: int = 32
    """To choose the best point on."""

    seconds: float = 3.0
    """Length of a scenario."""

    pieces: int = 2
    """Velocities in a scenario's command."""

    updates: int = 150
    """Of Adam, at most."""

    rate: float = 0.15
    """Of Adam, in the log of a weight."""

    patience: int = 40
    """Updates without improvement."""

    minutes: float = 15.0
    """Wall time, at most."""

    worsen: float = 1.0
    """Begin with every parameter off by this factor, up or down."""

    worsen_seed: int = 0
    """Of which are up, which down."""

    memory: float = 0.1
    """Of the derivatives [s]; inf for the true ones, which a chaotic loop makes useless."""

    baseline: bool = False
    """CMA-ES in MuJoCo from the same start, for the same time."""

    refine: bool = False
    """CMA-ES in MuJoCo from the descent's result, likewise."""

    seeds: int = 16
    """Episodes in MuJoCo at the end."""


@dataclass(kw_only=True)
class Task(TuneOptions):
    """Options, and what follows from the config: the range of velocities."""

    speeds: Speeds


def parse_task(argv: Sequence[str] | None, title: str) -> tuple[RunConfig, Task]:
    """Config and task of a command line; ``title`` heads its help."""
    config, given = parse_config(TuneOptions, argv, title)
    names = ("scenarios", "held_out", "seconds", "pieces", "updates", "rate", "patience",
             "minutes", "worsen", "memory", "seeds")  # fmt: skip
    require(given, *names, above=0)
    if config.controller == "planar" and config.sim.base != "planar":
        fail(
            f"sim.base: got '{config.sim.base}', wanted 'planar', as the planar controller's plant "
            "is; or set controller = 'spatial'"
        )
    task = Task(**vars(given), speeds=_speeds(config))
    task.keys = task.keys or _own_keys(config)
    for key in filter(partial(_is_unread, config), task.keys):
        fail(f"--keys: '{key}' has no effect with controller = '{config.controller}'")
    return config, task


def _speeds(config: RunConfig) -> Speeds:
    """Range of the velocities that the config's command asks for."""
    names = DRAWN[config.controller]
    columns = [getattr(config.command, name) or (0.0,) for name in names]
    low, high = (tuple(float(edge(column)) for column in columns) for edge in (min, max))
    return (low, high) if len(names) > 1 else (low[0], high[0])


def _is_unread(config: RunConfig, key: str) -> bool:
    """Whether a key is of the other controller."""
    if config.controller == "planar":
        return key.startswith(("spatial.", "lateral."))
    section, _, name = key.rpartition(".")
    weights = ("Q", "R", "grf_x_max", "grf_z_min", "grf_z_max", "integral_gains")
    of_planar = section == "lmpc" or section.startswith("gaits.")
    return section == "multiphase" or (of_planar and name in weights)


def _own_keys(config: RunConfig) -> tuple[str, ...]:
    """Weights of the config's controller or gait, and foothold gains."""
    name = config.gait.names[0]
    own = config.gaits[name]
    if config.controller == "spatial":
        gain = "leg" if own.foothold_gain is None else f"gaits.{name}"
        return (*SPATIAL_KEYS, f"{gain}.foothold_gain")
    keys = [
        f"gaits.{name}.{key}"
        for key in ("Q", "R", "foothold_gain")
        if getattr(own, key) is not None
    ]
    return tuple(keys) or ("lmpc.Q", "lmpc.R")
