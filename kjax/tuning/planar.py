"""The planar plant in the closed loop: its ticks, what the cost sees of it, random scenarios."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from kjax.config import RunConfig
from kjax.config.gaits import gait_setting
from kjax.config.units import in_si
from kjax.controllers.controller import Controller
from kjax.controllers.rigid_body import body_numbers
from kjax.controllers.state import ControllerState
from kjax.tuning import plant as body_plant
from kjax.tuning.contract import (
    HEIGHTS,
    MAX_TILT,
    CostWeights,
    Plant,
    Ranges,
    Run,
    Scenario,
    Trace,
    noise_of,
    piece_times,
)
from kjax.tuning.feet import standing_feet, swing_feet, touch_down
from kjax.tuning.plant import PlantParams
from kjax.types import COMMAND_NAMES, STATE_DIM, Command, RobotParams


class _Carry(NamedTuple):
    x: Array
    feet: Array
    state: ControllerState
    force: Array  # at the end of the last tick, before what joints and ground keep back
    spin: Array  # angular momentum of the legs
    alive: Array


def _start(controller: Controller, run: Run) -> _Carry:
    params, tables, scenario, _ = run
    plant = scenario.plant
    feet = standing_feet(params, plant, scenario.x)
    state = controller.init_from(
        tables, body_plant.local_view(params.robot, plant.com, scenario.x, feet)
    )
    none = jnp.zeros_like(feet)
    return _Carry(scenario.x, feet, state, none, none[0, 0], jnp.ones((), bool))


def _build_tick(
    controller: Controller, fade: Callable[[Any], Any]
) -> Callable[[Run, _Carry, Array], tuple[_Carry, Trace]]:
    """A control tick: measure, plan, swing, press, and one step of the body."""
    dt = controller.control_dt

    def tick(run: Run, carry: _Carry, number: Array) -> tuple[_Carry, Trace]:
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
    return (jnp.abs(x[2]) < MAX_TILT) & (x[1] > low) & (x[1] < high)


def _errors(trace: Trace, weights: CostWeights) -> Array:
    """Errors (3, T) of velocity, pitch and height."""
    return jnp.stack(
        [
            (trace.x[:, 3] - trace.wanted[:, 0]) / weights.velocity,
            trace.x[:, 2] / weights.pitch,
            (trace.x[:, 1] - trace.wanted[:, 1]) / weights.height,
        ]
    )


def _draw(
    config: RunConfig, robot: RobotParams, rng: np.random.Generator, count: int, ranges: Ranges
) -> Scenario:
    noise = noise_of(config)
    height = gait_setting(in_si(config, robot), config.gait.names[0], "body_height")
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
        mass=nominal.mass * uniform(ranges.mass_error),
        inertia=nominal.inertia * uniform(ranges.inertia_error),
        com=jnp.broadcast_to(nominal.com, (count, 2)),
        friction=jnp.broadcast_to(nominal.friction, (count,)),
        lag=rng.uniform(0.0, ranges.lag, count),  # type: ignore[arg-type]
        gain=rng.uniform(*ranges.gain, count),  # type: ignore[arg-type]
        link_inertia=jnp.broadcast_to(nominal.link_inertia, (count, 2)),
        spin=jnp.broadcast_to(nominal.spin, (count,)),
    )
    return Scenario(
        command=Command(
            times=piece_times(config, count, ranges.pieces),  # type: ignore[arg-type]
            values=_forward(rng.uniform(*ranges.speeds, (count, ranges.pieces))),  # type: ignore[arg-type]
        ),
        x=x,
        plant=plants,
        noise=np.broadcast_to(np.asarray(scale, float), (count, STATE_DIM)),  # type: ignore[arg-type]
        key=rng.integers(0, 2**32, (count, 2), dtype=np.uint32),  # type: ignore[arg-type]
    )


def _forward(speeds: np.ndarray) -> np.ndarray:
    """Values (..., 6) of commands that ask for a forward velocity only [m/s]."""
    return speeds[..., None] * (np.arange(len(COMMAND_NAMES)) == COMMAND_NAMES.index("v_x"))


PLANAR = Plant(start=_start, build_tick=_build_tick, errors=_errors, draw=_draw, v_x=3, pitch=2)
