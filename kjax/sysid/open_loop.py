"""Predictions over recorded episodes: from a state, under the forces that were pressed.

A prediction sees the state and the feet at its start, the forces, and what the gait schedules. It
sees no later state, contact or foothold. Two ways into the future:

    frozen      the present contact mode and feet, as if they lasted: the paper's scheme
    scheduled   each tick in its scheduled mode; a foot about to land gets the contact point that
                feet have on average at that speed and pitch, ``Landing``
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from kjax.dynamics import srb_planar
from kjax.koopman.models import rollout
from kjax.prediction.families import Family, operating_point
from kjax.prediction.features import Features, GaitPhase, affine
from kjax.sysid.transitions import Transitions
from kjax.sysid.whole_body import planted, read, start_at
from kjax.types import MODE_ALPHA, STATE_DIM, Mode


class Windows(NamedTuple):
    """Stretches of episodes to predict, V of them, H ticks long.

    Attributes:
      x: (V, H + 1, 6) true states.
      u: (V, H, 4) force of one front and one rear leg [N].
      phase: (V, H, ...) gait phase.
      mode: (V, H) scheduled contact mode.
      new: (V, H) whether other feet stand than in the tick before.
      ground: (V, 2, 2) contact points at the start, world [m].
      level: (V,) height of the ground at the start [m].
      still: (V,) whether no standing foot slips.
      disturbed: (V,) whether something else pushes the robot meanwhile.
      episode: (V,) number of the episode.
    """

    x: Float[np.ndarray, "V H_plus_1 6"]
    u: Float[np.ndarray, "V H 4"]
    phase: GaitPhase
    mode: Int[np.ndarray, "V H"]
    new: Bool[np.ndarray, "V H"]
    ground: Float[np.ndarray, "V 2 2"]
    level: Float[np.ndarray, "V"]
    still: Bool[np.ndarray, "V"]
    disturbed: Bool[np.ndarray, "V"]
    episode: Int[np.ndarray, "V"]


class Landing(NamedTuple):
    """Where feet come down: x offset from the centre of mass, affine in theta, v and omega.

    Attributes:
      W: (modes, 5, 2) of (1, theta, v_x, v_z, omega) to front and rear [m].
    """

    W: Float[np.ndarray, "modes 5 2"]


def windows(data: Transitions, length: int, *, inside: bool, stride: int = 1) -> Windows:
    """Stretches of ``length`` ticks.

    Args:
      data: transitions.
      length: number H of ticks.
      inside: only stretches within one stance in which just the scheduled feet touch the ground;
        else all, flights and changes of feet included.
      stride: ticks from one to the next at least.
    """
    first = np.arange(max(len(data.tick) - length + 1, 0))[::stride]
    at = first[:, None] + np.arange(length)
    keep = data.episode[at[:, -1]] == data.episode[first]
    if inside:
        keep &= (data.held & data.clear)[at].all(axis=1)
        keep &= ~data.new[at[:, 1:]].any(axis=1) & (data.mode[first] != Mode.FLIGHT)
    at, first = at[keep], first[keep]
    return Windows(
        x=np.concatenate([data.x[at], data.x_next[at[:, -1:]]], axis=1),
        u=data.u[at],
        phase=GaitPhase(data.u_before[at], data.elapsed[at], data.left[at]),
        mode=data.mode[at],
        new=data.new[at],
        ground=data.ground[first],
        level=data.level[first],
        still=data.still[at].all(axis=1),
        disturbed=data.disturbed[at].any(axis=1),
        episode=data.episode[first],
    )


def fit_landing(data: Transitions) -> Landing:
    """Where feet come down in each contact mode, from the first tick of each phase."""
    W = np.zeros((len(Mode), 5, 2))
    for mode in range(len(Mode)):
        here = data.new & (data.mode == mode) & (data.tick > 0)
        if here.sum() < 10 or mode == Mode.FLIGHT:
            continue
        x = data.x[here]
        offset = data.ground[here, :, 0] - x[:, :1]
        seen = np.concatenate([np.ones((len(x), 1)), x[:, 2:]], axis=1)
        W[mode] = np.linalg.lstsq(seen, offset, rcond=None)[0]
    return Landing(W)


def predict(
    data: Windows,
    body: srb_planar.SrbParams,
    *,
    dt: float,
    W: Float[np.ndarray, "modes 6 F"] | None = None,
    features: Features = affine,
    landing: Landing | None = None,
) -> Float[np.ndarray, "V H_plus_1 6"]:
    """Predicted states from the start of each window.

    Args:
      data: windows.
      body: mass and inertia of the planted body.
      dt: control tick [s].
      W: weights of the residual; none if ``None``.
      features: they belong to.
      landing: where feet come down, to follow the schedule; frozen without it.
    """
    if W is None:
        W, features = np.zeros((len(Mode), STATE_DIM, 17)), affine
    step = _step(features, dt)
    params = (body, jnp.asarray(W), jnp.zeros((len(Mode), 5, 2)) if landing is None else landing.W)
    states = np.repeat(data.x[:, :1], data.u.shape[1] + 1, axis=1)
    for first in range(0, len(states), _BLOCK):
        rows = np.arange(first, first + _BLOCK) % len(states)  # filled up: one compilation
        count = min(_BLOCK, len(states) - first)
        x, ground = jnp.asarray(data.x[rows, 0]), jnp.asarray(data.ground[rows])
        for i in range(data.u.shape[1]):
            tick = _Tick(
                u=data.u[rows, i],
                mode=data.mode[rows, i if landing is not None else 0],
                # The feet at the start are seen, even where they have just come down.
                new=data.new[rows, i] & (i > 0) & (landing is not None),
                phase=jax.tree.map(lambda a, i=i, rows=rows: a[rows, i], data.phase),
                level=data.level[rows],
            )
            x, ground = step(params, x, ground, tick)
            states[first : first + count, i + 1] = np.asarray(x)[:count]
    return states


_BLOCK = 4096  # windows


class _Tick(NamedTuple):
    """One tick of windows; see ``Windows``."""

    u: Any
    mode: Any
    new: Any
    phase: GaitPhase
    level: Any


@lru_cache(maxsize=64)
def _step(features: Features, dt: float) -> Callable[..., tuple[Array, Array]]:
    """Compiled step of many windows: next states and contact points."""

    def step(
        params: tuple[srb_planar.SrbParams, Array, Array], x: Array, ground: Array, tick: _Tick
    ) -> tuple[Array, Array]:
        body, W, landing = params
        u, mode, new, phase, level = tick
        ground = jnp.where(new, _come_down(landing, mode, x, ground, level), ground)
        gain = W[mode] @ read(features, x, u, ground, mode, phase)
        return planted(body, mode, ground, x, u, dt) + gain, ground

    return jax.jit(jax.vmap(step, in_axes=(None, 0, 0, 0)))


def predict_as_lmpc(
    data: Windows,
    family: Family,
    params: Any,
    force: Float[Array, "modes 4"],
    *,
    steps: int,
    feet: Float[Array, "modes 2 2"] | None = None,
) -> Float[np.ndarray, "V H_plus_1 6"]:
    """Predicted states of any family as an LMPC uses it: linearised at the start, mode frozen.

    Args:
      data: windows.
      family: of the model.
      params: of every contact mode.
      force: about which it is linearised, body frame [N].
      steps: of the model in a control tick.
      feet: nominal contact points of every mode; those seen at the start if ``None`` [m].
    """

    def one(x: Array, ground: Array, u: Array, mode: Array, phase: GaitPhase) -> Array:
        here = jax.tree.map(lambda a: a[mode], params)
        start = start_at(x, ground)
        u_before, elapsed, left = (jnp.asarray(a) for a in phase)
        rate = jnp.pi / (elapsed + left)
        start = start._replace(
            feet=start.feet if feet is None else feet[mode],
            u_before=u_before,
            stance_phase=rate * elapsed,
            stance_phase_rate=rate,
        )
        model = operating_point(family, here, start, force[mode], steps)
        return rollout(model, family.lift(here, start), u, start.feet)

    run = jax.jit(jax.vmap(one))
    states = np.repeat(data.x[:, :1], data.u.shape[1] + 1, axis=1)
    for first in range(0, len(states), _BLOCK):
        rows = np.arange(first, first + _BLOCK) % len(states)
        phase = jax.tree.map(lambda a, rows=rows: jnp.asarray(a[rows, 0]), data.phase)
        values = run(data.x[rows, 0], data.ground[rows], data.u[rows], data.mode[rows, 0], phase)
        count = min(_BLOCK, len(states) - first)
        states[first : first + count] = np.asarray(values)[:count]
    return states


def squared_errors(
    data: Windows, predicted: Float[np.ndarray, "V H_plus_1 6"]
) -> dict[str, Float[np.ndarray, "V H"]]:
    """Squared errors of velocity [m^2/s^2], its parts, pitch rate [rad^2/s^2] and pitch [rad^2]."""
    error = (predicted - data.x)[:, 1:] ** 2
    return {
        "velocity": error[..., 3] + error[..., 4],
        "v_x": error[..., 3],
        "v_z": error[..., 4],
        "omega": error[..., 5],
        "theta": error[..., 2],
    }


def rms_ratio(
    errors: Float[np.ndarray, "V H"],
    nominal: Float[np.ndarray, "V H"],
    episode: Int[np.ndarray, "V"],
    *,
    draws: int = 1000,
    seed: int = 0,
) -> Float[np.ndarray, "3 H"]:
    """Ratio of root-mean-square errors, and its 95 % interval from a bootstrap over episodes.

    Args:
      errors: squared, of the model.
      nominal: squared, of what it is compared with.
      episode: (V,) number of each row's episode.
      draws: of the bootstrap.
      seed: of its random parameters.

    Returns:
      (3, H): ratio, lower and upper end.
    """
    names, which = np.unique(episode, return_inverse=True)
    sums = np.zeros((2, len(names), errors.shape[1]))
    for total, squared in zip(sums, (errors, nominal), strict=True):
        np.add.at(total, which, squared)
    rng = np.random.default_rng(seed)
    times = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=draws)
    drawn = np.sqrt((times @ sums[0]) / (times @ sums[1]))
    ratio = np.sqrt(sums[0].sum(axis=0) / sums[1].sum(axis=0))
    return np.stack([ratio, *np.quantile(drawn, [0.025, 0.975], axis=0)])


def _come_down(
    landing: Float[Array, "modes 5 2"], mode: Array, x: Array, ground: Array, level: Array
) -> Float[Array, "2 2"]:
    """Contact points of the feet of a phase that begins."""
    seen = jnp.concatenate([jnp.ones((1,), x.dtype), x[2:]])
    offset = seen @ landing[mode]
    fresh = jnp.stack([x[0] + offset, jnp.broadcast_to(level, (2,))], axis=1)
    stands = jnp.asarray(MODE_ALPHA)[mode] > 0
    return jnp.where(stands[:, None], fresh, ground)
