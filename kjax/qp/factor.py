"""A Hessian in triangles, and the minimiser without rows."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.qp.lapack import cholesky, cholesky_solve


class Factor(NamedTuple):
    """H in triangles, L L^T = H / curvature.

    Attributes:
      L: (n, n) lower triangle; the identity where H is not definite.
      curvature: largest of H's diagonal.
      definite: whether H is positive definite to working precision.
    """

    L: Float[Array, "n n"]
    curvature: Float[Array, ""]
    definite: Bool[Array, ""]


def factorise(H: Float[Array, "n n"]) -> Factor:
    """Cholesky factor of a Hessian."""
    n, dtype = H.shape[0], H.dtype
    eps = float(jnp.finfo(dtype).eps)
    curvature = jnp.max(jnp.diagonal(H))
    curvature = jnp.where(curvature > 0, curvature, 1.0)
    L = cholesky(H / curvature)
    definite = (jnp.diagonal(L) > (n * eps) ** 0.5).all()
    return Factor(jnp.where(definite, L, jnp.eye(n, dtype=dtype)), curvature, definite)


def unconstrained(factor: Factor, q: Float[Array, "n"]) -> Float[Array, "n"]:
    """Minimiser (n,) without any rows."""
    return -cholesky_solve(factor.L, q) / factor.curvature
