"""Dictionaries of observables Pi(x): names, units and a pure function each.

The paper's dictionary is ``[1, p, theta, v, omega, vec(R omega), ..., vec(R omega^p)]``. A planar
rotation holds its cosine twice and its sine with both signs, so the literal dictionary repeats
columns and its Gram matrix has no inverse; ``paper`` drops the repeats (N = 7 + 2p).
"""

from collections.abc import Callable, Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.types import STATE_DIM, STATE_NAMES, STATE_UNITS

# Column of the first state in every dictionary: the constant comes before it.
STATE_START = 1
STATE_ROWS = slice(STATE_START, STATE_START + STATE_DIM)

# Spread of the states of a walking robot, for features that need one [m, rad, m/s, rad/s].
FOURIER_SPREAD = (0.5, 0.1, 0.3, 1.0, 0.5, 2.0)


class Dictionary(NamedTuple):
    """Observables; static, so close over it rather than passing it through ``jit``.

    Attributes:
      lift: maps the state (6,) to the lifted state (N,); the constant 1 comes first, then the
        state itself, then the nonlinear observables. With a window it maps the last states
        (window, 6), the present one last.
      names: of the N observables.
      units: of the N observables.
      window: number of states that it looks at; above 1 for delay coordinates.
    """

    lift: Callable[[Float[Array, "*window 6"]], Float[Array, "N"]]
    names: tuple[str, ...]
    units: tuple[str, ...]
    window: int = 1

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


def states_only() -> Dictionary:
    """No lifting: ``[1, x]``."""
    return _dictionary(lambda x: x[:0], (), ())


def monomials(degree: int = 2) -> Dictionary:
    """All products of two to ``degree`` states, p_x left out (nothing depends on it)."""
    if degree < 1:
        raise ValueError(f"degree must be 1 or more, got {degree}")
    powers = [
        chosen
        for order in range(2, degree + 1)
        for chosen in combinations_with_replacement(range(1, STATE_DIM), order)
    ]

    def extra(x: Float[Array, "6"]) -> Float[Array, "E"]:
        products = [jnp.prod(x[jnp.asarray(chosen)]) for chosen in powers]
        return jnp.stack(products) if products else x[:0]

    names = tuple(" ".join(STATE_NAMES[i] for i in chosen) for chosen in powers)
    units = tuple(" ".join(STATE_UNITS[i] for i in chosen) for chosen in powers)
    return _dictionary(extra, names, units)


def fourier(count: int = 20, *, scale: float = 1.0, seed: int = 0) -> Dictionary:
    """Random Fourier features cos(w . x + b) of a Gaussian kernel (Rahimi and Recht, 2007).

    Args:
      count: number of features.
      scale: standard deviation of w in units of one over ``FOURIER_SPREAD`` of each state.
      seed: of the draw.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    rng = np.random.default_rng(seed)
    frequency = scale * rng.normal(size=(count, STATE_DIM)) / np.array(FOURIER_SPREAD)
    frequency[:, 0] = 0.0  # nothing depends on p_x
    phase = rng.uniform(0.0, 2.0 * np.pi, count)

    def extra(x: Float[Array, "6"]) -> Float[Array, "E"]:
        return jnp.cos(jnp.asarray(frequency, x.dtype) @ x + jnp.asarray(phase, x.dtype))

    return _dictionary(extra, tuple(f"cos(w_{i} x + b_{i})" for i in range(count)), ("-",) * count)


def custom_dictionary(
    function: Callable[[Float[Array, "6"]], Float[Array, "E"]],
    names: Sequence[str] = (),
    units: Sequence[str] = (),
) -> Dictionary:
    """Your own observables behind ``[1, x]``.

        custom_dictionary(lambda x: jnp.stack([jnp.sin(x[2]), x[5] * x[3]]))

    Args:
      function: from the state (6,) to the observables (E,).
      names: of these; numbered if left out.
      units: of these; unknown if left out.

    Raises:
      ValueError: if the function does not return a vector, or names or units do not fit.
    """
    try:
        out = jax.eval_shape(function, jax.ShapeDtypeStruct((STATE_DIM,), jnp.zeros(()).dtype))
    except Exception as error:
        raise ValueError(f"function does not take a state of shape (6,): {error}") from error
    if not hasattr(out, "shape") or len(out.shape) != 1:
        raise ValueError(f"function must return a vector (E,), got {out}")
    (count,) = out.shape
    names = tuple(names) or tuple(f"own {i}" for i in range(count))
    units = tuple(units) or ("?",) * count
    if len(names) != count or len(units) != count:
        raise ValueError(
            f"names and units must have {count} entries each, got {len(names)} and {len(units)}"
        )
    return _dictionary(function, names, units)


def delays(dictionary: Dictionary, count: int) -> Dictionary:
    """The observables of the present state and of ``count`` earlier ones (delay coordinates).

    For predictions from recorded motion; the controller keeps no past states.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    if dictionary.window != 1:
        raise ValueError("dictionary has delay coordinates already")

    def lift(window: Float[Array, "window 6"]) -> Float[Array, "N"]:
        earlier = [dictionary.lift(window[count - i])[1:] for i in range(1, count + 1)]
        # Positions go in as differences: where the robot is does not matter, only how it moved.
        earlier = [past.at[0].add(-window[count, 0]) for past in earlier]
        return jnp.concatenate([dictionary.lift(window[count]), *earlier])

    names = (f"{name}, {i} steps ago" for i in range(1, count + 1) for name in dictionary.names[1:])
    return Dictionary(
        lift=lift,
        names=(*dictionary.names, *names),
        units=(*dictionary.units, *dictionary.units[1:] * count),
        window=count + 1,
    )


def lift_all(
    dictionary: Dictionary, states: Float[Array, "rollouts steps_plus_1 6"]
) -> Float[Array, "rollouts T N"]:
    """Lifted states of all rollouts; with delay coordinates from the first full window on."""
    if dictionary.window == 1:
        return jax.vmap(jax.vmap(dictionary.lift))(states)
    count = states.shape[1] - dictionary.window + 1
    place = np.arange(count)[:, None] + np.arange(dictionary.window)
    return jax.vmap(jax.vmap(dictionary.lift))(states[:, place])


def _dictionary(
    extra: Callable[[Float[Array, "6"]], Float[Array, "E"]],
    names: tuple[str, ...],
    units: tuple[str, ...],
) -> Dictionary:
    """``[1, x, extra(x)]``."""

    def lift(x: Float[Array, "6"]) -> Float[Array, "N"]:
        return jnp.concatenate([jnp.ones((1,), x.dtype), x, extra(x)])

    return Dictionary(
        lift=lift, names=("1", *STATE_NAMES, *names), units=("-", *STATE_UNITS, *units)
    )


def __getattr__(name: str) -> object:
    if name == "own":
        raise ImportError("kjax.koopman.observables.own is now custom_dictionary")
    raise AttributeError(f"module 'kjax.koopman.observables' has no attribute '{name}'")
