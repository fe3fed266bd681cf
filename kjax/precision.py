"""Products of matrices in the full precision of their type, on every device.

On a GPU JAX multiplies float32 matrices by default with the 10-bit mantissas of TF32. A
controller's matrices are small, so that this gains no time; but forces and feet are off in the
third digit, and of 1,000 QPs three were not solved to their tolerance on an H200.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """``function``, traced or run with ``jax.default_matmul_precision("highest")``."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return wrapped
