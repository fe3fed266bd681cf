"""What a closed loop is made of: a plant, a record of functions, what it meets and leaves."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from kjax.config import NoiseConfig, RunConfig
from kjax.controllers.controller import Controller
from kjax.controllers.params import ControllerParams, Tables
from kjax.types import Command, RobotParams

# A body beyond these has fallen: what it does then is of no interest, and it is held still.
MAX_TILT = 1.0  # rad
HEIGHTS = (0.10, 0.50)  # m

# Range of the commanded velocities, low and high: of v_x, or (3,) of v_x, v_y and yaw rate.
Speeds = tuple[float | tuple[float, ...], float | tuple[float, ...]]


class Scenario(NamedTuple):
    """What a run meets; a leading axis makes a batch of them.

    Attributes:
      command: what is asked over time.
      x: start of the body: (6,) on the planar plant [m, rad, m/s, rad/s], else a ``BodyState``.
      plant: its parameters.
      noise: (6,) standard deviation of what is measured of x [m, rad, m/s, rad/s]; (9,) in three
        dimensions, see ``spatial_plant.measure``.
      key: of the noise, key data.
    """

    command: Command
    x: Any
    plant: Any
    noise: Float[Array, "n"]
    key: UInt32[Array, "2"]


class Trace(NamedTuple):
    """A run, at the beginning of each control tick; forces and feet are (x, z) or (x, y, z).

    Attributes:
      x: (T, 6) state [m, rad, m/s, rad/s]; (T, 12) in three dimensions: roll, pitch, yaw, place,
        and along the trunk's heading its angular velocity and velocity.
      wanted: (T, 2) reference of v_x [m/s] and mean height [m]; (T, 6) in three dimensions, order
        of ``types.COMMAND_NAMES``, the height from the ground.
      feet: (T, 4, d) feet, world [m].
      stance: (T, 4) legs that stand.
      mode: (T,) contact mode.
      force: (T, 4, d) force of each leg on the body, body frame, or world in three dimensions [N].
      missing: (T, 4, d) what joints and ground kept back of the planned ones [N].
      status: (T,) of the QPs.
      alive: (T,) whether the body has not fallen yet.
    """

    x: Float[Array, "T n"]
    wanted: Float[Array, "T k"]
    feet: Float[Array, "T 4 d"]
    stance: Bool[Array, "T 4"]
    mode: Int[Array, "T"]
    force: Float[Array, "T 4 d"]
    missing: Float[Array, "T 4 d"]
    status: Int[Array, "T"]
    alive: Bool[Array, "T"]


class Run(NamedTuple):
    """What stays the same over a run."""

    params: ControllerParams
    tables: Tables
    scenario: Scenario
    key: PRNGKeyArray


class CostWeights(NamedTuple):
    """What one unit of the cost is.

    The cost is the mean over time of e / (1 + e / fall), e the sum of the squares of these: near e
    while the robot walks, and no state costs more than a fall.

    Attributes:
      velocity: error of v_x, in three dimensions of v_y too [m/s].
      pitch: trunk's pitch from level, in three dimensions that and the roll from what is asked
        [rad].
      height: of the centre of mass from its mean [m].
      effort: forces of all legs, root of the sum of squares, in weights of the robot [-].
      missing: force that joints or ground kept back, likewise [-].
      fall: cost of every tick after a fall [-].
      yaw_rate: its error, in three dimensions only [rad/s].
    """

    velocity: float = 0.05
    pitch: float = 0.05
    height: float = 0.02
    effort: float = 5.0
    missing: float = 0.2
    fall: float = 100.0
    yaw_rate: float = 0.2


class Ranges(NamedTuple):
    """What random scenarios are drawn from.

    Attributes:
      speeds: range of the commanded velocities.
      pieces: of the command, equally long.
      mass_error: largest relative error of the mass [-].
      inertia_error: largest relative error of the inertia [-].
      lag: longest lag of the forces [s].
      gain: range of the part of a planned force that arrives [-].
    """

    speeds: Speeds
    pieces: int
    mass_error: float
    inertia_error: float
    lag: float
    gain: tuple[float, float]


class Plant(NamedTuple):
    """A plant in the closed loop, a record of functions.

    Attributes:
      start: (controller, run) -> what is carried from tick to tick, at first.
      build_tick: (controller, fade) -> a tick: (run, carried, number) -> (carried, trace). ``fade``
        discounts the derivatives of the body's state.
      errors: (trace, weights) -> (k, T) what the cost squares, in its units.
      draw: (config, robot, generator, count, ranges) -> scenarios (count, ...), NumPy.
      v_x: column of the trace's x that holds it.
      pitch: likewise.
    """

    start: Callable[[Controller, Run], Any]
    build_tick: Callable[
        [Controller, Callable[[Any], Any]], Callable[[Run, Any, Array], tuple[Any, Trace]]
    ]
    errors: Callable[[Trace, CostWeights], Array]
    draw: Callable[[RunConfig, RobotParams, np.random.Generator, int, Ranges], Scenario]
    v_x: int
    pitch: int


def noise_of(config: RunConfig) -> NoiseConfig:
    """Noise and spread of a config, all zero where it is off."""
    if config.noise.enabled:
        return config.noise
    zero = {name: 0.0 for name in NoiseConfig.__dataclass_fields__ if name != "enabled"}
    return NoiseConfig(**zero)  # type: ignore[arg-type]


def piece_times(config: RunConfig, count: int, pieces: int) -> np.ndarray:
    """Times (count, pieces) at which the pieces of a command begin [s]."""
    return np.broadcast_to(np.arange(pieces) * config.duration / pieces, (count, pieces))
