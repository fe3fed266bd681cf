"""A differentiable closed loop: the controller's own ``plan`` on the rigid body, over seconds.

    x_{t+1} = plant(x_t, feet_t, u_t),   u_t = argmin QP(x_t + noise, params),   t = 0 .. T - 1

A run is a pure function of the controller's parameters and a scenario. Stances, flights and
touchdown times come from the schedule; where a foot comes down follows from the state. Derivatives
go through all of it, the QPs' active sets as they are. Reverse mode keeps the states at the
beginnings of some sqrt(T) segments and computes each segment again. The plant is that of the
config's controller: a planar body (``planar``), or one in three dimensions (``spatial``).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import ceil, exp, inf, sqrt
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from kjax.config import RunConfig
from kjax.controllers.controller import build_controller
from kjax.controllers.params import ControllerParams, condense
from kjax.controllers.resolve import controller_spec
from kjax.qp.block_rows import SOLUTION
from kjax.robots import get_robot
from kjax.tuning.contract import CostWeights, Plant, Ranges, Run, Scenario, Speeds, Trace
from kjax.tuning.planar import PLANAR
from kjax.tuning.spatial import SPATIAL
from kjax.types import GRAVITY, RobotParams

__all__ = [
    "CostWeights",
    "Loop",
    "Scenario",
    "Trace",
    "build_loop",
    "cost",
    "draw_scenarios",
    "plant_of",
]

Loop = Callable[[ControllerParams, Scenario], Trace]

# Backward a segment is computed again, but for the QPs that name their solutions.
_KEEP = jax.checkpoint_policies.save_only_these_names(SOLUTION)


def plant_of(config: RunConfig) -> Plant:
    """The plant that a config's controller walks.

    Raises:
      ValueError: for the planar controller on a free base.
    """
    if config.controller == "spatial":
        return SPATIAL
    if config.sim.base != "planar":
        raise ValueError(
            f"sim.base must be 'planar' here, got '{config.sim.base}'; "
            "or set controller = 'spatial'"
        )
    return PLANAR


def build_loop(config: RunConfig, *, segment: int | None = None, memory: float = inf) -> Loop:
    """The closed loop of a config, ``config.duration`` long.

    A loop that is unstable over some ticks, a saturated limit cycle say, has derivatives that grow
    with the run's length without end, true and of no use. ``memory`` fades what goes back through
    the body's state: values stay as they are, derivatives are those of the last so many seconds.

    Args:
      config: of the controller; what concerns MuJoCo (sim, terrain, push, and of lateral what the
        planar controller reads) has no effect.
      segment: control ticks between two states that reverse mode keeps; about sqrt(T) if ``None``,
        and T or more to keep all that it needs of every tick.
      memory: time in which the derivative through the state fades to 1/e; inf for the true one [s].

    Raises:
      ValueError: for the planar controller on a free base.
    """
    plant = plant_of(config)
    # A tableau carried from tick to tick would be kept for every one of them.
    spec = replace(controller_spec(config), warm_start=False)
    controller = build_controller(spec)
    ticks = max(1, round(config.duration / spec.control_dt))
    segment = ceil(sqrt(ticks)) if segment is None else min(segment, ticks)
    if segment < 1:
        raise ValueError(f"segment must be at least 1, got {segment}")
    if not memory > 0:
        raise ValueError(f"memory must be above 0 s, got {memory}")
    segments = -(-ticks // segment)
    step = plant.build_tick(controller, _build_fade(exp(-spec.control_dt / memory)))

    def run(params: ControllerParams, scenario: Scenario) -> Trace:
        params = params._replace(command=scenario.command)
        tables = condense(spec, params)
        own = Run(params, tables, scenario, jax.random.wrap_key_data(scenario.key))

        def stretch(carry: Any, indices: Array) -> tuple[Any, Trace]:
            return jax.lax.scan(partial(step, own), carry, indices)

        indices = np.arange(segments * segment, dtype=np.int32).reshape(segments, segment)
        pieces: Any = stretch if segments == 1 else jax.checkpoint(stretch, policy=_KEEP)
        _, trace = jax.lax.scan(pieces, plant.start(controller, own), indices)
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:ticks], trace)

    return run


def _build_fade(keep: float) -> Callable[[Any], Any]:
    """A state as it is, of whose derivative the part ``keep`` stays."""

    def fade(x: Array) -> Array:
        return x if keep == 1.0 else keep * x + (1.0 - keep) * jax.lax.stop_gradient(x)

    return partial(jax.tree.map, fade)


def cost(
    robot: RobotParams,
    trace: Trace,
    weights: CostWeights = CostWeights(),  # noqa: B008
    plant: Plant = PLANAR,
) -> Array:
    """Cost of a run: tracking, attitude, height, effort, saturation, falls; see ``CostWeights``."""
    weight = robot.mass * GRAVITY
    error = plant.errors(trace, weights)
    forces = jnp.stack(
        [
            jnp.sum((trace.force / weight) ** 2, axis=(1, 2)) / weights.effort**2,
            jnp.sum((trace.missing / weight) ** 2, axis=(1, 2)) / weights.missing**2,
        ]
    )
    each = jnp.sum(error**2, axis=0) + jnp.sum(forces, axis=0)
    each = each / (1.0 + each / weights.fall)
    return jnp.mean(jnp.where(trace.alive, each, weights.fall))


def draw_scenarios(
    config: RunConfig,
    seed: int,
    count: int,
    *,
    speeds: Speeds = (0.0, 0.3),
    pieces: int = 2,
    mass_error: float = 0.1,
    inertia_error: float = 0.2,
    lag: float = 0.005,
    gain: tuple[float, float] = (0.85, 1.0),
    robot: RobotParams | None = None,
) -> Scenario:
    """Random scenarios (count, ...): commands, starts, masses, inertias, noise.

    Ten arguments: what is drawn, and its ranges by keyword.

    Args:
      config: duration, height, rigid body, size of the noise.
      seed: of the draw.
      count: of scenarios.
      speeds: range of the commanded velocities: of v_x; in three dimensions (3,) each, of v_x, v_y
        and yaw rate, or one of them all [m/s, m/s, rad/s].
      pieces: of the command, equally long.
      mass_error: largest relative error of the mass [-].
      inertia_error: largest relative error of the inertia [-].
      lag: longest lag of the forces [s].
      gain: range of the part of a planned force that arrives [-].
      robot: whose plant it is; that of the config if ``None``.
    """
    robot = get_robot(config.robot).params if robot is None else robot
    ranges = Ranges(speeds, pieces, mass_error, inertia_error, lag, gain)
    drawn = plant_of(config).draw(config, robot, np.random.default_rng(seed), count, ranges)
    dtype = jnp.zeros(()).dtype
    return jax.tree.map(
        lambda a: jnp.asarray(a, dtype if jnp.asarray(a).dtype != jnp.uint32 else None), drawn
    )
