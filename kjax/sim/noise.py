"""Sensor noise, alike on every engine: of a step of an episode, from its seed and number alone.

A random number is the sum of eight bytes of two hashes of seed, stream, step and sensor: integers,
so that NumPy and JAX give the same bits. It is normal but for the far ends (kurtosis -0.15, never
beyond 4.9 standard deviations). JAX's own generator costs as much as all else of a controller's
call. A table to read from costs less still, but XLA spreads that read over its thread pool, and a
batch of LAPACK calls behind it then waits for ever for the thread that it runs on.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.config import NoiseConfig, RunConfig
from kjax.types import Observation

NOISE_DIM = 30  # planar: x, z, pitch; their rates; 12 joint angles; 12 joint rates
FREE_NOISE_DIM = 36  # the same, then: y, roll, yaw; their rates


def noise_dim(base: str) -> int:
    """Length of the noise vector of a base."""
    return FREE_NOISE_DIM if base == "free" else NOISE_DIM


def noise_scale(config: NoiseConfig, base: str = "planar") -> Float[np.ndarray, "noise"]:
    """Standard deviation of each entry of the noise vector (zero where noise is off)."""
    scale = np.concatenate(
        [
            [config.position, config.position, config.pitch],
            [config.velocity, config.velocity, config.pitch_rate],
            np.full(12, config.joint_position),
            np.full(12, config.joint_velocity),
        ]
    )
    if base == "free":
        sideways = [config.position, config.pitch, config.pitch]
        rates = [config.velocity, config.pitch_rate, config.pitch_rate]
        scale = np.concatenate([scale, sideways, rates])
    return scale * config.enabled


SENSORS, FORCES = 1, 2  # streams
_GOLDEN = np.uint32(0x9E3779B9)  # 2^32 over the golden ratio
_MEAN = 8 * 127.5  # of a sum of eight bytes
_SPREAD = float(np.sqrt(8 * (256**2 - 1) / 12))  # its standard deviation


def _mixed(number: Any) -> Any:
    """A hash of 32 bits (the finalizer of MurmurHash3), of NumPy or JAX arrays of uint32."""
    number = (number ^ (number >> 16)) * np.uint32(0x85EBCA6B)
    number = (number ^ (number >> 13)) * np.uint32(0xC2B2AE35)
    return number ^ (number >> 16)


def normal(seed: Any, step: Any, stream: int, count: int, xp: Any = jnp) -> Any:
    """Standard normal numbers (..., count) of steps (...) of an episode, float32.

    Args:
      seed: of the episode, integer.
      step: physics steps, integers (...).
      stream: what they are for.
      count: how many of each step.
      xp: array module to compute with, ``numpy`` or ``jax.numpy``; both give the same.
    """
    with np.errstate(over="ignore"):
        first = xp.asarray(seed).astype(np.uint32) * _GOLDEN + np.uint32(stream)
        place = _mixed(_mixed(first) ^ xp.asarray(step).astype(np.uint32))
        index = xp.arange(1, count + 1).astype(np.uint32) * _GOLDEN
        words = [_mixed(one[..., None] + index) for one in (place, ~place)]
    total = sum((word >> shift) & np.uint32(255) for word in words for shift in (0, 8, 16, 24))
    return (total.astype(np.float32) - np.float32(_MEAN)) * np.float32(1.0 / _SPREAD)


def sensor_noise(config: RunConfig, steps: int, start: int = 0) -> np.ndarray:
    """Noise (steps, n) of an episode from step ``start`` on; n is 30, or 36 for a free base."""
    scale = noise_scale(config.noise, config.sim.base).astype(np.float32)
    numbers = np.arange(start, start + steps)
    return normal(config.seed, numbers, SENSORS, len(scale), np) * scale


def add_noise(observation: Observation, noise: Float[Array, "noise"]) -> Observation:
    """Observation with a noise vector added; zero noise changes nothing.

    The vector's length says which base it is for: 30 for the planar one, whose trunk has no roll
    and no yaw, 36 for the free one.
    """
    if noise.shape[-1] == FREE_NOISE_DIM:
        return _add_free_noise(observation, noise)
    x, z, pitch, v_x, v_z, rate = noise[:6]
    w, _, y, _ = observation.base_quat
    # Nose-up by ``pitch``: a turn about y by -pitch, to first order, then normalised.
    w, y = w + 0.5 * pitch * y, y - 0.5 * pitch * w
    norm = jnp.sqrt(w * w + y * y)
    zero = jnp.zeros_like(w)
    return observation._replace(
        base_pos=observation.base_pos + jnp.stack([x, zero, z]),
        base_quat=jnp.stack([w / norm, zero, y / norm, zero]),
        base_vel=observation.base_vel + jnp.stack([v_x, zero, v_z]),
        base_ang_vel=observation.base_ang_vel + jnp.stack([zero, -rate, zero]),
        joint_pos=observation.joint_pos + noise[6:18].reshape(4, 3),
        joint_vel=observation.joint_vel + noise[18:30].reshape(4, 3),
    )


def _add_free_noise(observation: Observation, noise: Float[Array, "noise"]) -> Observation:
    x, z, pitch, v_x, v_z, rate = noise[:6]
    y, roll, yaw, v_y, roll_rate, yaw_rate = noise[30:]
    # A small turn about the trunk's own axes, to first order, then normalised.
    w, i, j, k = observation.base_quat
    a, b, c = 0.5 * roll, -0.5 * pitch, 0.5 * yaw
    quat = jnp.stack(
        [
            w - i * a - j * b - k * c,
            i + w * a + j * c - k * b,
            j + w * b - i * c + k * a,
            k + w * c + i * b - j * a,
        ]
    )
    return observation._replace(
        base_pos=observation.base_pos + jnp.stack([x, y, z]),
        base_quat=quat / jnp.sqrt(jnp.sum(quat**2)),
        base_vel=observation.base_vel + jnp.stack([v_x, v_y, v_z]),
        base_ang_vel=observation.base_ang_vel + jnp.stack([roll_rate, -rate, yaw_rate]),
        joint_pos=observation.joint_pos + noise[6:18].reshape(4, 3),
        joint_vel=observation.joint_vel + noise[18:30].reshape(4, 3),
    )
