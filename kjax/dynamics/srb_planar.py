"""Planar single rigid body with forces at the front and the rear feet (Eq. 1, Eq. 2).

    p'' = R(theta) (alpha_f F_f + alpha_r F_r) / m - g
    theta'' = (r_f x alpha_f F_f + r_r x alpha_r F_r) / I

The forces F and the foot positions r are in the *body* frame, as in the paper; alpha counts the
stance legs at each end and so selects the contact mode. State and input order: ``kjax.types``.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

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
    """Time derivative of the state (Eq. 1 and Eq. 2).

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


def planted_dynamics(
    params: SrbParams,
    alpha: Float[Array, "n"],
    ground: Float[Array, "n 2"],
    x: Float[Array, "6"],
    u: Float[Array, "forces"],
    *,
    world_forces: bool = False,
) -> Float[Array, "6"]:
    """Time derivative of the state with feet that stay where they stand on the ground.

        theta'' = ((P_f - p) x alpha_f F_f + (P_r - p) x alpha_r F_r) / I,   all in the world frame

    Args:
      params: mass and inertia; its contact points are of no effect.
      alpha: (n,) number of stance legs at each contact point; n = 2 for front and rear, 4 for legs.
      ground: (n, 2) contact points P, (x, z), world frame [m].
      x: (6,) state.
      u: (2n,) force of one leg at each contact point [N].
      world_forces: whether ``u`` is in the world frame rather than in the body's.
    """
    force = alpha[:, None] * u.reshape(ground.shape)
    if not world_forces:
        force = force @ planar_rotation(x[2]).T
    arm = ground - x[None, :2]
    moment = arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]
    accel = force.sum(axis=0) / params.mass - jnp.array([0.0, GRAVITY], x.dtype)
    return jnp.concatenate([x[3:], accel, moment.sum()[None] / params.inertia])


def rk4(
    derivative: Callable[[Float[Array, "n"]], Float[Array, "n"]], x: Float[Array, "n"], dt: float
) -> Float[Array, "n"]:
    """State after ``dt`` [s] of x' = derivative(x): classical Runge-Kutta of order 4."""
    k1 = derivative(x)
    k2 = derivative(x + 0.5 * dt * k1)
    k3 = derivative(x + 0.5 * dt * k2)
    k4 = derivative(x + dt * k3)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def rk4_step(
    params: SrbParams,
    alpha: Float[Array, "2"],
    x: Float[Array, "6"],
    u: Float[Array, "4"],
    dt: float,
) -> Float[Array, "6"]:
    """State (6,) after ``dt`` [s] under a held input, by ``rk4``."""
    return rk4(lambda x: dynamics(params, alpha, x, u), x, dt)


def contact_points(x: Float[Array, "6"], feet: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """World positions (2, 2) of contact points given from the centre of mass in the body frame."""
    return x[None, :2] + feet @ planar_rotation(x[2]).T


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


Plant = Literal["body", "planted", "space"]
PLANTS: tuple[Plant, ...] = ("body", "planted", "space")


def trajectory(
    plant: Plant,
    params: SrbParams,
    alpha: Float[Array, "2"],
    x0: Float[Array, "6"],
    inputs: Float[Array, "steps 4"],
    dt: float,
) -> Float[Array, "steps_plus_1 6"]:
    """Trajectory from ``x0`` of one of three rigid bodies, which differ in what stays where.

    Args:
      plant: ``"body"`` for contact points and forces fixed in the body (the paper's), ``"planted"``
        for feet that stay on the ground, ``"space"`` for that and forces in the frame of the start.
      params: mass, inertia, contact points at the start.
      alpha: (2,) stance legs at front and rear.
      x0: (6,) start.
      inputs: (steps, 4) force per leg and step [N].
      dt: Runge-Kutta step [s].
    """
    if plant == "body":
        return rollout(params, alpha, x0, inputs, dt)
    if plant not in PLANTS:
        raise ValueError(f"plant must be one of {list(PLANTS)}, got {plant!r}")
    ground = contact_points(x0, params.feet)
    world = plant == "space"
    if world:
        inputs = (inputs.reshape(-1, 2, 2) @ planar_rotation(x0[2]).T).reshape(-1, 4)

    def step(x: Array, u: Array) -> tuple[Array, Array]:
        x = rk4(lambda x: planted_dynamics(params, alpha, ground, x, u, world_forces=world), x, dt)
        return x, x

    _, states = jax.lax.scan(step, x0, inputs)
    return jnp.concatenate([x0[None], states])
