"""Dictionaries of observables Pi(x): names, units and a pure function each.

The paper's dictionary is ``[1, p, theta, v, omega, vec(R omega), ..., vec(R omega^p)]``. A planar
rotation holds its cosine twice and its sine with both signs, so the literal dictionary repeats
columns and its Gram matrix has no inverse; ``paper`` drops the repeats (N = 7 + 2p).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.types import STATE_DIM, STATE_NAMES, STATE_UNITS

# Column of the first state in every dictionary: the constant comes before it.
STATE_START = 1
STATE_ROWS = slice(STATE_START, STATE_START + STATE_DIM)


class Dictionary(NamedTuple):
    """Observables; static, so close over it rather than passing it through ``jit``.

    Attributes:
      lift: maps the state (6,) to the lifted state (N,); the constant 1 comes first, then the
        state itself, then the nonlinear observables.
      names: of the N observables.
      units: of the N observables.
    """

    lift: Callable[[Float[Array, "6"]], Float[Array, "N"]]
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number N of observables."""
        return len(self.names)


def paper(order: int = 4, *, literal: bool = False, constant_rotation: bool = False) -> Dictionary:
    """The paper's physics-informed dictionary.

    Args:
      order: highest power p of omega.
      literal: keep all four entries of every vec(R omega^k) (N = 7 + 4p, rank-deficient).
      constant_rotation: add the k = 0 term, R itself, which the paper leaves out.
    """
    if order < 0:
        raise ValueError(f"order must be 0 or more, got {order}")
    powers = tuple(range(0 if constant_rotation else 1, order + 1))
    entries = ("cos", "sin", "-sin", "cos") if literal else ("cos", "sin")

    def lift(x: Float[Array, "6"]) -> Float[Array, "N"]:
        c, s, omega = jnp.cos(x[2]), jnp.sin(x[2]), x[5]
        columns = jnp.stack([c, s, -s, c] if literal else [c, s])
        blocks, factor = [], jnp.ones_like(omega)
        for power in range(order + 1):
            if power in powers:
                blocks.append(columns * factor)
            factor = factor * omega
        return jnp.concatenate([jnp.ones((1,), x.dtype), x, *blocks])

    names = tuple(f"{e}(theta) omega^{k}" for k in powers for e in entries)
    units = tuple(f"(rad/s)^{k}" for k in powers for _ in entries)
    return Dictionary(
        lift=lift, names=("1", *STATE_NAMES, *names), units=("-", *STATE_UNITS, *units)
    )
