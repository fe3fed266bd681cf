"""Condensed LMPC: the states eliminated, a QP in the forces alone.

    minimise over U   sum_{i=1..k} |x_i - x_i^d|^2_Q + |u_{i-1} - u_ref|^2_R         (Eq. 10)
    subject to        z_{i+1} = A z_i + B u_i                                        (Eq. 11)
                      x_i = C_x z_i,   u_min <= u_i <= u_max                         (Eq. 12)

Stacking the predictions as X = A_qp z_0 + B_qp U (Eq. 13) in the cost (Eq. 14) gives
1/2 U^T H U + q^T U (Eq. 15) with H = 2 (B_qp^T Q B_qp + R) and q = F z_0 - G X^d - 2 R U_ref. The
paper writes A_qp x_0; the matrix has to act on the lifted state z_0 = Pi(x_0). The constraints on
the inputs (Eq. 16) are a box, and rows of ``mpc.limits``.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.koopman.observables import STATE_START


class CondensedQp(NamedTuple):
    """Matrices of the condensed problem: k steps, N observables, n_x states, n_u inputs.

    Attributes:
      H: (n_u k, n_u k) Hessian.
      F: (n_u k, N) gradient per lifted initial state.
      G: (n_u k, n_x k) gradient per (negative) stacked reference.
      A_qp: (n_x k, N) free response of the states.
      B_qp: (n_x k, n_u k) forced response of the states.
    """

    H: Float[Array, "nu nu"]
    F: Float[Array, "nu N"]
    G: Float[Array, "nu nx"]
    A_qp: Float[Array, "nx N"]
    B_qp: Float[Array, "nx nu"]


def condense(
    A: Float[Array, "N N"],
    B: Float[Array, "N n_u"],
    state_weights: Float[Array, "n_x"] | Float[Array, "k n_x"],
    input_weights: Float[Array, "n_u"],
    horizon: int,
) -> CondensedQp:
    """Condensed QP of one linear model.

    Args:
      A: lifted transition per model step.
      B: input map per model step.
      state_weights: diagonal of Q, the states being rows 1 to n_x of the lifted state; (n_x,), or
        (k, n_x) for every step.
      input_weights: diagonal of R [1/N^2].
      horizon: number k of model steps, at least 1.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    n_x, n_u = state_weights.shape[-1], B.shape[1]
    rows = slice(STATE_START, STATE_START + n_x)
    free, forced = [], []
    P = B  # A^i B
    observe = A[rows]  # C_x A^(i+1)
    for _ in range(horizon):
        free.append(observe)
        forced.append(P[rows])
        observe, P = observe @ A, A @ P
    # Block (i, j) of the block-Toeplitz B_qp is C_x A^(i-j) B.
    lag = np.subtract.outer(np.arange(horizon), np.arange(horizon))
    blocks = jnp.stack(forced)[np.maximum(lag, 0)] * (lag >= 0)[:, :, None, None]
    B_qp = jnp.moveaxis(blocks, 1, 2).reshape(n_x * horizon, n_u * horizon)
    A_qp = jnp.concatenate(free)
    weights = jnp.broadcast_to(state_weights, (horizon, n_x)).reshape(-1)
    G = 2.0 * (B_qp * weights[:, None]).T
    H = G @ B_qp + 2.0 * jnp.diag(jnp.tile(input_weights, horizon))
    return CondensedQp(H=0.5 * (H + H.T), F=G @ A_qp, G=G, A_qp=A_qp, B_qp=B_qp)


def discounted_weights(
    A: Float[Array, "N N"],
    state_weights: Float[Array, "n_x"],
    spread: Float[Array, "n_x"],
    uncertainty_discount: Float[Array, ""] | float,
    horizon: int,
) -> Float[Array, "k n_x"]:
    """Q of every step, less where the prediction is less certain.

    The error of one step, white and of standard deviation s, grows along the horizon to
    S_i = sum_{j<i} A^j diag(s^2) A^j^T; step i weighs Q / (1 + discount S_i / mean(S)).

    Args:
      A: lifted transition per model step.
      state_weights: diagonal of Q.
      spread: standard deviation of the one-step error, the model's uncertainty.
      uncertainty_discount: 0 to trust the whole horizon alike [-].
      horizon: number k of model steps.
    """
    n_x = state_weights.shape[0]
    rows = slice(STATE_START, STATE_START + n_x)
    state = A[rows, rows]
    step = jnp.diag(spread**2)
    total, power, spreads = jnp.zeros_like(step), jnp.eye(n_x, dtype=A.dtype), []
    for _ in range(horizon):
        total = total + power @ step @ power.T
        power = state @ power
        spreads.append(jnp.diagonal(total))
    variance = jnp.stack(spreads)
    mean = variance.mean(axis=0)
    ratio = jnp.where(mean > 0, variance / jnp.where(mean > 0, mean, 1.0)[None], 0.0)
    return state_weights[None] / (1.0 + uncertainty_discount * ratio)
