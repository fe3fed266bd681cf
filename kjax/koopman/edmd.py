"""EDMD: the least-squares operator K = [A, B] from snapshots (Eq. 5), solved robustly.

The paper writes K = G_1 G_2^-1 (Eq. 6, Eq. 7, Eq. 8) with G_2 = mean(Pi [Pi; u]^T), which is not
square; the regression wants the Gram matrix of the full regressor [Pi; u]. We do not form a Gram
matrix at all, since it squares the condition number: ``regression`` works on the R of a QR
factorisation, with the columns scaled to unit norm, and an SVD of that small factor reveals the
rank. The regression is on the increment Pi(y) - Pi(x), so that float32 keeps its digits at small
steps.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from kjax.dynamics import srb_planar
from kjax.koopman import regression
from kjax.koopman.checks import check_snapshots, require_dataset, require_rows, require_steps
from kjax.koopman.dataset import DatasetSpec, SampleRanges, Snapshots, sample, sample_ranges
from kjax.koopman.models import BilinearModel, LinearModel
from kjax.koopman.observables import (
    STATE_ROWS,
    Dictionary,
    fourier,
    lift_all,
    monomials,
    paper,
)
from kjax.precision import full_precision
from kjax.spec import DictionarySpec
from kjax.types import INPUT_DIM, MODE_ALPHA, Mode

__all__ = [
    "FitReport",
    "build_dictionary",
    "check_snapshots",
    "fit",
    "fit_bilinear",
    "fit_modes",
    "lift_all",
    "linear_model",
    "regressors",
    "spectrum",
    "srb_params",
]

Point = tuple[float, float]  # (x, z) [m]


class FitReport(NamedTuple):
    """How well posed the regression was; stacked over modes like the model.

    Attributes:
      rank: numerical rank of the scaled regressor [-].
      columns: its number of columns [-].
      condition: ratio of largest to smallest *retained* singular value [-].
      condition_full: the same over all of them; huge where columns repeat [-].
      residual_rms: (6,) one-step residual of each state [m, rad, m/s, rad/s].
      finite: whether the QR factor of all data, and so the data, and all coefficients are finite.
    """

    rank: Int[Array, ""]
    columns: Int[Array, ""]
    condition: Float[Array, ""]
    condition_full: Float[Array, ""]
    residual_rms: Float[Array, "6"]
    finite: Array


def regressors(
    dictionary: Dictionary,
    data: Snapshots,
    *,
    feet_terms: bool = False,
    bilinear: bool = False,
) -> tuple[Float[Array, "M columns"], Float[Array, "M N"]]:
    """Regressor rows and targets ``Pi(y) - Pi(x)`` of all snapshots.

    The rows are ``[Pi(x), u]``; with ``feet_terms`` ``[Pi(x), u, r (x) u]``, and ``bilinear``
    ``[Pi(x), Pi(x) (x) u]``, which holds u as the product with the constant.

    Raises:
      ValueError: for no rollouts, or rollouts too short for a step.
    """
    require_steps(data.states.shape, dictionary)
    data = Snapshots(*map(jnp.asarray, data))
    lifted = lift_all(dictionary, data.states)
    now, then = lifted[:, :-1], lifted[:, 1:]
    inputs = data.inputs[:, dictionary.window - 1 :]
    if bilinear:
        product = now[..., :, None] * inputs[..., None, :]
        blocks = [now, product.reshape(*inputs.shape[:2], -1)]
    else:
        blocks = [now, inputs]
    if feet_terms:
        # Each end's force meets its own contact point only: (x, z) x (F_x, F_z), front and rear.
        forces = inputs.reshape(*inputs.shape[:2], 2, 2)
        product = data.feet[:, None, :, :, None] * forces[..., None, :]
        blocks.append(product.reshape(*inputs.shape[:2], 8))
    Z = jnp.concatenate(blocks, axis=-1)
    return Z.reshape(-1, Z.shape[-1]), (then - now).reshape(-1, now.shape[-1])


@full_precision
def fit(
    dictionary: Dictionary,
    data: Snapshots,
    *,
    feet_terms: bool = False,
    ridge: float | Float[Array, ""] = 0.0,
    use: Bool[Array, "N"] | None = None,
) -> tuple[LinearModel, FitReport]:
    """Linear model of one contact mode and a report (Eq. 5); ``vmap`` it over modes, seeds, ranges.

        K = argmin sum_i |Pi(y_i) - Pi(x_i) - K [Pi(x_i); u_i]|^2,   A = I + K_Pi,   B = K_u

    Args:
      dictionary: observables.
      data: snapshots of that mode.
      feet_terms: fit the dependence of B on the contact points as well (they must vary).
      ridge: penalty of the weights in scaled columns [-].
      use: (N,) observables to use: many dictionaries in one ``vmap`` are cuts of a large one.

    Raises:
      ValueError: for no rollouts, and for fewer snapshots than regressors without a ridge.
    """
    N = dictionary.size
    Z, Y = regressors(dictionary, data, feet_terms=feet_terms)
    if use is None and isinstance(ridge, float | int) and ridge == 0:
        require_rows(*Z.shape)
    use = None if use is None else jnp.concatenate([use, jnp.ones((Z.shape[1] - N,), bool)])
    rows = regression.of_rows(Z, Y)
    weights = regression.solve(rows, Z.shape[1], ridge=ridge, use=use)
    return linear_model(weights.W, N), _report(rows, weights)


def linear_model(W: Float[Array, "columns N"], size: int) -> LinearModel:
    """The model that weights of ``[Pi(x), u]`` or ``[Pi(x), u, r (x) u]`` stand for."""
    K, N = W.T, size
    return LinearModel(
        A=jnp.eye(N, dtype=K.dtype) + K[:, :N], B=K[:, N : N + 4], B_feet=_feet_map(K[:, N + 4 :])
    )


@full_precision
def fit_bilinear(
    dictionary: Dictionary,
    data: Snapshots,
    *,
    feet_terms: bool = False,
    ridge: float | Float[Array, ""] = 0.0,
) -> tuple[BilinearModel, FitReport]:
    """Bilinear model of one contact mode and a report; arguments as of ``fit``."""
    N = dictionary.size
    Z, Y = regressors(dictionary, data, feet_terms=feet_terms, bilinear=True)
    if isinstance(ridge, float | int) and ridge == 0:
        require_rows(*Z.shape)
    rows = regression.of_rows(Z, Y)
    weights = regression.solve(rows, Z.shape[1], ridge=ridge)
    K = weights.W.T
    products, feet = K[:, N : N + 4 * N], K[:, N + 4 * N :]
    model = BilinearModel(
        A=jnp.eye(N, dtype=K.dtype) + K[:, :N],
        B=jnp.moveaxis(products.reshape(N, N, 4), 1, 0),
        B_feet=_feet_map(feet),
    )
    return model, _report(rows, weights)


def _feet_map(weights: Float[Array, "N f"]) -> Float[Array, "4 N 4"]:
    """B_feet from the weights of r (x) u, of which there may be none."""
    N = weights.shape[0]
    B_feet = jnp.zeros((4, N, 4), weights.dtype)
    if weights.shape[1] == 0:
        return B_feet
    # (end, coordinate, force) -> column of u: front forces are 0 and 1, rear ones 2 and 3.
    products = weights.reshape(N, 2, 2, 2)
    B_feet = B_feet.at[0:2, :, 0:2].set(jnp.moveaxis(products[:, 0], 1, 0))
    return B_feet.at[2:4, :, 2:4].set(jnp.moveaxis(products[:, 1], 1, 0))


def _report(rows: regression.QrFactor, weights: regression.Weights) -> FitReport:
    sigma, rank = weights.sigma, weights.rank
    smallest = jnp.min(jnp.where(jnp.arange(sigma.shape[0]) < rank, sigma, jnp.inf))
    return FitReport(
        rank=rank,
        columns=jnp.asarray(sigma.shape[0]),
        condition=sigma[0] / smallest,
        condition_full=sigma[0] / sigma[-1],
        residual_rms=regression.rms(rows, weights.W)[STATE_ROWS],
        finite=jnp.isfinite(rows.R).all() & jnp.isfinite(weights.W).all(),
    )


def spectrum(A: Float[np.ndarray, "N N"], dt: float) -> np.ndarray:
    """Eigenvalues of the transition as rates log(lambda) / dt [1/s], fastest growing first."""
    rates = np.log(np.linalg.eigvals(np.asarray(A, np.float64)).astype(complex)) / dt
    return rates[np.argsort(-rates.real)]


def build_dictionary(spec: DictionarySpec) -> Dictionary:
    """The dictionary that a spec names."""
    if spec.dictionary == "monomials":
        return monomials(spec.order)
    if spec.dictionary == "fourier":
        return fourier(spec.fourier_count, scale=spec.fourier_scale, seed=spec.fourier_seed)
    return paper(
        spec.order,
        literal=spec.dictionary == "paper_literal",
        constant_rotation=spec.constant_rotation,
    )


def srb_params(body: srb_planar.SrbParams) -> srb_planar.SrbParams:
    """Body parameters, the same in every contact mode: stacked over ``types.Mode``.

    Args:
      body: of one mode, as ``rigid_body.own_body`` gives it.
    """
    feet = np.tile(np.asarray(body.feet, float), (len(Mode), 1, 1))
    return stack_bodies(float(body.mass), float(body.inertia), feet)


def stack_bodies(
    mass: float, inertia: float, feet: Sequence[tuple[Point, Point]] | np.ndarray | Array
) -> srb_planar.SrbParams:
    """Body parameters with a leading axis.

    Args:
      mass: [kg].
      inertia: [kg m^2].
      feet: (n, 2, 2) front and rear contact points (x, z), body frame [m].
    """
    count = len(feet)
    leaves = np.full(count, mass, float), np.full(count, inertia, float), np.asarray(feet, float)
    return srb_planar.SrbParams(*jax.device_put(leaves))  # compiles nothing


@full_precision
def fit_modes(
    body: srb_planar.SrbParams,
    key: PRNGKeyArray,
    *,
    dictionary: DictionarySpec = DictionarySpec(),  # noqa: B008, it is frozen
    dataset: DatasetSpec = DatasetSpec(),  # noqa: B008
    measured_feet: bool = False,
    ranges: SampleRanges | None = None,
    modes: Sequence[Mode] = tuple(Mode),
) -> tuple[LinearModel, FitReport]:
    """One model per contact mode from random rollouts, all modes in one vmapped call.

    Args:
      body: parameters of the rigid body in every mode, stacked (``srb_params``).
      key: random key of the dataset; traced, since XLA would evaluate the whole dataset of a
        constant one while it compiles.
      dictionary: observables.
      dataset: size and ranges of the training data.
      measured_feet: whether the contact points vary, and B with them.
      ranges: sampling ranges in place of the dataset's own.
      modes: contact modes that ``body`` is stacked over; data of a mode are the same in any list.

    Returns:
      Model and report, each with a leading axis over ``modes``.
    """
    observables = build_dictionary(dictionary)
    require_dataset(dataset, observables.size + INPUT_DIM + (8 if measured_feet else 0))
    limits = sample_ranges(dataset, vary_feet=measured_feet) if ranges is None else ranges

    def one(key: Array, alpha: Array, body: srb_planar.SrbParams) -> tuple[LinearModel, FitReport]:
        snapshots = sample(
            key,
            body,
            alpha,
            limits,
            rollouts=dataset.rollouts,
            steps=dataset.steps,
            dt=dataset.dt,
            hold=dataset.hold,
        )
        return fit(observables, snapshots, feet_terms=measured_feet)

    chosen = np.array(modes)
    keys = jax.random.split(key, len(Mode))[chosen]
    return jax.vmap(one)(keys, jnp.asarray(MODE_ALPHA[chosen], float), body)
