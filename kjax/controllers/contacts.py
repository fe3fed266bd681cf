"""Swings that begin and end with the gait's phases, and the ground below the stance feet."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax import gait
from kjax.controllers.params import ControllerParams
from kjax.controllers.state import ControllerState
from kjax.legs import swing


def next_swings(
    params: ControllerParams,
    state: ControllerState,
    clock: gait.Clock,
    stance: Bool[Array, "4"],
    flags: Bool[Array, "4"],
    feet: Float[Array, "4 d"],
) -> swing.SwingState:
    """Swings after the clock has moved on: begun, ended, or given another time to come down."""
    switched = clock.gait != state.clock.gait
    lifting = state.stance & ~stance
    # A new gait gives legs that are in the air already another time to come down.
    retimed = ~stance & switched
    remaining = gait.time_to_touchdown(params.schedule, clock)
    swings = swing.begin_swings(state.swing, lifting | retimed, feet, remaining)
    interrupted = stance & ~state.stance & switched
    return swing.end_swings(params.swing, swings, stance, interrupted, flags, feet)


def mean_height(
    heights: Float[Array, "4"], stance: Bool[Array, "4"], otherwise: Float[Array, ""]
) -> Float[Array, ""]:
    """Mean height of the stance feet [m]; ``otherwise`` where none stands."""
    count = jnp.sum(stance)
    total = jnp.sum(jnp.where(stance, heights, 0.0))
    return jnp.where(count > 0, total / jnp.maximum(count, 1), otherwise)
