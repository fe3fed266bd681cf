"""Planned forces, perturbed: what a robot must do for its model to be told from its feedback.

A walking robot's forces follow from its state, so that its episodes alone do not say what a force
does. Each control tick adds a random force to the planned ones of the standing legs; both legs of
an end get the same, as the models know one force per end. What the planner remembers stays as it
planned it.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.moved import moved_names


def perturb(
    force: Float[Array, "4 3"], stance: Bool[Array, "4"], noise: Float[Array, "4"]
) -> Float[Array, "4 3"]:
    """Forces on the legs with a random part; the ground still only pushes.

    Args:
      force: planned on each leg, local axes (``ControllerState``) [N].
      stance: legs that stand; the others get nothing.
      noise: added (x, z) at the front and the rear [N].
    """
    noise = jnp.repeat(noise.astype(force.dtype).reshape(2, 2), 2, axis=0)
    added = jnp.asarray(force).at[:, ::2].add(noise)
    added = added.at[:, 2].max(0.0)
    return jnp.where(stance[:, None], added, force)


__getattr__ = moved_names(__name__)
