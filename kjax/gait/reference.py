"""Periodic reference of a gait with flights: height, pitch and their rates through one cycle.

In a bound or a pronk no constant pose is consistent with the forces: each stance lifts and turns
the body and each flight lets it fall. The reference is the periodic motion of the rigid body under
trapezoidal vertical forces whose impulses carry the weight over a cycle and leave no net moment:

    J_f + J_r = m g T,   J_f l_f = J_r l_r

An end that stands several times in a cycle shares its impulse among its stances by their length.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from kjax.concrete import array_library, stacked
from kjax.types import GRAVITY, MODE_ALPHA, Mode

# Reference rows: deviation of height, pitch, v_z and omega.
REFERENCE_NAMES = ("p_z", "theta", "v_z", "omega")
SAMPLES = 51  # per phase, ends included; at most 2 ms apart in the gaits at hand


class PeriodicReference(NamedTuple):
    """Periodic motion about the mean stance height, sampled per phase.

    Attributes:
      rows: (phases, SAMPLES, 4) deviation of p_z [m], theta [rad], v_z [m/s], omega [rad/s].
      impulses: (2,) impulse of the front and of the rear pair per cycle [N s].
    """

    rows: Float[Array, "phases samples 4"]
    impulses: Float[Array, "2"]


def has_periodic_reference(modes: Sequence[Mode]) -> bool:
    """Whether front and rear both stand in a cycle, and neither does in two phases on end."""
    stands = MODE_ALPHA[list(modes)] > 0
    twice = stands & np.roll(stands, -1, axis=0)
    return bool(stands.any(axis=0).all() and not twice.any())


def periodic_reference(
    durations: np.ndarray,
    modes: list[Mode],
    lever_front: Any,
    lever_rear: Any,
    mass: Any,
    inertia: Any,
    edge: Any = 0.25,
) -> PeriodicReference:
    """Periodic reference of a cycle in which each end has left the ground before it stands again.

    Differentiable by all but the durations and modes.

    Args:
      durations: (phases,) length of each phase [s].
      modes: contact mode of each phase.
      lever_front: horizontal distance of the front feet from the centre of mass [m].
      lever_rear: the same of the rear feet [m].
      mass: of the body [kg].
      inertia: about the pitch axis [kg m^2].
      edge: part of a stance in which the force rises, and again in which it falls, up to 1/2 [-].

    Raises:
      ValueError: where an end never stands, or does in two phases on end.
    """
    if not has_periodic_reference(modes):
        raise ValueError(f"front and rear must stand, and lift off after each phase, got {modes}")
    stands = [[i for i, mode in enumerate(modes) if MODE_ALPHA[mode, pair] > 0] for pair in (0, 1)]
    total = mass * GRAVITY * float(np.sum(durations))
    impulses = stacked([lever_rear * total, lever_front * total]) / (lever_front + lever_rear)

    # Integrate on a fine grid of equal cells per phase, forces at the cells' middles.
    cells = 20 * (SAMPLES - 1)
    middle = (np.arange(cells) + 0.5) / cells
    xp = array_library(impulses, mass, inertia, edge)
    shape = xp.clip(np.minimum(middle, 1.0 - middle) / edge, 0.0, 1.0)
    shape = shape / shape.mean()
    force: list[Any] = [np.zeros(cells)] * len(modes)
    moment: list[Any] = [np.zeros(cells)] * len(modes)
    for phases, impulse, lever in zip(stands, impulses, (lever_front, -lever_rear), strict=True):
        pushed = shape * impulse / sum(durations[i] for i in phases)
        for i in phases:
            force[i] = force[i] + pushed
            moment[i] = moment[i] + lever * pushed  # ahead of the body it turns the nose up
    step = np.repeat(np.asarray(durations) / cells, cells)
    z, v_z = _periodic(xp.concatenate(force) / mass - GRAVITY, step)
    theta, omega = _periodic(xp.concatenate(moment) / inertia, step)

    # The mean over the stances is zero: that is where the height reference refers to, and
    # the trunk is level on average while it can be acted on.
    at = np.arange(len(modes))[:, None] * cells + np.arange(SAMPLES) * (cells // (SAMPLES - 1))
    stances = at[[i for i, mode in enumerate(modes) if mode != Mode.FLIGHT]]
    z, theta = (a - a[stances].mean() for a in (z, theta))
    rows = xp.stack([z[at], theta[at], v_z[at], omega[at]], axis=-1)
    return PeriodicReference(rows=rows, impulses=impulses)


def _periodic(
    acceleration: Array | np.ndarray, step: np.ndarray
) -> tuple[Array | np.ndarray, Array | np.ndarray]:
    """Position and velocity at the cell borders under a piecewise constant acceleration.

    The mean velocity over the cycle is zero, so that the position returns to its start.
    """
    xp = array_library(acceleration)
    zero = xp.zeros((1,), acceleration.dtype)
    gain = xp.concatenate([zero, xp.cumsum(acceleration * step)])
    travel = gain[:-1] * step + 0.5 * acceleration * step**2
    velocity = gain - travel.sum() / step.sum()
    displacement = xp.cumsum(velocity[:-1] * step + 0.5 * acceleration * step**2)
    return xp.concatenate([zero, displacement]), velocity
