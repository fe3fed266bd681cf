"""Condensed LMPC: the states eliminated, a QP in the forces alone.

    minimise over U   sum_{i=1..k} |x_i - x_i^d|^2_Q + |u_{i-1} - u_ref|^2_R
    subject to        z_{i+1} = A z_i + B u_i,   x_i = C_x z_i,   u_min <= u_i <= u_max

Stacking the predictions as X = A_qp z_0 + B_qp U gives 1/2 U^T H U + q^T U with
H = 2 (B_qp^T Q B_qp + R) and q = F z_0 - G X^d - 2 R U_ref. The paper writes A_qp x_0; the matrix
has to act on the lifted state z_0 = Pi(x_0).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.koopman.observables import STATE_ROWS


class CondensedQp(NamedTuple):
    """Matrices of the condensed problem, k steps, N observables, 4 inputs.

    Attributes:
      H: (4k, 4k) Hessian.
      F: (4k, N) gradient per lifted initial state.
      G: (4k, 6k) gradient per (negative) stacked reference.
      A_qp: (6k, N) free response of the states.
      B_qp: (6k, 4k) forced response of the states.
    """

    H: Float[Array, "nu nu"]
    F: Float[Array, "nu N"]
    G: Float[Array, "nu nx"]
    A_qp: Float[Array, "nx N"]
    B_qp: Float[Array, "nx nu"]


def condense(
    A: Float[Array, "N N"],
    B: Float[Array, "N 4"],
    state_weights: Float[Array, "6"] | Float[Array, "k 6"],
    input_weights: Float[Array, "4"],
    horizon: int,
) -> CondensedQp:
    """Condensed QP of one linear model.

    Args:
      A: lifted transition per model step.
      B: input map per model step.
      state_weights: diagonal of Q, order of ``STATE_NAMES``; (6,), or (k, 6) for every step.
      input_weights: diagonal of R [1/N^2].
      horizon: number k of model steps, at least 1.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    m = B.shape[1]
    free, forced = [], []
    P = B  # A^i B
    observe = A[STATE_ROWS]  # C_x A^(i+1)
    for _ in range(horizon):
        free.append(observe)
        forced.append(P[STATE_ROWS])
        observe, P = observe @ A, A @ P
    # Block (i, j) of the block-Toeplitz B_qp is C_x A^(i-j) B.
    lag = np.subtract.outer(np.arange(horizon), np.arange(horizon))
    blocks = jnp.stack(forced)[np.maximum(lag, 0)] * (lag >= 0)[:, :, None, None]
    B_qp = jnp.moveaxis(blocks, 1, 2).reshape(6 * horizon, m * horizon)
    A_qp = jnp.concatenate(free)
    weights = jnp.broadcast_to(state_weights, (horizon, 6)).reshape(-1)
    G = 2.0 * (B_qp * weights[:, None]).T
    H = G @ B_qp + 2.0 * jnp.diag(jnp.tile(input_weights, horizon))
    return CondensedQp(H=0.5 * (H + H.T), F=G @ A_qp, G=G, A_qp=A_qp, B_qp=B_qp)


def cautious_weights(
    A: Float[Array, "N N"],
    state_weights: Float[Array, "6"],
    spread: Float[Array, "6"],
    caution: Float[Array, ""] | float,
    horizon: int,
) -> Float[Array, "k 6"]:
    """Q of every step, less where the prediction is less certain.

    The error of one step, white and of standard deviation s, grows along the horizon to
    S_i = sum_{j<i} A^j diag(s^2) A^j^T; step i weighs Q / (1 + caution S_i / mean(S)).

    Args:
      A: lifted transition per model step.
      state_weights: diagonal of Q.
      spread: standard deviation of the one-step error, the model's uncertainty.
      caution: 0 to trust the whole horizon alike [-].
      horizon: number k of model steps.
    """
    state = A[STATE_ROWS, STATE_ROWS]
    step = jnp.diag(spread**2)
    total, power, rows = jnp.zeros_like(step), jnp.eye(6, dtype=A.dtype), []
    for _ in range(horizon):
        total = total + power @ step @ power.T
        power = state @ power
        rows.append(jnp.diagonal(total))
    variance = jnp.stack(rows)
    mean = variance.mean(axis=0)
    ratio = jnp.where(mean > 0, variance / jnp.where(mean > 0, mean, 1.0), 0.0)
    return state_weights / (1.0 + caution * ratio)
