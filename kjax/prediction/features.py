"""Features of residual models: what the error of the planted rigid body is a linear map of.

All take (start, x, u, phase). A ``GaitPhase`` comes from recorded episodes; in the LMPC a
``families.Past`` stands for it, with the same ``u_before`` and ``harmonics``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.prediction.families import Start, affine_features, phase_harmonics

# (start, x, u, phase) -> phi (F,)
Features = Callable[[Start, Array, Array, Any], Float[Array, "F"]]


class GaitPhase(NamedTuple):
    """Where in the gait a step lies; of many steps with leading axes.

    Attributes:
      u_before: (4,) force of the same legs in the tick before [N].
      elapsed: since the phase began [s].
      left: time left of it, this step included [s].
    """

    u_before: Float[Array | np.ndarray, "*V 4"]
    elapsed: Float[Array | np.ndarray, "*V"]
    left: Float[Array | np.ndarray, "*V"]

    @property
    def harmonics(self) -> Float[Array, "4"]:
        """Harmonics of the phase, ``families.phase_harmonics``."""
        return phase_harmonics(jnp.pi * jnp.asarray(self.elapsed / (self.elapsed + self.left)))


def affine(start: Start, x: Array, u: Array, phase: Any) -> Float[Array, "17"]:
    """``families.affine_features``."""
    return affine_features(start, x, u)


def clock(start: Start, x: Array, u: Array, phase: Any) -> Float[Array, "25"]:
    """Affine, and harmonics of the phase, alone and times v_x.

    The legs in the air swing as fast as the robot walks, and their inertia turns the body.
    """
    return jnp.concatenate([affine_features(start, x, u), _phase_terms(x, phase)])


def history(start: Start, x: Array, u: Array, phase: Any) -> Float[Array, "21"]:
    """Affine, and the force of the tick before: joints and contacts yield, so forces lag."""
    return jnp.concatenate([affine_features(start, x, u), phase.u_before])


def clock_history(start: Start, x: Array, u: Array, phase: Any) -> Float[Array, "29"]:
    """Affine, harmonics of the phase and the force before."""
    return jnp.concatenate([affine_features(start, x, u), phase.u_before, _phase_terms(x, phase)])


# Those that an LMPC can predict with.
BY_NAME: dict[str, Features] = {
    "affine": affine, "history": history, "clock": clock, "clock_history": clock_history,
}  # fmt: skip


def touchdown(dt: float, ticks: int = 3) -> Features:
    """``clock_history`` and what feet do around a change: one level and slope for each tick of it.

    Args:
      dt: control tick [s].
      ticks: before the end of a phase and after its beginning.
    """

    def features(start: Start, x: Array, u: Array, phase: GaitPhase) -> Array:
        count = jnp.arange(ticks)
        begun = jnp.round(phase.elapsed / dt) == count
        closing = jnp.round(phase.left / dt) == count + 1
        near = jnp.concatenate([begun, closing]).astype(x.dtype)
        slopes = (near[:, None] * jnp.stack([x[2], x[4], x[5]])).reshape(-1)
        unloaded = (near[:ticks, None] * u).reshape(-1)  # a foot that is late carries nothing
        return jnp.concatenate([clock_history(start, x, u, phase), near, slopes, unloaded])

    return features


def _phase_terms(x: Array, phase: Any) -> Float[Array, "8"]:
    return jnp.concatenate([phase.harmonics, x[3] * phase.harmonics])
