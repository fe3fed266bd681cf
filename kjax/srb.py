"""Planar single rigid body with forces at the front and the rear feet (Eqs. 1-2 of the paper).

    p'' = R(theta) (alpha_f F_f + alpha_r F_r) / m - g
    theta'' = (r_f x alpha_f F_f + r_r x alpha_r F_r) / I

The forces F and the foot positions r are in the *body* frame, as in the paper; alpha counts the
stance legs at each end and so selects the contact mode. State and input order: ``kjax.types``.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.types import GRAVITY


class SrbParams(NamedTuple):
    """Parameters of the rigid body.

    Attributes:
      mass: [kg].
      inertia: about the centre of mass, pitch axis [kg m^2].
      feet: (front, rear) x (x, z) contact points relative to the centre of mass, body frame [m].
    """

    mass: Float[Array, ""]
    inertia: Float[Array, ""]
    feet: Float[Array, "2 2"]


def planar_rotation(theta: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Rotation R from body to world on (x, z), for pitch ``theta`` [rad], nose-up positive."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.array([[c, -s], [s, c]])


def dynamics(
    params: SrbParams, alpha: Float[Array, "2"], x: Float[Array, "6"], u: Float[Array, "4"]
) -> Float[Array, "6"]:
    """Time derivative of the state (Eqs. 1-2).

    Args:
      params: body parameters.
      alpha: (2,) number of stance legs at the front and at the rear (``types.MODE_ALPHA``).
      x: (6,) state ``[p_x, p_z, theta, v_x, v_z, omega]``, world frame [m, rad, m/s, rad/s].
      u: (4,) force of *one* front and one rear leg on the robot, body frame [N].

    Returns:
      (6,) derivative [m/s, rad/s, m/s^2, rad/s^2].
    """
    force = alpha[:, None] * u.reshape(2, 2)
    accel = planar_rotation(x[2]) @ force.sum(axis=0) / params.mass
    moment = params.feet[:, 0] * force[:, 1] - params.feet[:, 1] * force[:, 0]
    accel = accel - jnp.array([0.0, GRAVITY], x.dtype)
    return jnp.concatenate([x[3:], accel, moment.sum()[None] / params.inertia])


def rk4_step(
    params: SrbParams,
    alpha: Float[Array, "2"],
    x: Float[Array, "6"],
    u: Float[Array, "4"],
    dt: float,
) -> Float[Array, "6"]:
    """State (6,) after ``dt`` [s] under a held input: classical Runge-Kutta of order 4."""
    k1 = dynamics(params, alpha, x, u)
    k2 = dynamics(params, alpha, x + 0.5 * dt * k1, u)
    k3 = dynamics(params, alpha, x + 0.5 * dt * k2, u)
    k4 = dynamics(params, alpha, x + dt * k3, u)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def rollout(
    params: SrbParams,
    alpha: Float[Array, "2"],
    x0: Float[Array, "6"],
    inputs: Float[Array, "steps 4"],
    dt: float,
) -> Float[Array, "steps_plus_1 6"]:
    """Trajectory (steps + 1, 6) from ``x0`` under one input per step; ``vmap`` it over rollouts."""

    def step(x: Array, u: Array) -> tuple[Array, Array]:
        x_next = rk4_step(params, alpha, x, u, dt)
        return x_next, x_next

    _, states = jax.lax.scan(step, x0, inputs)
    return jnp.concatenate([x0[None], states])
