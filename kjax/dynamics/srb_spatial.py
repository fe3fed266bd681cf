"""Single rigid body in three dimensions, in momentum form: forces and feet in the world.

    p' = v,   v' = g + sum F_i / m,   L' = sum (r_i - p) x F_i,   R' = [I_w(R)^-1 L]_x R

L is the angular momentum about the centre of mass. Under held forces on feet that stay where they
are in the world, p, v and L are polynomials of time: the step is exact in them, for any step. The
attitude alone has no closed form; it is integrated on the rotation group.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.dynamics import rotations
from kjax.types import GRAVITY


class SpatialBody(NamedTuple):
    """Parameters of the rigid body.

    Attributes:
      mass: [kg].
      inertia: (3, 3) composite inertia of the robot about its centre of mass, trunk axes [kg m^2].
    """

    mass: Float[Array, ""]
    inertia: Float[Array, "3 3"]


class BodyState(NamedTuple):
    """State of the body, world frame.

    Attributes:
      p: (3,) centre of mass [m].
      R: (3, 3) rotation from the trunk's axes to the world [-].
      v: (3,) velocity of the centre of mass [m/s].
      L: (3,) angular momentum about the centre of mass [N m s].
    """

    p: Float[Array, "3"]
    R: Float[Array, "3 3"]
    v: Float[Array, "3"]
    L: Float[Array, "3"]


class Contacts(NamedTuple):
    """Feet that stand, n of them, and what they press.

    Attributes:
      feet: (n, 3) contact points, world [m].
      force: (n, 3) force of each on the robot, world [N]; 0 for a foot in the air.
      other: (2, 3) force at the centre of mass and moment about it of anything else, world
        [N, N m]; ``None`` for nothing.
    """

    feet: Float[Array, "n 3"]
    force: Float[Array, "n 3"]
    other: Float[Array, "2 3"] | None = None


def gravity(dtype: jnp.dtype) -> Float[Array, "3"]:
    """g, world frame [m/s^2]."""
    return jnp.array([0.0, 0.0, -GRAVITY], dtype)


def angular_velocity(
    body: SpatialBody, R: Float[Array, "3 3"], L: Float[Array, "3"]
) -> Float[Array, "3"]:
    """I_w^-1 L, world frame [rad/s]."""
    return R @ (rotations.inverse(body.inertia) @ (R.T @ L))


def momentum(
    body: SpatialBody, R: Float[Array, "3 3"], omega: Float[Array, "3"]
) -> Float[Array, "3"]:
    """L of a body that turns with omega, world frame [N m s]."""
    return R @ (body.inertia @ (R.T @ omega))


def translation(
    body: SpatialBody, state: BodyState, contacts: Contacts, t: Float[Array, ""] | float
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """p, v and L after a time ``t`` [s] under held forces: exact."""
    p, v = state.p, state.v
    total = contacts.force.sum(axis=0)
    a = gravity(p.dtype) + total / body.mass
    # L' = sum r_i x F_i - p(t) x sum F_i, and the integral of p is known.
    arms = jnp.cross(contacts.feet, contacts.force).sum(axis=0)
    if contacts.other is not None:
        a = a + contacts.other[0] / body.mass
        arms = arms + contacts.other[1]
    path = p * t + v * (t**2 / 2) + a * (t**3 / 6)
    L = state.L + t * arms - jnp.cross(path, total)
    return p + v * t + a * (t**2 / 2), v + a * t, L


def step(
    body: SpatialBody,
    state: BodyState,
    contacts: Contacts,
    dt: Float[Array, ""] | float,
    *,
    substeps: int = 1,
) -> BodyState:
    """State after ``dt`` [s] under held forces; exact in p, v and L.

    The attitude is by Runge-Kutta-Munthe-Kaas of order 4 in each of ``substeps``.
    """
    h = dt / substeps

    def rate(R: Array, t: Array | float) -> Array:
        """Angular velocity at a time within the step."""
        return angular_velocity(body, R, translation(body, state, contacts, t)[2])

    def substep(R: Array, i: Array) -> tuple[Array, None]:
        t = i * h

        def slope(w: Array, c: float) -> Array:
            """Change of w in a whole substep, where R is exp(w) R now."""
            k = h * rate(rotations.exp(w) @ R, t + c * h)
            turned = jnp.cross(w, k)
            return k - turned / 2 + jnp.cross(w, turned) / 12

        k1 = slope(jnp.zeros_like(state.p), 0.0)
        k2 = slope(0.5 * k1, 0.5)
        k3 = slope(0.5 * k2, 0.5)
        k4 = slope(k3, 1.0)
        return rotations.exp((k1 + 2 * k2 + 2 * k3 + k4) / 6) @ R, None

    R, _ = jax.lax.scan(substep, state.R, jnp.arange(substeps, dtype=state.p.dtype))
    p, v, L = translation(body, state, contacts, dt)
    return BodyState(p=p, R=R, v=v, L=L)


def rollout(
    body: SpatialBody,
    start: BodyState,
    contacts: Contacts,
    dt: Float[Array, "steps"],
    *,
    substeps: int = 1,
) -> BodyState:
    """States (steps + 1, ...) from ``start`` on; contacts and dt have a leading axis of steps."""

    def one(state: BodyState, now: tuple[Contacts, Array]) -> tuple[BodyState, BodyState]:
        state = step(body, state, *now, substeps=substeps)
        return state, state

    _, states = jax.lax.scan(one, start, (contacts, dt))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)
