"""Cholesky factors and triangular solves, under ``vmap`` on a CPU one matrix after the other.

jaxlib hands the parts of a batched LAPACK call to XLA's thread pool and waits for them there. Where
as many such calls run at once as the pool has threads, two programs on two cores, all wait for
good. A call of one matrix does its work itself.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float


def _one_by_one(function: Callable[..., Array]) -> Callable[..., Array]:
    """The function, which for a batch on a CPU is a loop."""
    whole: Any = custom_vmap(function)

    def rule(axis_size: int, in_batched: list[bool], *args: Array) -> tuple[Array, bool]:
        if jax.default_backend() != "cpu":
            axes = [0 if batched else None for batched in in_batched]
            return jax.vmap(function, axes)(*args), True
        rows = [arg for arg, batched in zip(args, in_batched, strict=True) if batched]

        def one(own: list[Array]) -> Array:
            left, pairs = iter(own), zip(args, in_batched, strict=True)
            return whole(*(next(left) if batched else arg for arg, batched in pairs))

        return jax.lax.map(one, rows), True

    whole.def_vmap(rule)
    return whole


_factor = _one_by_one(jnp.linalg.cholesky)
_lower = _one_by_one(lambda L, B: solve_triangular(L, B, lower=True))
_both = _one_by_one(
    lambda L, b: solve_triangular(L, solve_triangular(L, b, lower=True), lower=True, trans="T")
)


@jax.custom_jvp
def cholesky(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower factor L of a positive definite A = L L^T; NaN where it is none."""
    return _factor(A)


@cholesky.defjvp
def _cholesky_derivative(primals: Any, tangents: Any) -> tuple[Array, Array]:
    (A,), (dA,) = primals, tangents
    L = cholesky(A)
    half = inverse_of_lower(L)
    change = jnp.tril(half @ dA @ half.T)
    return L, L @ (change - 0.5 * jnp.diag(jnp.diagonal(change)))


@jax.custom_jvp
def inverse_of_lower(L: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L^-1 of a lower triangle."""
    return _lower(L, jnp.eye(L.shape[0], dtype=L.dtype))


@inverse_of_lower.defjvp
def _inverse_derivative(primals: Any, tangents: Any) -> tuple[Array, Array]:
    (L,), (dL,) = primals, tangents
    half = inverse_of_lower(L)
    return half, -half @ dL @ half


def cholesky_solve(L: Float[Array, "n n"], b: Float[Array, "n"]) -> Float[Array, "n"]:
    """(L L^T)^-1 b, without a derivative."""
    return _both(*jax.lax.stop_gradient((L, b)))
