"""Models from episodes of the whole robot: what a rigid body on planted feet misses of it.

A closed-loop episode, its forces perturbed so that they are not only feedback (``noise.force``),
becomes transitions of one control tick, each in the contact mode that the gait asks for. What is
left of them by the planted rigid body,

    x+ - planted(x, u) = W[mode] phi(x, u, contact points, place in the gait),

is fitted per contact mode: masses of legs that move within the body, joint friction and armature,
contacts that give way. Only rows in which exactly the scheduled feet touch the ground, and none of
them slips, tell about it: the few steps around a touchdown, and the one foot in a hundred that
slides off an obstacle, hold most of the residual and nothing of it in common.

Forces are recorded per leg in the body frame; the model wants them per end (front, rear), as the
planner gives both legs of an end the same one.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax import srb
from kjax.koopman import regression
from kjax.koopman.families import Start
from kjax.koopman.features import Features, Moment, affine
from kjax.types import MODE_ALPHA, STATE_DIM, Mode

TOUCH = 5.0  # N, foot force above which a foot touches the ground
SLIDE = 0.1  # m/s, speed of a standing foot that slips; one that rolls moves at 0.02


class Episode(NamedTuple):
    """What is needed of one robot's episode, at the beginning of each control tick.

    Attributes:
      x: (T, 6) true state of the whole-body centre of mass [m, rad, m/s, rad/s].
      feet: (T, 4, 2) foot centres (x, z), world [m].
      force: (T, 4, 2) planned force (x, z) on each leg for the tick, body frame [N].
      stance: (T, 4) scheduled stance.
      foot_force: (T, 4) normal force on the contact sensors [N].
      disturbed: (T,) whether something else pushes the robot during the tick.
    """

    x: Float[np.ndarray, "T 6"]
    feet: Float[np.ndarray, "T 4 2"]
    force: Float[np.ndarray, "T 4 2"]
    stance: Bool[np.ndarray, "T 4"]
    foot_force: Float[np.ndarray, "T 4"]
    disturbed: Bool[np.ndarray, "T"]


class Transitions(NamedTuple):
    """Steps of one control tick, M of them, in the order of time, episode after episode.

    Attributes:
      x: (M, 6) state [m, rad, m/s, rad/s].
      x_next: (M, 6) state one tick later.
      u: (M, 4) force of one front and one rear leg during the tick, body frame [N].
      u_before: (M, 4) the same legs' force in the tick before; 0 for one that was in the air [N].
      ground: (M, 2, 2) contact points (front, rear), world; of an end that no foot of stands, its
        swing feet [m].
      level: (M,) height of the ground under the feet that stand, or stood last [m].
      mode: (M,) contact mode scheduled.
      next_mode: (M,) contact mode of the phase that follows.
      elapsed: (M,) time since the phase began [s].
      left: (M,) time until it ends, this tick included [s].
      new: (M,) whether other feet stand than in the tick before.
      held: (M,) whether all feet scheduled to stand touch the ground, at both ends of the tick.
      clear: (M,) whether no other foot does.
      still: (M,) whether no standing foot slips.
      disturbed: (M,) whether something else pushes the robot.
      episode: (M,) number of the episode.
      tick: (M,) number of the tick in it.
    """

    x: Float[np.ndarray, "M 6"]
    x_next: Float[np.ndarray, "M 6"]
    u: Float[np.ndarray, "M 4"]
    u_before: Float[np.ndarray, "M 4"]
    ground: Float[np.ndarray, "M 2 2"]
    level: Float[np.ndarray, "M"]
    mode: Int[np.ndarray, "M"]
    next_mode: Int[np.ndarray, "M"]
    elapsed: Float[np.ndarray, "M"]
    left: Float[np.ndarray, "M"]
    new: Bool[np.ndarray, "M"]
    held: Bool[np.ndarray, "M"]
    clear: Bool[np.ndarray, "M"]
    still: Bool[np.ndarray, "M"]
    disturbed: Bool[np.ndarray, "M"]
    episode: Int[np.ndarray, "M"]
    tick: Int[np.ndarray, "M"]

    @property
    def planted(self) -> Bool[np.ndarray, "M"]:
        """Rows that a model of feet on the ground can be told from (M,)."""
        return self.held & self.clear & self.still & ~self.disturbed

    def rows(self, which: np.ndarray) -> "Transitions":
        """Some of the rows."""
        return Transitions(*(field[which] for field in self))


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


def transitions(
    episodes: Sequence[Episode], *, dt: float, sole: float, numbers: Sequence[int] | None = None
) -> Transitions:
    """Transitions of episodes; a phase that the end of the episode cuts off is left out.

    Args:
      episodes: of robots.
      dt: control tick [s].
      sole: height of a foot's centre above its contact point [m].
      numbers: of the episodes; 0, 1, ... if ``None``.

    Raises:
      ValueError: if no episode holds a whole phase, or legs stand that no contact mode has.
    """
    numbers = range(len(episodes)) if numbers is None else numbers
    parts = [
        part
        for number, episode in zip(numbers, episodes, strict=True)
        if (part := _of_episode(episode, number, dt, sole)) is not None
    ]
    if not parts:
        raise ValueError("episodes must hold at least one whole phase of a gait, got none")
    return Transitions(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def split(
    episodes: Int[np.ndarray, "E"], *, share: float = 0.3, seed: int = 0
) -> tuple[Int[np.ndarray, "A"], Int[np.ndarray, "B"]]:
    """Episodes to fit on and episodes held out, whole ones, each in rising order.

    Args:
      episodes: their numbers.
      share: of those held out [-].
      seed: of the draw.
    """
    if not 0 < share < 1:
        raise ValueError(f"share must lie between 0 and 1, got {share}")
    drawn = np.random.default_rng(seed).permutation(np.unique(episodes))
    out = max(1, round(share * len(drawn)))
    if len(drawn) <= out:
        raise ValueError(f"a share of {share} of {len(drawn)} episodes leaves none to fit on")
    return np.sort(drawn[out:]), np.sort(drawn[:out])


def start_at(x: Float[Array, "6"], ground: Float[Array, "2 2"]) -> Start:
    """The start of a prediction with feet at given contact points, world frame."""
    return Start(x, (ground - x[:2]) @ srb.planar_rotation(x[2]))


def fit(
    data: Transitions,
    body: srb.SrbParams,
    *,
    dt: float,
    features: Features = affine,
    rows: Bool[np.ndarray, "M"] | None = None,
    steps: int = 1,
    ridge: float = 0.0,
    least: int = 200,
) -> Fit:
    """Residual weights of each contact mode by least squares.

    With several ``steps`` the residuals and the features are summed over so many ticks in a row:
    W then fits the drift of the prediction rather than each tick, in which what one tick loses to
    the give of a contact and the next one gets back is noise that outweighs it.

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
        solved = _solve(_triangle(Z, Y), size, ridge=ridge)
        W, rank = np.asarray(solved.W), int(solved.rank)
        out.W[mode], out.rows[mode], out.rank[mode] = W.T, len(Z), rank
        out.columns[mode] = Z.any(axis=0).sum()
        out.condition[mode] = solved.sigma[0] / solved.sigma[rank - 1]
        out.before[mode] = np.sqrt(np.mean(residual[here] ** 2, axis=0))
        out.after[mode] = np.sqrt(np.mean((residual[here] - phi[here] @ W) ** 2, axis=0))
    return out


def force_gains(
    fit: Fit, data: Transitions, body: srb.SrbParams, *, dt: float, features: Features = affine
) -> Float[np.ndarray, "modes 2"]:
    """How much of a held force reaches the velocity, F_x on v_x and F_z on v_z (modes, 2) [-].

    1 is the rigid body's. A robot whose joints were pushed in mid-stance gave 0.85 and 0.87 to
    0.92; feedback in the data shows as less. NaN for modes without a fit.
    """

    def next_state(u: Array, W: Array, x: Array, ground: Array, mode: Array, moment: Any) -> Array:
        phi = read(features, x, u, ground, mode, moment._replace(u_before=u))
        return planted(body, mode, ground, x, u, dt) + W @ phi

    slope = jax.jit(jax.jacfwd(next_state))
    out = np.full((len(Mode), 2), np.nan)
    for mode in np.flatnonzero((fit.rows > 0) & (np.arange(len(Mode)) != Mode.FLIGHT)):
        here = data.planted & (data.mode == mode)
        x, u, ground = (a[here].mean(axis=0) for a in (data.x, data.u, data.ground))
        x[0], ground[:, 0] = 0.0, (data.ground[here, :, 0] - data.x[here, :1]).mean(axis=0)
        moment = Moment(u, data.elapsed[here].mean(), data.left[here].mean())
        with_fit, without = (
            np.asarray(slope(u, W, x, ground, int(mode), moment))[3:5].reshape(2, 2, 2).sum(axis=1)
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
    moment: Moment,
) -> Float[Array, "F"]:
    """Features without what belongs to an end that does not stand.

    Its feet swing: what is fitted to their place would be used as if they stood there. So an idle
    end has no force and its contact point in the centre of mass, which gets no weight.
    """
    stands = jnp.asarray(MODE_ALPHA)[mode] > 0
    ground = jnp.where(stands[:, None], ground, x[:2])
    pressed = jnp.repeat(stands, 2)
    moment = moment._replace(u_before=jnp.where(pressed, moment.u_before, 0.0))
    return features(start_at(x, ground), x, jnp.where(pressed, u, 0.0), moment)


def _of_episode(episode: Episode, number: int, dt: float, sole: float) -> Transitions | None:
    """Transitions of one episode, ``None`` if it holds no whole phase."""
    stance = np.asarray(episode.stance, bool)
    new = np.r_[True, (stance[1:] != stance[:-1]).any(axis=1)]
    begins = np.flatnonzero(new)
    if len(begins) < 2:
        return None
    last = begins[-1]  # the first tick of the phase that is cut off
    phase = np.cumsum(new)[:last] - 1
    tick = np.arange(last)
    mode = _modes(stance)
    legs = stance.reshape(-1, 2, 2)
    ends = (np.asarray(episode.feet, float) - [0.0, sole]).reshape(-1, 2, 2, 2)
    ground = _mean_of(ends, np.where(legs.any(axis=2, keepdims=True), legs, True))
    force = np.asarray(episode.force, float).reshape(-1, 2, 2, 2)
    before = np.concatenate([np.zeros_like(force[:1]), force[:-1]])
    touch = np.asarray(episode.foot_force) > TOUCH
    held, clear = (touch | ~stance).all(axis=1), (~touch | stance).all(axis=1)
    # At the end of a tick that another phase follows, the feet of the tick itself count.
    held_after = (touch[1:] | ~stance[:-1]).all(axis=1)
    clear_after = (~touch[1:] | stance[:-1]).all(axis=1)
    moves = np.linalg.norm(np.diff(np.asarray(episode.feet, float), axis=0), axis=2)
    slips = (stance[:-1] & (moves > SLIDE * dt)).any(axis=1)
    return Transitions(
        x=np.asarray(episode.x[:last], float),
        x_next=np.asarray(episode.x[1 : last + 1], float),
        u=_mean_of(force, legs)[:last].reshape(-1, 4),
        u_before=_mean_of(before, legs)[:last].reshape(-1, 4),
        ground=ground[:last],
        level=_level(ends[..., 1], legs)[:last],
        mode=mode[:last],
        next_mode=mode[begins[phase + 1]],
        elapsed=dt * (tick - begins[phase]),
        left=dt * (begins[phase + 1] - tick),
        new=new[:last],
        held=held[:last] & held_after[:last],
        clear=clear[:last] & clear_after[:last],
        still=~slips[:last],
        disturbed=np.asarray(episode.disturbed[:last], bool),
        episode=np.full(last, number),
        tick=tick,
    )


def _modes(stance: Bool[np.ndarray, "T 4"]) -> Int[np.ndarray, "T"]:
    """Contact mode of each tick."""
    counts = stance.reshape(-1, 2, 2).sum(axis=2)
    same = (counts[:, None] == MODE_ALPHA).all(axis=2)
    if not same.any(axis=1).all():
        lost = stance[~same.any(axis=1)][0]
        raise ValueError(f"no contact mode has the legs {np.flatnonzero(lost).tolist()} in stance")
    return same.argmax(axis=1)


def _mean_of(
    ends: Float[np.ndarray, "T 2 2 2"], legs: Bool[np.ndarray, "T 2 2"]
) -> Float[np.ndarray, "T 2 2"]:
    """Mean over the chosen legs of each end, 0 without any."""
    weight = legs[..., None].astype(float)
    return (ends * weight).sum(axis=2) / np.maximum(weight.sum(axis=2), 1.0)


def _level(
    height: Float[np.ndarray, "T 2 2"], legs: Bool[np.ndarray, "T 2 2"]
) -> Float[np.ndarray, "T"]:
    """Mean height of the feet that stand, or stood last."""
    count = legs.sum(axis=(1, 2))
    mean = (height * legs).sum(axis=(1, 2)) / np.maximum(count, 1)
    last = np.maximum.accumulate(np.where(count > 0, np.arange(len(count)), -1))
    return np.where(last >= 0, mean[last], 0.0)


def _triangle(Z: Float[np.ndarray, "K c"], Y: Float[np.ndarray, "K t"]) -> regression.Triangle:
    """Triangle of the rows, in blocks of one size so that it compiles once."""
    triangle = regression.empty(Z.shape[1], Y.shape[1], jnp.asarray(Z).dtype)
    for first in range(0, len(Z), _BLOCK):
        parts = [a[first : first + _BLOCK] for a in (Z, Y)]
        fill = ((0, _BLOCK - len(parts[0])), (0, 0))  # rows of zeros change nothing
        triangle = _accumulate(triangle, *(np.pad(part, fill) for part in parts))
    return triangle._replace(rows=jnp.asarray(len(Z), triangle.R.dtype))


_BLOCK = 4096  # rows
_accumulate = jax.jit(regression.accumulate)
_solve = jax.jit(regression.solve, static_argnums=1)


def _rows(
    data: Transitions, body: srb.SrbParams, dt: float, features: Features
) -> tuple[np.ndarray, np.ndarray]:
    """Features (M, F) and one-step residuals (M, 6) of the planted body."""
    moment = Moment(data.u_before, data.elapsed, data.left)
    phi, nominal = _reader(features, dt)(body, data.x, data.u, data.ground, data.mode, moment)
    return np.asarray(phi), data.x_next - np.asarray(nominal)


@lru_cache(maxsize=64)
def _reader(features: Features, dt: float) -> Callable[..., tuple[Array, Array]]:
    """Compiled (body, x, u, ground, mode, moment) -> features and nominal next states of rows."""

    def one(
        body: srb.SrbParams, x: Array, u: Array, ground: Array, mode: Array, moment: Moment
    ) -> tuple[Array, Array]:
        phi = read(features, x, u, ground, mode, moment)
        return phi, planted(body, mode, ground, x, u, dt)

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0, 0, 0, 0)))


def planted(
    body: srb.SrbParams,
    mode: Int[Array, ""],
    ground: Float[Array, "2 2"],
    x: Float[Array, "6"],
    u: Float[Array, "4"],
    dt: float,
) -> Float[Array, "6"]:
    """State (6,) after ``dt`` of the rigid body on feet that stay on the ground."""
    alpha = jnp.asarray(MODE_ALPHA, x.dtype)[mode]
    return srb.rk4(lambda x: srb.planted_dynamics(body, alpha, ground, x, u), x, dt)


def _summed(
    values: Float[np.ndarray, "M n"], use: Bool[np.ndarray, "M"], data: Transitions, steps: int
) -> Float[np.ndarray, "K n"]:
    """Sums over ``steps`` rows in a row, all of them in use and of one phase of one episode."""
    if steps == 1:
        return values[use]
    first = np.arange(len(use) - steps + 1)
    after = first + steps - 1
    count = np.r_[0, np.cumsum(use)]
    same = data.episode[first] == data.episode[after]
    whole = (count[first + steps] - count[first] == steps) & same
    # One phase: no row after the first begins a new one.
    begun = np.r_[0, np.cumsum(data.new)]
    whole &= begun[first + steps] == begun[first + 1]
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values * use[:, None], 0)])
    return (total[first + steps] - total[first])[whole]
