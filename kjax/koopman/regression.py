"""Least squares Z W = Y by an incremental QR factorisation (TSQR): stable, of bounded size.

It keeps R of the QR factorisation of [Z Y]. It holds all that the fit, its residual and its
rank need, it does not square the condition number as a Gram matrix does, and QR of two stacked
factors is that of all their rows: snapshots may come in blocks, from several machines, or
one by one as the robot walks (with forgetting), and 10^8 of them need no more memory than ten.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax.precision import full_precision

BLOCK = 500  # rows factorised at once: they stay in the cache
ROUNDING = 20.0  # singular values below so many roundings per column count as zero


class QrFactor(NamedTuple):
    """Everything that least squares needs of M rows [Z Y], c + t columns.

    Attributes:
      R: (c + t, c + t) upper triangular, with R^T R = [Z Y]^T [Z Y].
      rows: number of them, fewer where old ones were forgotten.
    """

    R: Float[Array, "ct ct"]
    rows: Float[Array, ""]


class Weights(NamedTuple):
    """Solution of a least-squares problem.

    Attributes:
      W: (c, t) with Z W = Y.
      rank: numerical rank of the scaled columns.
      sigma: (c,) their singular values, largest first [-].
    """

    W: Float[Array, "c t"]
    rank: Int[Array, ""]
    sigma: Float[Array, "c"]


def empty(columns: int, targets: int, dtype: jnp.dtype | None = None) -> QrFactor:
    """The QR factor of no rows."""
    size = columns + targets
    return QrFactor(R=jnp.zeros((size, size), dtype), rows=jnp.zeros((), dtype))


@full_precision
def accumulate(
    factor: QrFactor,
    Z: Float[Array | np.ndarray, "M c"],
    Y: Float[Array | np.ndarray, "M t"],
    *,
    forget: float | Float[Array, ""] = 1.0,
) -> QrFactor:
    """The QR factor with M rows more; all older rows first lose weight by ``forget`` (0 to 1]."""
    new = jnp.concatenate([jnp.asarray(Z), jnp.asarray(Y)], axis=1)
    old = jnp.sqrt(jnp.asarray(forget, new.dtype)) * factor.R
    R = jnp.linalg.qr(jnp.concatenate([old, new]), mode="r")
    return QrFactor(R=R[: old.shape[0]], rows=forget * factor.rows + new.shape[0])


@full_precision
def merge(one: QrFactor, other: QrFactor) -> QrFactor:
    """The QR factor of the rows of both."""
    R = jnp.linalg.qr(jnp.concatenate([one.R, other.R]), mode="r")
    return QrFactor(R=R, rows=one.rows + other.rows)


@full_precision
def of_rows(Z: Float[Array | np.ndarray, "M c"], Y: Float[Array | np.ndarray, "M t"]) -> QrFactor:
    """The QR factor of M rows, fewer than columns or more."""
    rows = jnp.concatenate([jnp.asarray(Z), jnp.asarray(Y)], axis=1)
    count, size = rows.shape
    if count > 4 * BLOCK and size < BLOCK // 2:
        filled = jnp.zeros((-(-count // BLOCK) * BLOCK, size), rows.dtype).at[:count].set(rows)
        blocks = filled.reshape(-1, BLOCK, size)
        rows = jax.lax.map(lambda block: jnp.linalg.qr(block, mode="r"), blocks).reshape(-1, size)
    R = jnp.linalg.qr(rows, mode="r")
    R = jnp.zeros((size, size), R.dtype).at[: R.shape[0]].set(R[:size])
    return QrFactor(R=R, rows=jnp.asarray(count, R.dtype))


@full_precision
def solve(
    factor: QrFactor,
    columns: int,
    *,
    ridge: float | Float[Array, ""] = 0.0,
    use: Bool[Array | np.ndarray, "c"] | None = None,
) -> Weights:
    """Minimum-norm solution in the scaled columns.

    Args:
      factor: of the rows.
      columns: number c of regressors.
      ridge: penalty of |W|^2 in the scaled columns (each of unit length), 0 for none [-].
      use: (c,) regressors to use, a dictionary cut out of a larger one; all if ``None``.
    """
    R, Y = factor.R[:columns, :columns], factor.R[:columns, columns:]
    if use is not None:
        R = jnp.where(use[None], R, 0.0)
    norm = jnp.linalg.norm(R, axis=0)
    scale = jnp.where(norm > 0, norm, 1.0)
    left, sigma, right = jnp.linalg.svd(R / scale[None])
    keep = sigma > sigma[0] * ROUNDING * columns * jnp.finfo(R.dtype).eps
    safe = jnp.where(keep, sigma, 1.0)
    gain = jnp.where(keep, safe / (safe**2 + ridge), 0.0)
    W = right.T @ (gain[:, None] * (left.T @ Y))
    W = jnp.where(norm[:, None] > 0, W / scale[:, None], 0.0)
    return Weights(W=W, rank=keep.sum(), sigma=sigma)


@full_precision
def rms(factor: QrFactor, W: Float[Array, "c t"]) -> Float[Array, "t"]:
    """Root mean square of Y - Z W over the factor's rows; these need not be those of the fit."""
    move = jnp.concatenate([-W, jnp.eye(W.shape[1], dtype=W.dtype)])
    size = jnp.maximum(factor.rows, 1.0)
    return jnp.linalg.norm(factor.R @ move, axis=0) / jnp.sqrt(size)


def block_rows(
    factor: QrFactor, Z: Float[Array | np.ndarray, "B M c"], Y: Float[Array | np.ndarray, "B M t"]
) -> QrFactor:
    """B blocks of rows one after the other: the memory of one block."""

    def one(factor: QrFactor, block: tuple[Array, Array]) -> tuple[QrFactor, None]:
        return accumulate(factor, *block), None

    return jax.lax.scan(one, factor, (jnp.asarray(Z), jnp.asarray(Y)))[0]
