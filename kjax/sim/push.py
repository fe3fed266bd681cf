"""Pushes on the trunk: an impulse spread evenly over a short time, world frame."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.config import PushConfig


def push_force(
    config: PushConfig, time: Float[Array | np.ndarray, "*batch"], dt: float, xp: Any = jnp
) -> Any:
    """Force (*batch, 3) on the trunk at the beginning of a physics step, world frame [N].

    A push acts in whole steps, and its force is such that their sum is the impulse. Pushes that
    overlap add up.

    Args:
      config: when and how hard.
      time: of the step's beginning [s].
      dt: physics step [s].
      xp: array module to compute with, ``numpy`` or ``jax.numpy``.
    """
    total = xp.zeros((*xp.shape(time), 3))
    steps = round(config.duration / dt)
    for start, forward, lateral in zip(config.times, *impulses(config), strict=True):
        begin = round(start / dt) - 0.5  # half a step, since times are rounded sums
        acts = (time >= begin * dt) & (time < (begin + steps) * dt)
        force = np.array([forward, lateral, 0.0]) / (steps * dt)
        total = total + acts[..., None] * force
    return total


def impulses(config: PushConfig) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Forward and lateral impulse of every push [N s]."""
    count = len(config.times)

    def each(value: float | tuple[float, ...]) -> tuple[float, ...]:
        return value if isinstance(value, tuple) else (value,) * count

    return each(config.forward), each(config.lateral)
