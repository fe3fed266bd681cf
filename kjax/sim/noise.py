"""Sensor noise, alike on every engine: of a step of an episode, from its seed and number alone.

JAX's counter-based generator costs as much as all else of a controller's call in a batch. Integer
hashes cost a quarter of it, and a table to read from less still; but with either two threads of the
batch engine hung in XLA under load, which they have not been seen to do with this generator.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from kjax.sim.episode import EpisodeParams
from kjax.types import Observation

NOISE_DIM = 30  # planar: x, z, pitch; their rates; 12 joint angles; 12 joint rates
FREE_NOISE_DIM = 36  # the same, then: y, roll, yaw; their rates


def noise_dim(base: str) -> int:
    """Length of the noise vector of a base."""
    return FREE_NOISE_DIM if base == "free" else NOISE_DIM


# Streams: of the planar base's sensors, of what a free base has besides, of forces.
_PLANAR, _FREE, _FORCES = 1, 2, 3


def _draw(seed: Any, step: Any, stream: int, count: int) -> Any:
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), stream), step)
    return jax.random.normal(key, (count,), jnp.float32)


def sensor_row(seed: Int[Array, ""], step: Int[Array, ""], base: str) -> Float[Array, "n"]:
    """Standard normal values of an episode's physics step, n of ``noise_dim``, float32."""
    planar = _draw(seed, step, _PLANAR, NOISE_DIM)
    if base == "planar":
        return planar
    return jnp.concatenate([planar, _draw(seed, step, _FREE, FREE_NOISE_DIM - NOISE_DIM)])


def force_row(seed: Int[Array, ""], step: Int[Array, ""]) -> Float[Array, "4"]:
    """The same for forces (front x, z, rear x, z) of the tick that begins at a physics step."""
    return _draw(seed, step, _FORCES, 4)


_sensor_rows = jax.jit(jax.vmap(sensor_row, in_axes=(None, 0, None)), static_argnums=2)
_force_rows = jax.jit(jax.vmap(force_row, in_axes=(None, 0)))


def sensor_noise(params: EpisodeParams, base: str, steps: int, start: int = 0) -> np.ndarray:
    """Noise (steps, n) of an episode from step ``start`` on; n is 30, or 36 for a free base."""
    scale = np.asarray(params.noise_scale)
    if not scale.any():
        return np.zeros((steps, len(scale)), np.float32)
    indices = np.arange(start, start + steps, dtype=np.int32)
    return np.asarray(_sensor_rows(params.seed, indices, base)) * scale


def force_noise(params: EpisodeParams, per_tick: int, ticks: int) -> Float[np.ndarray, "ticks 4"]:
    """Forces [N] that an episode adds at its control ticks, ``per_tick`` physics steps apart."""
    steps = np.arange(ticks, dtype=np.int32) * np.int32(per_tick)
    return np.asarray(_force_rows(params.seed, steps)) * np.float32(params.force_noise)


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
