"""EDMD: the least-squares operator K = [A, B] from snapshots, solved robustly.

The paper writes K = G_1 G_2^-1 with G_2 = mean(Pi [Pi; u]^T), which is not square; the regression
wants the Gram matrix of the full regressor [Pi; u]. We do not form a Gram matrix at all, since it
squares the condition number: the columns are scaled to unit norm and the least-squares problem is
solved by QR followed by an SVD of the small triangular factor, which also reveals the rank. The
regression is on the increment Pi(y) - Pi(x), so that float32 keeps its digits at small steps.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from kjax import srb
from kjax.config import KoopmanConfig, SrbConfig
from kjax.koopman.dataset import SampleRanges, Snapshots, ranges_from_config, sample
from kjax.koopman.models import LinearModel
from kjax.koopman.observables import Dictionary, paper
from kjax.types import MODE_ALPHA, Mode

Point = tuple[float, float]  # (x, z) [m]


class FitReport(NamedTuple):
    """How well posed the regression was; stacked over modes like the model.

    Attributes:
      rank: numerical rank of the scaled regressor [-].
      columns: its number of columns [-].
      condition: ratio of largest to smallest *retained* singular value [-].
      condition_full: the same over all of them; huge where columns repeat [-].
      residual_rms: (6,) one-step residual of each state [m, rad, m/s, rad/s].
      finite: whether all data and all coefficients are finite.
    """

    rank: Int[Array, ""]
    columns: Int[Array, ""]
    condition: Float[Array, ""]
    condition_full: Float[Array, ""]
    residual_rms: Float[Array, "6"]
    finite: Array


def regressors(
    dictionary: Dictionary, data: Snapshots, *, feet_terms: bool
) -> tuple[Float[Array, "M columns"], Float[Array, "M N"]]:
    """Regressor rows ``[Pi(x), u, r (x) u]`` and targets ``Pi(y) - Pi(x)`` of all snapshots."""
    lifted = jax.vmap(jax.vmap(dictionary.lift))(data.states)
    now, then = lifted[:, :-1], lifted[:, 1:]
    blocks = [now, data.inputs]
    if feet_terms:
        # Each end's force meets its own contact point only: (x, z) x (F_x, F_z), front and rear.
        forces = data.inputs.reshape(*data.inputs.shape[:2], 2, 2)
        product = data.feet[:, None, :, :, None] * forces[..., None, :]
        blocks.append(product.reshape(*data.inputs.shape[:2], 8))
    Z = jnp.concatenate(blocks, axis=-1)
    return Z.reshape(-1, Z.shape[-1]), (then - now).reshape(-1, now.shape[-1])


def least_squares(
    Z: Float[Array, "M columns"], Y: Float[Array, "M N"]
) -> tuple[Float[Array, "columns N"], Int[Array, ""], Float[Array, "columns"]]:
    """Minimum-norm solution W of Z W = Y in the scaled columns, its rank and singular values."""
    norm = jnp.linalg.norm(Z, axis=0)
    scale = jnp.where(norm > 0, norm, 1.0)
    Q, R = jnp.linalg.qr(Z / scale)
    left, sigma, right = jnp.linalg.svd(R)
    keep = sigma > sigma[0] * max(Z.shape) * jnp.finfo(Z.dtype).eps
    inverse = jnp.where(keep, 1.0 / jnp.where(keep, sigma, 1.0), 0.0)
    W = right.T @ (inverse[:, None] * (left.T @ (Q.T @ Y)))
    return W / scale[:, None], keep.sum(), sigma


def fit(
    dictionary: Dictionary, data: Snapshots, *, feet_terms: bool = False
) -> tuple[LinearModel, FitReport]:
    """Linear model of one contact mode and a report; ``vmap`` it over modes, seeds, ranges.

    Args:
      dictionary: observables.
      data: snapshots of that mode.
      feet_terms: fit the dependence of B on the contact points as well (they must vary).
    """
    N = dictionary.size
    Z, Y = regressors(dictionary, data, feet_terms=feet_terms)
    W, rank, sigma = least_squares(Z, Y)
    K = W.T
    B_feet = jnp.zeros((4, N, 4), K.dtype)
    if feet_terms:
        # (end, coordinate, force) -> column of u: front forces are 0 and 1, rear ones 2 and 3.
        products = K[:, N + 4 :].reshape(N, 2, 2, 2)
        B_feet = B_feet.at[0:2, :, 0:2].set(jnp.moveaxis(products[:, 0], 1, 0))
        B_feet = B_feet.at[2:4, :, 2:4].set(jnp.moveaxis(products[:, 1], 1, 0))
    model = LinearModel(A=jnp.eye(N, dtype=K.dtype) + K[:, :N], B=K[:, N : N + 4], B_feet=B_feet)
    residual = (Y - Z @ W)[:, 1:7]
    smallest = jnp.min(jnp.where(jnp.arange(sigma.shape[0]) < rank, sigma, jnp.inf))
    report = FitReport(
        rank=rank,
        columns=jnp.asarray(Z.shape[1]),
        condition=sigma[0] / smallest,
        condition_full=sigma[0] / sigma[-1],
        residual_rms=jnp.sqrt(jnp.mean(residual**2, axis=0)),
        finite=jnp.isfinite(Z).all() & jnp.isfinite(Y).all() & jnp.isfinite(W).all(),
    )
    return model, report


def build_dictionary(config: KoopmanConfig) -> Dictionary:
    """The dictionary that a config names."""
    return paper(
        config.order,
        literal=config.dictionary == "paper_literal",
        constant_rotation=config.constant_rotation,
    )


def srb_params(
    config: SrbConfig, mode_feet: Mapping[Mode, tuple[Point, Point]] | None = None
) -> srb.SrbParams:
    """Body parameters of every contact mode, stacked on a leading axis.

    Args:
      config: mass, inertia and the contact points of the modes that ``mode_feet`` leaves out.
      mode_feet: (front, rear) contact points (x, z) of single modes, body frame [m].
    """
    feet = np.tile(np.array([config.feet_front, config.feet_rear], float), (len(Mode), 1, 1))
    for mode, points in (mode_feet or {}).items():
        feet[mode] = points
    return srb.SrbParams(
        mass=jnp.full(len(Mode), config.mass, float),
        inertia=jnp.full(len(Mode), config.inertia, float),
        feet=jnp.asarray(feet, float),
    )


def fit_modes(
    body: srb.SrbParams,
    config: KoopmanConfig,
    key: PRNGKeyArray,
    *,
    ranges: SampleRanges | None = None,
) -> tuple[LinearModel, FitReport]:
    """One model per contact mode from random rollouts, all modes in one vmapped call.

    Args:
      body: parameters of the rigid body in every mode, stacked (``srb_params``).
      config: dictionary, dataset and kind of contact points.
      key: random key, usually of ``config.dataset.seed``; an argument, since XLA would evaluate
        the whole data set of a constant one while it compiles.
      ranges: sampling ranges in place of the config's.

    Returns:
      Model and report, each with a leading axis over ``types.Mode``.
    """
    dictionary = build_dictionary(config)
    data = config.dataset
    vary_feet = config.feet == "measured"
    limits = ranges_from_config(data, vary_feet=vary_feet) if ranges is None else ranges

    def one(key: Array, alpha: Array, body: srb.SrbParams) -> tuple[LinearModel, FitReport]:
        snapshots = sample(
            key,
            body,
            alpha,
            limits,
            rollouts=data.rollouts,
            steps=round(data.duration / data.dt),
            dt=data.dt,
            hold=data.hold,
        )
        return fit(dictionary, snapshots, feet_terms=vary_feet)

    keys = jax.random.split(key, len(MODE_ALPHA))
    return jax.vmap(one)(keys, jnp.asarray(MODE_ALPHA, float), body)
