"""Whether values are known or traced, and the array library that suits them.

What is computed once, from values that are known, is computed in NumPy: in JAX each operation is a
program of its own that has to be compiled.
"""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def is_concrete(tree: Any) -> bool:
    """Whether all values are concrete: none is traced by ``jit``, ``vmap`` or ``grad``."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def array_library(*values: Any) -> ModuleType:
    """NumPy where all values are NumPy arrays or plain floats, ``jax.numpy`` otherwise."""
    known = not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(values))
    return np if known else jnp


def stacked(values: Any) -> Any:
    """Floats, or a list (of lists) of values of one shape, as one array with new leading axes."""
    if not isinstance(values, list):
        return array_library(values).asarray(values, float)
    parts = [stacked(value) for value in values]
    return array_library(parts).stack(parts)
