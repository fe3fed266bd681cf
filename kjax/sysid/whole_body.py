"""Models from episodes of the whole robot: what a rigid body on planted feet misses of it.

A closed-loop episode, its forces perturbed so that they are not only feedback (``noise.force``),
becomes transitions of one control tick, each in the contact mode that the gait asks for. What is
left of them by the planted rigid body,

    x+ - planted(x, u) = W[mode] phi(x, u, contact points, gait phase),

is fitted per contact mode: masses of legs that move within the body, joint friction and armature,
contacts that give way. Only rows in which exactly the scheduled feet touch the ground, and none of
them slips, tell about it: the few steps around a touchdown, and the one foot in a hundred that
slides off an obstacle, hold most of the residual and nothing of it in common.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax.dynamics import srb_planar
from kjax.koopman import regression
from kjax.prediction.families import Start
from kjax.prediction.features import Features, GaitPhase, affine
from kjax.sysid.transitions import Transitions
from kjax.types import MODE_ALPHA, STATE_DIM, Mode


class Fit(NamedTuple):
    """Weights of all contact modes, and how well they were determined.

    Attributes:
      W: (modes, 6, F) weights, zero where a mode has too few rows.
      rows: (modes,) rows of the fit.
      rank: (modes,) numerical rank of the scaled features.
      columns: (modes,) features that are not always 0.
      condition: (modes,) of these, singular values below the rank left out [-].
      before: (modes, 6) root mean square of the one-step residual of the planted body.
      after: (modes, 6) the same with the fit.
    """

    W: Float[np.ndarray, "modes 6 F"]
    rows: Int[np.ndarray, "modes"]
    rank: Int[np.ndarray, "modes"]
    columns: Int[np.ndarray, "modes"]
    condition: Float[np.ndarray, "modes"]
    before: Float[np.ndarray, "modes 6"]
    after: Float[np.ndarray, "modes 6"]


def start_at(x: Float[Array, "6"], ground: Float[Array, "2 2"]) -> Start:
    """The start of a prediction with feet at given contact points, world frame."""
    return Start(x, (ground - x[:2]) @ srb_planar.planar_rotation(x[2]))


def fit(
    data: Transitions,
    body: srb_planar.SrbParams,
    *,
    dt: float,
    features: Features = affine,
    rows: Bool[np.ndarray, "M"] | None = None,
    steps: int = 1,
    ridge: float = 0.0,
    least: int = 200,
) -> Fit:
    """Residual weights of each contact mode by least squares.

    Eight arguments: the data, the body, and options by keyword.

    With several ``steps`` the residuals and the features are summed over so many ticks in a row:
    W then fits the drift of the prediction rather than each tick, in which what one tick loses to
    contact compliance and the next one gets back is noise that outweighs it.

    Args:
      data: transitions of the episodes to fit on.
      body: mass and inertia of the planted body.
      dt: control tick [s].
      features: of the residual.
      rows: (M,) to use; those of ``Transitions.planted`` if ``None``.
      steps: ticks that a row of the least-squares problem sums over.
      ridge: penalty in scaled columns, ``regression.solve``'s [-].
      least: fewest rows that a mode is fitted on.
    """
    use = data.planted if rows is None else rows
    phi, residual = _rows(data, body, dt, features)
    modes, size = len(Mode), phi.shape[1]
    out = Fit(
        W=np.zeros((modes, STATE_DIM, size)),
        rows=np.zeros(modes, int),
        rank=np.zeros(modes, int),
        columns=np.zeros(modes, int),
        condition=np.full(modes, np.nan),
        before=np.full((modes, STATE_DIM), np.nan),
        after=np.full((modes, STATE_DIM), np.nan),
    )
    for mode in range(modes):
        here = use & (data.mode == mode)
        Z, Y = (_summed(a, here, data, steps) for a in (phi, residual))
        if len(Z) < least:
            continue
        solved = _solve(_qr_factor(Z, Y), size, ridge=ridge)
        W, rank = np.asarray(solved.W), int(solved.rank)
        out.W[mode], out.rows[mode], out.rank[mode] = W.T, len(Z), rank
        out.columns[mode] = Z.any(axis=0).sum()
        out.condition[mode] = solved.sigma[0] / solved.sigma[rank - 1]
        out.before[mode] = np.sqrt(np.mean(residual[here] ** 2, axis=0))
        out.after[mode] = np.sqrt(np.mean((residual[here] - phi[here] @ W) ** 2, axis=0))
    return out


def force_gains(
    fit: Fit,
    data: Transitions,
    body: srb_planar.SrbParams,
    *,
    dt: float,
    features: Features = affine,
) -> Float[np.ndarray, "modes 2"]:
    """How much of a held force reaches the velocity, F_x on v_x and F_z on v_z (modes, 2) [-].

    1 is the rigid body's. A robot whose joints were pushed in mid-stance gave 0.85 and 0.87 to
    0.92; feedback in the data shows as less. NaN for modes without a fit.
    """

    def next_state(u: Array, W: Array, x: Array, ground: Array, mode: Array, phase: Any) -> Array:
        phi = read(features, x, u, ground, mode, phase._replace(u_before=u))
        return planted(body, mode, ground, x, u, dt) + W @ phi

    slope = jax.jit(jax.jacfwd(next_state))
    out = np.full((len(Mode), 2), np.nan)
    for mode in np.flatnonzero((fit.rows > 0) & (np.arange(len(Mode)) != Mode.FLIGHT)):
        here = data.planted & (data.mode == mode)
        x, u, ground = (a[here].mean(axis=0) for a in (data.x, data.u, data.ground))
        x[0], ground[:, 0] = 0.0, (data.ground[here, :, 0] - data.x[here, :1]).mean(axis=0)
        phase = GaitPhase(u, data.elapsed[here].mean(), data.left[here].mean())
        with_fit, without = (
            np.asarray(slope(u, W, x, ground, int(mode), phase))[3:5].reshape(2, 2, 2).sum(axis=1)
            for W in (fit.W[mode], np.zeros_like(fit.W[mode]))
        )
        out[mode] = np.diag(with_fit) / np.diag(without)
    return out


def read(
    features: Features,
    x: Float[Array, "6"],
    u: Float[Array, "4"],
    ground: Float[Array, "2 2"],
    mode: Int[Array, ""],
    phase: GaitPhase,
) -> Float[Array, "F"]:
    """Features without what belongs to an end that does not stand.

    Its feet swing: what is fitted to their place would be used as if they stood there. So an idle
    end has no force and its contact point in the centre of mass, which gets no weight.
    """
    stands = jnp.asarray(MODE_ALPHA)[mode] > 0
    ground = jnp.where(stands[:, None], ground, x[:2])
    pressed = jnp.repeat(stands, 2)
    phase = phase._replace(u_before=jnp.where(pressed, phase.u_before, 0.0))
    return features(start_at(x, ground), x, jnp.where(pressed, u, 0.0), phase)


def _qr_factor(Z: Float[np.ndarray, "K c"], Y: Float[np.ndarray, "K t"]) -> regression.QrFactor:
    """QR factor of the rows, in blocks of one size so that it compiles once."""
    factor = regression.empty(Z.shape[1], Y.shape[1], jnp.asarray(Z).dtype)
    for first in range(0, len(Z), _BLOCK):
        parts = [a[first : first + _BLOCK] for a in (Z, Y)]
        fill = ((0, _BLOCK - len(parts[0])), (0, 0))  # rows of zeros change nothing
        factor = _accumulate(factor, *(np.pad(part, fill) for part in parts))
    return factor._replace(rows=jnp.asarray(len(Z), factor.R.dtype))


_BLOCK = 4096  # rows
_accumulate = jax.jit(regression.accumulate)
_solve = jax.jit(regression.solve, static_argnums=1)


def _rows(
    data: Transitions, body: srb_planar.SrbParams, dt: float, features: Features
) -> tuple[np.ndarray, np.ndarray]:
    """Features (M, F) and one-step residuals (M, 6) of the planted body."""
    phase = GaitPhase(data.u_before, data.elapsed, data.left)
    phi, nominal = _reader(features, dt)(body, data.x, data.u, data.ground, data.mode, phase)
    return np.asarray(phi), data.x_next - np.asarray(nominal)


@lru_cache(maxsize=64)
def _reader(features: Features, dt: float) -> Callable[..., tuple[Array, Array]]:
    """Compiled (body, x, u, ground, mode, phase) -> features and nominal next states of rows."""

    def one(
        body: srb_planar.SrbParams,
        x: Array,
        u: Array,
        ground: Array,
        mode: Array,
        phase: GaitPhase,
    ) -> tuple[Array, Array]:
        phi = read(features, x, u, ground, mode, phase)
        return phi, planted(body, mode, ground, x, u, dt)

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0, 0, 0, 0)))


def planted(
    body: srb_planar.SrbParams,
    mode: Int[Array, ""],
    ground: Float[Array, "2 2"],
    x: Float[Array, "6"],
    u: Float[Array, "4"],
    dt: float,
) -> Float[Array, "6"]:
    """State (6,) after ``dt`` of the rigid body on feet that stay on the ground."""
    alpha = jnp.asarray(MODE_ALPHA, x.dtype)[mode]
    return srb_planar.rk4(lambda x: srb_planar.planted_dynamics(body, alpha, ground, x, u), x, dt)


def _summed(
    values: Float[np.ndarray, "M n"], use: Bool[np.ndarray, "M"], data: Transitions, steps: int
) -> Float[np.ndarray, "K n"]:
    """Sums over ``steps`` rows in a row, all of them in use and of one phase of one episode."""
    if steps == 1:
        return values[use]
    first = np.arange(len(use) - steps + 1)
    last = first + steps - 1
    count = np.r_[0, np.cumsum(use)]
    same = data.episode[first] == data.episode[last]
    whole = (count[first + steps] - count[first] == steps) & same
    # One phase: no row after the first begins a new one.
    begun = np.r_[0, np.cumsum(data.new)]
    whole &= begun[first + steps] == begun[first + 1]
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values * use[:, None], 0)])
    return (total[first + steps] - total[first])[whole]
