"""A differentiable closed loop: the controller's own ``plan`` on the rigid body, over seconds.

    x_{t+1} = plant(x_t, feet_t, u_t),   u_t = argmin QP(x_t + noise, params),   t = 0 .. T - 1

A run is a pure function of the controller's parameters and a scenario. Stances, flights and
touchdown times come from the schedule; where a foot comes down follows from the state. Derivatives
go through all of it, the QPs' active sets as they are. Reverse mode keeps the states at the
beginnings of some sqrt(T) segments and computes each segment again.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import ceil, exp, inf, sqrt
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from kjax.config import NoiseConfig, RunConfig
from kjax.config.gaits import gait_setting
from kjax.config.units import in_si
from kjax.controllers.controller import Controller, build_controller
from kjax.controllers.params import ControllerParams, Tables, condense
from kjax.controllers.resolve import controller_spec
from kjax.controllers.rigid_body import body_numbers
from kjax.controllers.state import ControllerState
from kjax.robots import get_robot
from kjax.tuning import plant as body_plant
from kjax.tuning.feet import standing_feet, swing_feet, touch_down
from kjax.tuning.plant import PlantParams
from kjax.types import COMMAND_NAMES, GRAVITY, STATE_DIM, Command, RobotParams

# A body beyond these has fallen: what it does then is of no interest, and it is held still.
MAX_PITCH = 1.0  # rad
HEIGHTS = (0.10, 0.50)  # m


class Scenario(NamedTuple):
    """What a run meets; a leading axis makes a batch of them.

    Attributes:
      command: what is asked over time.
      x: (6,) start of the body [m, rad, m/s, rad/s].
      plant: its parameters.
      noise: (6,) standard deviation of what is measured of x [m, rad, m/s, rad/s].
      key: of the noise, key data.
    """

    command: Command
    x: Float[Array, "6"]
    plant: PlantParams
    noise: Float[Array, "6"]
    key: UInt32[Array, "2"]


class Trace(NamedTuple):
    """A run, at the beginning of each control tick.

    Attributes:
      x: (T, 6) state [m, rad, m/s, rad/s].
      wanted: (T, 2) reference of v_x [m/s] and mean height [m].
      feet: (T, 4, 2) feet, world [m].
      stance: (T, 4) legs that stand.
      mode: (T,) contact mode.
      force: (T, 4, 2) force of each leg on the body, body frame [N].
      missing: (T, 4, 2) what joints and ground kept back of the planned ones [N].
      status: (T,) of the QPs.
      alive: (T,) whether the body has not fallen yet.
    """

    x: Float[Array, "T 6"]
    wanted: Float[Array, "T 2"]
    feet: Float[Array, "T 4 2"]
    stance: Bool[Array, "T 4"]
    mode: Int[Array, "T"]
    force: Float[Array, "T 4 2"]
    missing: Float[Array, "T 4 2"]
    status: Int[Array, "T"]
    alive: Bool[Array, "T"]


Loop = Callable[[ControllerParams, Scenario], Trace]


class _Carry(NamedTuple):
    x: Array
    feet: Array
    state: ControllerState
    force: Array  # at the end of the last tick, before what joints and ground keep back
    spin: Array  # angular momentum of the legs
    alive: Array


def build_loop(config: RunConfig, *, segment: int | None = None, memory: float = inf) -> Loop:
    """The closed loop of a config, ``config.duration`` long.

    A loop that is unstable over some ticks, a saturated limit cycle say, has derivatives that grow
    with the run's length without end, true and of no use. ``memory`` fades what goes back through
    the body's state: values stay as they are, derivatives are those of the last so many seconds.

    Args:
      config: of the controller; what concerns MuJoCo (sim, terrain, push, lateral) has no effect.
      segment: control ticks between two states that reverse mode keeps; about sqrt(T) if ``None``.
      memory: time in which the derivative through the state fades to 1/e; inf for the true one [s].

    Raises:
      ValueError: for a free base: the plant is planar.
    """
    if config.sim.base != "planar":
        raise ValueError(f"sim.base must be 'planar' here, got '{config.sim.base}'")
    # A tableau carried from tick to tick would be kept for every one of them.
    spec = replace(controller_spec(config), warm_start=False)
    controller = build_controller(spec)
    dt = spec.control_dt
    ticks = max(1, round(config.duration / dt))
    segment = ceil(sqrt(ticks)) if segment is None else min(segment, ticks)
    if segment < 1:
        raise ValueError(f"segment must be at least 1, got {segment}")
    if not memory > 0:
        raise ValueError(f"memory must be above 0 s, got {memory}")
    segments = -(-ticks // segment)
    step = _build_tick(controller, dt, memory)

    def run(params: ControllerParams, scenario: Scenario) -> Trace:
        params = params._replace(command=scenario.command)
        tables = condense(spec, params)
        plant = scenario.plant
        own = _Run(params, tables, scenario, jax.random.wrap_key_data(scenario.key))

        def stretch(carry: _Carry, indices: Array) -> tuple[_Carry, Trace]:
            return jax.lax.scan(partial(step, own), carry, indices)

        indices = np.arange(segments * segment, dtype=np.int32).reshape(segments, segment)
        feet = standing_feet(params, plant, scenario.x)
        state = controller.init_from(
            tables, body_plant.local_view(params.robot, plant.com, scenario.x, feet)
        )
        none = jnp.zeros_like(feet)
        first = _Carry(scenario.x, feet, state, none, none[0, 0], jnp.ones((), bool))
        _, trace = jax.lax.scan(jax.checkpoint(stretch), first, indices)
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:ticks], trace)

    return run


class _Run(NamedTuple):
    """What stays the same over a run."""

    params: ControllerParams
    tables: Tables
    scenario: Scenario
    key: PRNGKeyArray


def _build_tick(
    controller: Controller, dt: float, memory: float
) -> Callable[[_Run, _Carry, Array], tuple[_Carry, Trace]]:
    """A control tick: measure, plan, swing, press, and one step of the body.

    Args:
      controller: whose ``plan`` it is.
      dt: length of a tick [s].
      memory: see ``build_loop`` [s].
    """
    keep = exp(-dt / memory)

    def fade(x: Array) -> Array:
        return x if keep == 1.0 else keep * x + (1.0 - keep) * jax.lax.stop_gradient(x)

    def tick(run: _Run, carry: _Carry, number: Array) -> tuple[_Carry, Trace]:
        params, tables, scenario, key = run
        robot, plant = params.robot, scenario.plant
        x, state = carry.x, carry.state
        error = scenario.noise * jax.random.normal(
            jax.random.fold_in(key, number), (STATE_DIM,), x.dtype
        )
        feet = touch_down(params, state, plant, carry.feet, x.at[2:].add(error[2:]), dt)
        measured = x.at[2:].add(error[2:])
        seen = body_plant.local_view(robot, plant.com, measured, feet)
        always = jnp.ones((), bool)
        state, info = controller.plan_from(tables, state, seen, state.stance, always)
        true = body_plant.view(robot, plant.com, x, feet).planar
        feet, rates, state = swing_feet(params, state, true, feet, dt)
        spin = body_plant.leg_momentum(robot, plant, true, feet, rates)
        # What the legs gain the trunk loses; at the first tick they are as they are.
        turns = (number > 0) & carry.alive
        x = x.at[5].add(jnp.where(turns, carry.spin - spin, 0.0) / plant.inertia)
        before = carry.force * state.stance[:, None]
        planned = state.force[:, ::2] @ seen.planar.rotation
        pressed, reached = body_plant.follow(plant, before, planned, dt)
        force = body_plant.feasible(robot, plant, true, pressed)
        sole = jnp.stack([jnp.zeros_like(robot.foot_radius), robot.foot_radius])
        next_x = body_plant.advance(plant, state.stance, x, feet - sole, force, dt)
        alive = carry.alive & _upright(next_x)
        record = Trace(
            x=x,
            wanted=jnp.stack([state.velocity[0], params.height[state.clock.gait] + state.height]),
            feet=feet,
            stance=state.stance,
            mode=info.mode,
            force=force,
            missing=pressed - force,
            status=info.status,
            alive=carry.alive,
        )
        now = fade(jnp.where(alive, next_x, x))
        return _Carry(now, feet, state, reached, spin, alive), record

    return tick


def _upright(x: Array) -> Array:
    low, high = HEIGHTS
    return (jnp.abs(x[2]) < MAX_PITCH) & (x[1] > low) & (x[1] < high)


class CostWeights(NamedTuple):
    """What one unit of the cost is.

    The cost is the mean over time of e / (1 + e / fall), e the sum of the squares of these: near e
    while the robot walks, and no state costs more than a fall.

    Attributes:
      velocity: error of v_x [m/s].
      pitch: trunk's pitch from level [rad].
      height: of the centre of mass from its mean [m].
      effort: forces of all legs, root of the sum of squares, in weights of the robot [-].
      missing: force that joints or ground kept back, likewise [-].
      fall: cost of every tick after a fall [-].
    """

    velocity: float = 0.05
    pitch: float = 0.05
    height: float = 0.02
    effort: float = 5.0
    missing: float = 0.2
    fall: float = 100.0


def cost(robot: RobotParams, trace: Trace, weights: CostWeights = CostWeights()) -> Array:  # noqa: B008
    """Cost of a run: tracking, pitch, height, effort, saturation, falls; see ``CostWeights``."""
    weight = robot.mass * GRAVITY
    error = jnp.stack(
        [
            (trace.x[:, 3] - trace.wanted[:, 0]) / weights.velocity,
            trace.x[:, 2] / weights.pitch,
            (trace.x[:, 1] - trace.wanted[:, 1]) / weights.height,
        ]
    )
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
    speeds: tuple[float, float] = (0.0, 0.3),
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
      speeds: range of the commanded velocities [m/s].
      pieces: of the command, equally long.
      mass_error: largest relative error of the mass [-].
      inertia_error: largest relative error of the inertia [-].
      lag: longest lag of the forces [s].
      gain: range of the part of a planned force that arrives [-].
      robot: whose plant it is; that of the config if ``None``.
    """
    robot = get_robot(config.robot).params if robot is None else robot
    rng = np.random.default_rng(seed)
    noise = config.noise if config.noise.enabled else _silent()
    height = gait_setting(in_si(config, robot), config.gait.names[0], "body_height")
    times = np.arange(pieces) * config.duration / pieces
    mass, inertia = body_numbers(config, robot)
    nominal = body_plant.nominal_plant(robot, mass, inertia, config.sim.friction)

    def uniform(size: float) -> np.ndarray:
        return 1.0 + rng.uniform(-size, size, count)

    x = np.zeros((count, STATE_DIM))
    spread = [0, 0, noise.initial_pitch, *[noise.initial_velocity] * 2, noise.initial_pitch_rate]
    x = x + rng.normal(size=x.shape) * np.asarray(spread)
    x[:, 1] += height
    scale = [*[noise.position] * 2, noise.pitch, *[noise.velocity] * 2, noise.pitch_rate]
    plants = PlantParams(
        mass=nominal.mass * uniform(mass_error),
        inertia=nominal.inertia * uniform(inertia_error),
        com=jnp.broadcast_to(nominal.com, (count, 2)),
        friction=jnp.broadcast_to(nominal.friction, (count,)),
        lag=rng.uniform(0.0, lag, count),  # type: ignore[arg-type]
        gain=rng.uniform(*gain, count),  # type: ignore[arg-type]
        link_inertia=jnp.broadcast_to(nominal.link_inertia, (count, 2)),
        spin=jnp.broadcast_to(nominal.spin, (count,)),
    )
    drawn = Scenario(
        command=Command(
            times=np.broadcast_to(times, (count, pieces)),  # type: ignore[arg-type]
            values=_forward(rng.uniform(*speeds, (count, pieces))),  # type: ignore[arg-type]
        ),
        x=x,
        plant=plants,
        noise=np.broadcast_to(np.asarray(scale, float), (count, STATE_DIM)),  # type: ignore[arg-type]
        key=rng.integers(0, 2**32, (count, 2), dtype=np.uint32),  # type: ignore[arg-type]
    )
    dtype = jnp.zeros(()).dtype
    return jax.tree.map(
        lambda a: jnp.asarray(a, dtype if jnp.asarray(a).dtype != jnp.uint32 else None), drawn
    )


def _forward(speeds: np.ndarray) -> np.ndarray:
    """Values (..., 6) of commands that ask for a forward velocity only [m/s]."""
    return speeds[..., None] * (np.arange(len(COMMAND_NAMES)) == COMMAND_NAMES.index("v_x"))


def _silent() -> NoiseConfig:
    zero = {name: 0.0 for name in NoiseConfig.__dataclass_fields__ if name != "enabled"}
    return NoiseConfig(**zero)  # type: ignore[arg-type]
