"""Samples for EDMD: random SRB rollouts, vmapped over contact modes, or one's own episodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from kjax.dynamics import srb_planar
from kjax.moved import moved_names
from kjax.precision import full_precision
from kjax.types import INPUT_DIM, STATE_DIM

_PIECE = 256  # rollouts that are integrated side by side


@dataclass(frozen=True, kw_only=True)
class DatasetSpec:
    """Random SRB rollouts that models are fitted to, uniform in the ranges given here.

    Attributes:
      rollouts: number of rollouts per contact mode.
      duration: length of a rollout [s].
      dt: Runge-Kutta and snapshot step [s].
      hold: number of steps for which each random force is held.
      height: centre of the sampled heights [m].
      state_range: half-ranges of the initial (p_x, p_z, theta, v_x, v_z, omega)
        [m, rad, m/s, rad/s].
      force_x: half-range of each leg's F_x, body frame [N].
      force_z: range of each leg's F_z, body frame [N].
      feet_range: half-ranges of the contact points' (x, z), where these are measured [m].
    """

    rollouts: int = 100
    duration: float = 0.1
    dt: float = 0.001
    hold: int = 1
    height: float = 0.27
    state_range: tuple[float, ...] = (0.5, 0.1, 0.3, 1.0, 0.5, 2.0)
    force_x: float = 60.0
    force_z: tuple[float, float] = (0.0, 150.0)
    feet_range: tuple[float, float] = (0.12, 0.05)

    @property
    def steps(self) -> int:
        """Number of steps of a rollout."""
        return round(self.duration / self.dt)


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


def sample_ranges(dataset: DatasetSpec, *, vary_feet: bool = False) -> SampleRanges:
    """Sampling ranges of a dataset; ``vary_feet`` spreads the contact points as well."""
    low, high = dataset.force_z
    return SampleRanges(
        state_centre=jnp.array([0.0, dataset.height, 0.0, 0.0, 0.0, 0.0]),
        state_half=jnp.array(dataset.state_range),
        input_low=jnp.array([-dataset.force_x, low] * 2),
        input_high=jnp.array([dataset.force_x, high] * 2),
        feet_half=jnp.array(dataset.feet_range if vary_feet else (0.0, 0.0)),
    )


def shrink(ranges: SampleRanges, scale: Float[Array, ""]) -> SampleRanges:
    """Ranges shrunk by ``scale`` about their own centres."""
    mid = 0.5 * (ranges.input_low + ranges.input_high)
    return ranges._replace(
        state_half=scale * ranges.state_half,
        input_low=mid + scale * (ranges.input_low - mid),
        input_high=mid + scale * (ranges.input_high - mid),
    )


@full_precision
def sample(
    key: PRNGKeyArray,
    params: srb_planar.SrbParams,
    alpha: Float[Array, "2"],
    ranges: SampleRanges,
    *,
    rollouts: int,
    steps: int,
    dt: float,
    hold: int = 1,
) -> Snapshots:
    """Rollouts from random states under random forces, each force held for ``hold`` steps.

    Eight arguments: what is drawn, and how much of it by keyword.

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
    x0 = ranges.state_centre[None] + ranges.state_half[None] * draw[:, :6]
    shift = ranges.feet_half[None, None] * draw[:, 6:10].reshape(rollouts, 2, 2)
    feet = params.feet[None] + shift
    middle = 0.5 * (ranges.input_low + ranges.input_high)
    half = 0.5 * (ranges.input_high - ranges.input_low)
    inputs = middle[None, None] + half[None, None] * draw[:, 10:].reshape(rollouts, pieces, 4)
    inputs = jnp.repeat(inputs, hold, axis=1)[:, :steps]

    def one(x0: Array, inputs: Array, feet: Array) -> Array:
        return srb_planar.rollout(params._replace(feet=feet), alpha, x0, inputs, dt)

    # Many rollouts in pieces that stay in the cache.
    if rollouts > 4 * _PIECE:
        states = jax.lax.map(lambda row: one(*row), (x0, inputs, feet), batch_size=_PIECE)
    else:
        states = jax.vmap(one)(x0, inputs, feet)
    return Snapshots(states=states, inputs=inputs, feet=feet)


def from_episodes(episodes: Sequence[Any], *, window: int = 1) -> Snapshots:
    """Snapshots of recorded episodes of any lengths, one for each of their steps.

        snapshots = from_episodes([(x_1, u_1, feet_1), (x_2, u_2, feet_2)])
        remarks = edmd.check_snapshots(snapshots, dictionary, dt=0.005)
        model, report = edmd.fit(dictionary, snapshots)

    A model is of one contact mode: cut recordings where the contacts change, and give the pieces of
    one mode. Steps must be equally long throughout.

    Args:
      episodes: of each a tuple of states (T + 1, 6) ``[m, rad, m/s, rad/s]``, inputs (T, 4) held
        from each state to the next, per leg in the body frame [N], and contact points (2, 2) or,
        where they move, (T, 2, 2), front and rear, body frame [m]. T may differ between episodes.
      window: states that the dictionary looks at, ``Dictionary.window``.

    Returns:
      Rollouts of ``window`` steps, which overlap where the window is above 1, so that every step
      with its history is in the fit once. Episodes that are shorter are left out.

    Raises:
      ValueError: naming the episode that is none, or if none is long enough.
    """
    if window < 1:
        raise ValueError(f"window must be at least 1, got {window}")
    if not len(episodes):
        raise ValueError("episodes must hold at least one, got none")
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number, episode in enumerate(episodes):
        states, inputs, feet = _episode(number, episode)
        count = len(inputs) - window + 1
        if count > 0:
            first = np.arange(count)[:, None]
            parts.append(
                (
                    states[first + np.arange(window + 1)],
                    inputs[first + np.arange(window)],
                    feet[window - 1 :],
                )
            )
    if not parts:
        raise ValueError(f"episodes: no episode is longer than {window} states")
    return Snapshots(*(jnp.asarray(np.concatenate(a)) for a in zip(*parts, strict=True)))


def _episode(number: int, episode: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (T + 1, 6), inputs (T, 4) and contact points (T, 2, 2) of an episode."""
    if len(episode) != 3:
        raise ValueError(
            f"episodes[{number}] must be a tuple of states, inputs and feet, got {len(episode)} "
            "arrays"
        )
    states, inputs, feet = (np.asarray(a) for a in episode)
    if states.ndim != 2 or states.shape[1] != STATE_DIM:
        raise ValueError(f"episodes[{number}]: states have shape {states.shape}, wanted (T + 1, 6)")
    if inputs.ndim != 2 or inputs.shape[1] != INPUT_DIM:
        raise ValueError(f"episodes[{number}]: inputs have shape {inputs.shape}, wanted (T, 4)")
    if len(states) != len(inputs) + 1:
        raise ValueError(
            f"episodes[{number}] holds {len(states)} states and {len(inputs)} inputs, wanted one "
            "more state than inputs: each input acts from one state to the next"
        )
    if feet.shape == (2, 2):
        feet = np.broadcast_to(feet, (len(inputs), 2, 2))
    if feet.shape != (len(inputs), 2, 2):
        raise ValueError(
            f"episodes[{number}]: feet have shape {feet.shape}, wanted (2, 2) or "
            f"({len(inputs)}, 2, 2)"
        )
    return states, inputs, feet


__getattr__ = moved_names(__name__)
