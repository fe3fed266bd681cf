"""Random SRB rollouts for EDMD: vmapped over rollouts and over contact modes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from kjax import srb
from kjax.config import DatasetConfig

_PIECE = 256  # rollouts that are integrated side by side


class Snapshots(NamedTuple):
    """Rollouts of one contact mode (or stacked over modes on a leading axis).

    Attributes:
      states: (rollouts, steps + 1, 6) ``[m, rad, m/s, rad/s]``.
      inputs: (rollouts, steps, 4) forces per leg, body frame [N].
      feet: (rollouts, 2, 2) contact points (front, rear) that were in force [m].
    """

    states: Float[Array, "rollouts steps_plus_1 6"]
    inputs: Float[Array, "rollouts steps 4"]
    feet: Float[Array, "rollouts 2 2"]


class SampleRanges(NamedTuple):
    """Uniform sampling ranges as arrays, so that a scan over ranges is a ``vmap``.

    Attributes:
      state_centre: (6,) centre of the initial states.
      state_half: (6,) their half-ranges.
      input_low: (4,) lower ends of the forces [N].
      input_high: (4,) upper ends of the forces [N].
      feet_half: (2,) half-ranges of the contact points' x and z [m].
    """

    state_centre: Float[Array, "6"]
    state_half: Float[Array, "6"]
    input_low: Float[Array, "4"]
    input_high: Float[Array, "4"]
    feet_half: Float[Array, "2"]


def ranges_from_config(config: DatasetConfig, *, vary_feet: bool) -> SampleRanges:
    """Sampling ranges of a dataset config; ``vary_feet`` spreads the contact points as well."""
    low, high = config.force_z
    return SampleRanges(
        state_centre=jnp.array([0.0, config.height, 0.0, 0.0, 0.0, 0.0]),
        state_half=jnp.array(config.state_range),
        input_low=jnp.array([-config.force_x, low] * 2),
        input_high=jnp.array([config.force_x, high] * 2),
        feet_half=jnp.array(config.feet_range if vary_feet else (0.0, 0.0)),
    )


def shrink(ranges: SampleRanges, scale: Float[Array, ""]) -> SampleRanges:
    """Ranges shrunk by ``scale`` about their own centres."""
    mid = 0.5 * (ranges.input_low + ranges.input_high)
    return ranges._replace(
        state_half=scale * ranges.state_half,
        input_low=mid + scale * (ranges.input_low - mid),
        input_high=mid + scale * (ranges.input_high - mid),
    )


def sample(
    key: PRNGKeyArray,
    params: srb.SrbParams,
    alpha: Float[Array, "2"],
    ranges: SampleRanges,
    *,
    rollouts: int,
    steps: int,
    dt: float,
    hold: int = 1,
) -> Snapshots:
    """Rollouts from random states under random forces, each force held for ``hold`` steps.

    Args:
      key: random key.
      params: body parameters; its contact points are the centre of the sampled ones.
      alpha: (2,) stance legs at front and rear.
      ranges: uniform ranges.
      rollouts: number of rollouts.
      steps: steps per rollout.
      dt: Runge-Kutta step [s].
      hold: number of steps per random force.
    """
    # One draw for everything: each call of the generator costs seconds of compilation.
    pieces = -(-steps // hold)
    draw = jax.random.uniform(key, (rollouts, 6 + 4 + 4 * pieces), minval=-1.0, maxval=1.0)
    x0 = ranges.state_centre + ranges.state_half * draw[:, :6]
    feet = params.feet + ranges.feet_half * draw[:, 6:10].reshape(rollouts, 2, 2)
    middle = 0.5 * (ranges.input_low + ranges.input_high)
    half = 0.5 * (ranges.input_high - ranges.input_low)
    inputs = middle + half * draw[:, 10:].reshape(rollouts, pieces, 4)
    inputs = jnp.repeat(inputs, hold, axis=1)[:, :steps]

    def one(x0: Array, inputs: Array, feet: Array) -> Array:
        return srb.rollout(params._replace(feet=feet), alpha, x0, inputs, dt)

    # Many rollouts in pieces that stay in the cache.
    if rollouts > 4 * _PIECE:
        states = jax.lax.map(lambda row: one(*row), (x0, inputs, feet), batch_size=_PIECE)
    else:
        states = jax.vmap(one)(x0, inputs, feet)
    return Snapshots(states=states, inputs=inputs, feet=feet)
