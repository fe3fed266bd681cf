"""The data that benchmark.py edmd fits: drawn by kjax, and by NumPy beside it."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from kjax.config import SrbConfig
from kjax.controllers.rigid_body import own_body
from kjax.dynamics import srb_planar
from kjax.koopman import observables
from kjax.koopman.dataset import DatasetSpec, SampleRanges, Snapshots, sample, sample_ranges
from kjax.robots import get_robot
from kjax.types import GRAVITY, MODE_ALPHA, Mode

PAPER = observables.paper(4)
SEEDS = 10  # data sets
# (order, with the constant rotation): the paper's first, all of them parts of the largest.
DICTIONARIES = tuple((order, constant) for order in (4, 3, 2, 1, 0) for constant in (False, True))
VELOCITIES = slice(3, 6)  # of a state
LOOP = 20  # rollouts of the loop over rollouts and steps; the others by proportion


class Setting(NamedTuple):
    """What the data is drawn from: the trot of the Go1's rigid body in the default ranges."""

    body: srb_planar.SrbParams
    alpha: jax.Array
    ranges: SampleRanges
    rollouts: int
    steps: int
    dt: float


def setting() -> Setting:
    """Trot, Go1, and the ranges that the controller's models are fitted on."""
    dataset, body = DatasetSpec(), own_body(SrbConfig(), get_robot().params)
    return Setting(
        body=jax.tree.map(jnp.asarray, body),
        alpha=jnp.asarray(MODE_ALPHA[Mode.TROT], float),
        ranges=sample_ranges(dataset),
        rollouts=dataset.rollouts,
        steps=dataset.steps,
        dt=dataset.dt,
    )


def sampler(here: Setting, rollouts: int, steps: int) -> Callable[[jax.Array], Snapshots]:
    """Compiled draw of rollouts from a random key."""
    return jax.jit(
        lambda key: sample(
            key, here.body, here.alpha, here.ranges, rollouts=rollouts, steps=steps, dt=here.dt
        )
    )


def numpy_draw(
    rng: np.random.Generator, here: Setting, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Initial states (count, 6) and forces (count, steps, 4) in the ranges of the setting."""
    ranges = jax.tree.map(np.asarray, here.ranges)
    x0 = ranges.state_centre + ranges.state_half * rng.uniform(-1.0, 1.0, (count, 6))
    return x0, rng.uniform(ranges.input_low, ranges.input_high, (count, here.steps, 4))


def numpy_rollouts(
    body: srb_planar.SrbParams, alpha: np.ndarray, x0: np.ndarray, inputs: np.ndarray, dt: float
) -> np.ndarray:
    """Trajectories (rollouts, steps + 1, 6): all rollouts at once, by Runge-Kutta.

    As fast as plain NumPy has it: states in rows, what the step does not change taken once.
    """
    states = np.empty((inputs.shape[1] + 1, 6, len(x0)))
    states[0] = x0.T
    forces = np.ascontiguousarray(inputs.transpose(1, 2, 0)) * np.repeat(alpha, 2)[:, None]
    for t, (x_front, z_front, x_rear, z_rear) in enumerate(forces):
        force_x, force_z = (x_front + x_rear) / body.mass, (z_front + z_rear) / body.mass
        (x_f, z_f), (x_r, z_r) = body.feet
        moment = x_f * z_front - z_f * x_front + x_r * z_rear - z_r * x_rear
        pitch_acceleration = moment / body.inertia
        derivative = partial(_derivative, force_x, force_z, pitch_acceleration)
        states[t + 1] = _rk4(derivative, states[t], dt)
    return states.transpose(2, 0, 1)


def _rk4(derivative: Callable[[np.ndarray], np.ndarray], x: np.ndarray, dt: float) -> np.ndarray:
    k1 = derivative(x)
    k2 = derivative(x + 0.5 * dt * k1)
    k3 = derivative(x + 0.5 * dt * k2)
    k4 = derivative(x + dt * k3)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def _derivative(
    force_x: np.ndarray, force_z: np.ndarray, pitch_acceleration: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Derivative (6, rollouts); forces per mass in the body frame [m/s^2], pitch in [rad/s^2]."""
    out = np.empty_like(x)
    c, s = np.cos(x[2]), np.sin(x[2])
    out[:3] = x[3:]
    out[3] = c * force_x - s * force_z
    out[4] = s * force_x + c * force_z - GRAVITY
    out[5] = pitch_acceleration
    return out


def numpy_loop(
    body: srb_planar.SrbParams, alpha: np.ndarray, x0: np.ndarray, inputs: np.ndarray, dt: float
) -> np.ndarray:
    """The same, one rollout and one step after the other."""
    states = np.empty((len(x0), inputs.shape[1] + 1, 6))
    states[:, 0] = x0
    for path, forces in zip(states, inputs, strict=True):
        for t, u in enumerate(forces):
            force = alpha[:, None] * u.reshape(2, 2)
            total = force.sum(axis=0) / body.mass
            arm = body.feet
            moment = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]).sum()
            derivative = partial(_derivative, total[0], total[1], moment / body.inertia)
            path[t + 1] = _rk4(derivative, path[t], dt)
    return states
