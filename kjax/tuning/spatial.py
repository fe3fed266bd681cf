"""The plant in three dimensions in the closed loop: ticks, what the cost sees, random scenarios."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from kjax.config import RunConfig
from kjax.config.gaits import gait_setting
from kjax.config.units import in_si
from kjax.controllers.acting import ground_after, velocity_wanted
from kjax.controllers.command import PITCH, ROLL, V_X, V_Y, YAW_RATE
from kjax.controllers.controller import Controller
from kjax.controllers.params import ControllerParams
from kjax.controllers.reference import command_now, next_clock
from kjax.controllers.rigid_body import body_numbers
from kjax.controllers.state import ControllerState
from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, SpatialBody
from kjax.legs import lateral, spatial, swing
from kjax.legs.base import Footing, View, build_base
from kjax.tuning import spatial_plant
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
from kjax.tuning.plant import lagged
from kjax.tuning.spatial_plant import SpatialPlantParams, nominal_spatial_plant
from kjax.types import COMMAND_NAMES, Command, RobotParams

DRAWN = (V_X, V_Y, YAW_RATE)  # columns of random commands; the others are 0
_BASE = build_base("free", spatial_forces=True)


class _Carry(NamedTuple):
    body: BodyState
    feet: Array
    state: ControllerState
    force: Array  # at the end of the last tick, before what joints and ground keep back
    velocity: Array  # (3,) references of v_x, v_y and yaw rate: the command at bounded rates
    alive: Array


def _start(controller: Controller, run: Run) -> _Carry:
    params, tables, scenario, _ = run
    body, plant = scenario.x, scenario.plant
    feet = _standing_feet(params, plant, body)
    quiet = jnp.zeros((spatial_plant.NOISE_DIM,), feet.dtype)
    seen = spatial_plant.measure(params.robot, plant, body, feet, quiet)
    state = controller.init_from(tables, seen)
    none = jnp.zeros_like(feet)
    return _Carry(body, feet, state, none, none[0], jnp.ones((), bool))


def _standing_feet(
    params: ControllerParams, plant: SpatialPlantParams, body: BodyState
) -> Float[Array, "4 3"]:
    """Feet of the robot before its first step, which looks along x: below the hips."""
    robot = params.robot
    settings = swing.for_gait(params.swing, params.gaits[0])
    place = robot.hip_pos[:, :2] + (body.p - plant.com)[None, :2]
    place = place + jnp.stack([settings.offset, robot.abduction_offset], axis=-1)
    return jnp.concatenate([place, jnp.full_like(place[:, :1], robot.foot_radius)], axis=1)


def _build_tick(
    controller: Controller, fade: Callable[[Any], Any]
) -> Callable[[Run, _Carry, Array], tuple[_Carry, Trace]]:
    """A control tick: measure, plan, swing, press, and one step of the body."""
    dt = controller.control_dt

    def tick(run: Run, carry: _Carry, number: Array) -> tuple[_Carry, Trace]:
        params, tables, scenario, key = run
        robot, plant = params.robot, scenario.plant
        body, state = carry.body, carry.state
        error = scenario.noise * jax.random.normal(
            jax.random.fold_in(key, number), (spatial_plant.NOISE_DIM,), body.p.dtype
        )
        velocity = _next_velocity(params, state, carry.velocity, dt)
        base = spatial_plant.trunk_origin(plant, body)
        seen = spatial_plant.measure(robot, plant, body, carry.feet, error)
        always = jnp.ones((), bool)
        state, info = controller.plan_from(tables, state, seen, state.stance, always)
        target = _footholds(params, state, seen) + base
        feet = _swing_feet(params, state, target, base, carry.feet)
        before = carry.force * state.stance[:, None]
        pressed, reached = lagged(plant.lag, before, state.force, dt)
        force = spatial_plant.feasible(robot, plant, body, seen, pressed)
        next_body = spatial_plant.advance(robot, plant, state.stance, body, feet, force, dt)
        alive = carry.alive & _upright(next_body)
        record = Trace(
            x=_observed(plant, body),
            wanted=_wanted(params, state, velocity),
            feet=feet,
            stance=state.stance,
            mode=info.mode,
            force=force,
            missing=pressed - force,
            status=info.status,
            alive=carry.alive,
        )
        now = fade(jax.tree.map(lambda a, b: jnp.where(alive, a, b), next_body, body))
        state = _carry_on(state, seen, spatial_plant.trunk_origin(plant, now) - base, dt)
        feet = _touch_down(params, state, target, feet, dt)
        return _Carry(now, feet, state, reached, velocity, alive), record

    return tick


def _next_velocity(
    params: ControllerParams, state: ControllerState, velocity: Float[Array, "3"], dt: float
) -> Float[Array, "3"]:
    """The command's velocities at bounded rates, whatever the robot does [m/s, m/s, rad/s]."""
    assert params.spatial is not None  # the parameters are those of the spatial controller
    wanted = command_now(params, state)[jnp.asarray(DRAWN)]
    rates = jnp.stack([params.command_slew, params.command_slew, params.spatial.slew])
    return velocity + jnp.clip(wanted - velocity, -rates * dt, rates * dt)


def _footholds(params: ControllerParams, state: ControllerState, seen: View) -> Float[Array, "4 3"]:
    """Next footholds, foot centres from the trunk's origin; the controller's ``act`` [m]."""
    clock, slope, swings = state.clock, state.slope, state.swing
    assert slope is not None  # the spatial controller's state has it
    return _BASE.foothold(
        params.robot,
        swing.for_gait(params.swing, clock.gait),
        lateral.for_gait(params.lateral, clock.gait),
        seen,
        Footing(
            remaining=jnp.maximum(swings.duration - swings.elapsed, 0.0),
            stance_time=params.schedule.stance_time[clock.gait, clock.phase],
            velocity=velocity_wanted(state),
            ground=state.ground,
            slope=slope.slope,
        ),
    )


def _swing_feet(
    params: ControllerParams,
    state: ControllerState,
    target: Float[Array, "4 3"],
    base: Float[Array, "3"],
    feet: Float[Array, "4 3"],
) -> Float[Array, "4 3"]:
    """Feet with those in the air on their way to their targets; world [m]."""
    settings = swing.for_gait(params.swing, state.clock.gait)
    place, _ = swing.foot_path(settings, state.swing, target - base)
    return jnp.where(state.stance[:, None], feet, place + base)


def _touch_down(
    params: ControllerParams,
    state: ControllerState,
    target: Float[Array, "4 3"],
    feet: Float[Array, "4 3"],
    dt: float,
) -> Float[Array, "4 3"]:
    """Feet with those at their targets, on level ground, whose stance begins next; world [m]."""
    clock = next_clock(params, state, dt)
    landing = params.schedule.stance[clock.gait, clock.phase] & ~state.stance
    return jnp.where(landing[:, None], target.at[:, 2].set(params.robot.foot_radius), feet)


def _carry_on(
    state: ControllerState, seen: View, motion: Float[Array, "3"], dt: float
) -> ControllerState:
    """The controller's state after a tick, its local frame moved on with the trunk."""
    ground, slope = ground_after(state, motion)
    return state._replace(
        swing=swing.carry_along(swing.advance(state.swing, ~state.stance, dt), motion),
        ground=ground,
        slope=slope,
        feet=seen.feet - motion,
        base_vel=seen.base_vel,
    )


def _upright(body: BodyState) -> Bool[Array, ""]:
    low, high = HEIGHTS
    return (body.R[2, 2] > np.cos(MAX_TILT)) & (body.p[2] > low) & (body.p[2] < high)


def _observed(plant: SpatialPlantParams, body: BodyState) -> Float[Array, "12"]:
    """A ``Trace``'s x."""
    angles = rotations.trunk_angles(body.R)
    heading = jnp.stack([jnp.cos(angles[2]), jnp.sin(angles[2])])
    omega = srb_spatial.angular_velocity(plant.body, body.R, body.L)
    moving = spatial.rotate_back(heading, jnp.stack([omega, body.v])).reshape(-1)
    return jnp.concatenate([angles, body.p, moving])


def _wanted(
    params: ControllerParams, state: ControllerState, velocity: Float[Array, "3"]
) -> Float[Array, "6"]:
    """What is asked, order of ``types.COMMAND_NAMES``, the height from the ground."""
    height = params.height[state.clock.gait] + state.height
    return jnp.concatenate(
        [velocity, jnp.stack([height, state.command[ROLL], state.command[PITCH]])]
    )


def _errors(trace: Trace, weights: CostWeights) -> Array:
    """Errors (6, T) of v_x, v_y, yaw rate, roll, pitch and height."""
    roll, pitch, height = trace.x[:, 0], trace.x[:, 1], trace.x[:, 5]
    yaw_rate, v_x, v_y = trace.x[:, 8], trace.x[:, 9], trace.x[:, 10]
    is_so = jnp.stack([v_x, v_y, yaw_rate, height, roll, pitch])  # order of the command
    unit = jnp.stack(
        [
            jnp.asarray(one, trace.x.dtype)
            for one in (
                weights.velocity, weights.velocity, weights.yaw_rate, weights.height,
                weights.pitch, weights.pitch,
            )
        ]
    )  # fmt: skip
    return (is_so - trace.wanted.T) / unit[:, None]


def _draw(
    config: RunConfig, robot: RobotParams, rng: np.random.Generator, count: int, ranges: Ranges
) -> Scenario:
    noise = noise_of(config)
    mass, pitch_inertia = body_numbers(config, robot)
    inertia = robot.inertia * (pitch_inertia / robot.pitch_inertia)
    nominal = nominal_spatial_plant(robot, SpatialBody(mass, inertia), config.sim.friction)

    def uniform(size: float) -> np.ndarray:
        return 1.0 + rng.uniform(-size, size, count)

    bodies = SpatialBody(
        mass=mass * uniform(ranges.mass_error),
        inertia=inertia * uniform(ranges.inertia_error)[:, None, None],
    )
    plants = SpatialPlantParams(
        body=bodies,
        com=jnp.broadcast_to(nominal.com, (count, 3)),
        friction=jnp.broadcast_to(nominal.friction, (count,)),
        lag=rng.uniform(0.0, ranges.lag, count),  # type: ignore[arg-type]
        gain=rng.uniform(*ranges.gain, count),  # type: ignore[arg-type]
    )
    tilt, velocity, rate = (
        size * rng.normal(size=(count, 3))
        for size in (noise.initial_pitch, noise.initial_velocity, noise.initial_pitch_rate)
    )
    tilt[:, 2] = 0.0  # every heading is alike
    R = rotations.exp(jnp.asarray(tilt))
    height = gait_setting(in_si(config, robot), config.gait.names[0], "body_height")
    start = BodyState(
        p=jnp.broadcast_to(jnp.array([0.0, 0.0, height]), (count, 3)),
        R=R,
        v=velocity,  # type: ignore[arg-type]
        L=jax.vmap(srb_spatial.momentum)(bodies, R, jnp.asarray(rate)),
    )
    drawn = rng.uniform(*ranges.speeds, (count, ranges.pieces, len(DRAWN)))
    values = np.zeros((count, ranges.pieces, len(COMMAND_NAMES)))
    values[..., list(DRAWN)] = drawn
    scale = np.repeat([noise.pitch, noise.velocity, noise.pitch_rate], 3)
    return Scenario(
        command=Command(
            times=piece_times(config, count, ranges.pieces),  # type: ignore[arg-type]
            values=values,  # type: ignore[arg-type]
        ),
        x=start,
        plant=plants,
        noise=np.broadcast_to(scale, (count, len(scale))),  # type: ignore[arg-type]
        key=rng.integers(0, 2**32, (count, 2), dtype=np.uint32),  # type: ignore[arg-type]
    )


SPATIAL = Plant(start=_start, build_tick=_build_tick, errors=_errors, draw=_draw, v_x=9, pitch=1)
