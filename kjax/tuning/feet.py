"""The feet of the differentiable loop: where they stand, come down and swing; (4, 2) world [m]."""

import jax.numpy as jnp
from jaxtyping import Array

from kjax import gait
from kjax.controllers.params import ControllerParams
from kjax.controllers.reference import next_clock
from kjax.controllers.state import ControllerState
from kjax.legs import swing
from kjax.legs.kinematics import PlanarState
from kjax.tuning.plant import PlantParams, view


def standing_feet(params: ControllerParams, plant: PlantParams, x: Array) -> Array:
    """Feet (4, 2) of the robot before its first step: where they stand still."""
    settings = swing.for_gait(params.swing, params.gaits[0])
    along = x[0] - plant.com[0] + params.robot.hip_pos[:, 0] + settings.offset
    return jnp.stack([along, jnp.full_like(along, params.robot.foot_radius)], axis=1)


def touch_down(
    params: ControllerParams,
    state: ControllerState,
    plant: PlantParams,
    feet: Array,
    x: Array,
    dt: float,
) -> Array:
    """Feet (4, 2) with those at their footholds whose stance begins now."""
    clock = next_clock(params, state, dt)
    where = (clock.gait, clock.phase)
    landing = params.schedule.stance[where] & ~state.stance
    robot = params.robot
    along = swing.foothold(
        robot,
        swing.for_gait(params.swing, clock.gait),
        view(robot, plant.com, x, feet).planar,
        jnp.zeros((4,), x.dtype),
        params.schedule.stance_time[where],
        state.velocity[0] + state.correction[0],
    )
    place = jnp.stack([along, jnp.full_like(along, robot.foot_radius)], axis=1)
    return jnp.where(landing[:, None], place, feet)


def swing_feet(
    params: ControllerParams, state: ControllerState, body: PlanarState, feet: Array, dt: float
) -> tuple[Array, Array, ControllerState]:
    """Feet (4, 2) and their velocities, those in the air on their way; the controller's ``act``."""
    robot, clock = params.robot, state.clock
    settings = swing.for_gait(params.swing, clock.gait)
    along = swing.foothold(
        robot,
        settings,
        body,
        gait.time_to_touchdown(params.schedule, clock),
        params.schedule.stance_time[clock.gait, clock.phase],
        state.velocity[0] + state.correction[0],
    )
    target = jnp.stack([along, jnp.full_like(along, robot.foot_radius)], axis=1)
    # The controller keeps lift-off points relative to the trunk; here everything is in the world.
    place, rate = swing.foot_path(settings, state.swing, target - body.base)
    standing = state.stance[:, None]
    swings = swing.advance(state.swing, ~state.stance, dt)
    next_feet = jnp.where(standing, feet, place + body.base)
    motion = dt * body.base_vel
    next_state = state._replace(
        swing=swing.carry_along(swings, motion), ground=state.ground - motion[-1]
    )
    return next_feet, jnp.where(standing, 0.0, rate), next_state
