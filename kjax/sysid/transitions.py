"""Transitions of one control tick from closed-loop episodes of the whole robot.

Forces are recorded per leg in the body frame; the model wants them per end (front, rear), as the
planner gives both legs of an end the same one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from kjax.types import MODE_ALPHA

TOUCH = 5.0  # N, foot force above which a foot touches the ground
SLIDE = 0.1  # m/s, speed of a standing foot that slips; one that rolls moves at 0.02


class Episode(NamedTuple):
    """What is needed of one robot's episode, at the beginning of each control tick.

    Attributes:
      x: (T, 6) true state of the whole-body centre of mass [m, rad, m/s, rad/s].
      feet: (T, 4, 2) foot centres (x, z), world [m].
      force: (T, 4, 3) planned force (x, y, z) of each leg on the robot for the tick, axes of the
        plane that x and z are in [N].
      stance: (T, 4) scheduled stance.
      foot_force: (T, 4) normal force on the contact sensors [N].
      disturbed: (T,) whether something else pushes the robot during the tick.
    """

    x: Float[np.ndarray, "T 6"]
    feet: Float[np.ndarray, "T 4 2"]
    force: Float[np.ndarray, "T 4 3"]
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
      left: (M,) time left of it, this tick included [s].
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


def transitions(
    episodes: Sequence[Episode], *, dt: float, sole: float, ids: Sequence[int] | None = None
) -> Transitions:
    """Transitions of episodes; a phase that the end of the episode cuts off is left out.

    Args:
      episodes: of robots.
      dt: control tick [s].
      sole: height of a foot's centre above its contact point [m].
      ids: of the episodes; 0, 1, ... if ``None``.

    Raises:
      ValueError: if no episode holds a whole phase, or legs stand that no contact mode has.
    """
    ids = range(len(episodes)) if ids is None else ids
    parts = [
        part
        for number, episode in zip(ids, episodes, strict=True)
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
      episodes: their ids.
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
    feet = (np.asarray(episode.feet, float) - [0.0, sole]).reshape(-1, 2, 2, 2)
    ground = _mean_of(feet, np.where(legs.any(axis=2, keepdims=True), legs, True))
    force = _in_body(np.asarray(episode.force, float), np.asarray(episode.x, float)[:, 2])
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
        level=_level(feet[..., 1], legs)[:last],
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
    return (counts[:, None] == MODE_ALPHA).all(axis=2).argmax(axis=1)


def _in_body(
    force: Float[np.ndarray, "T 4 3"], pitch: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "T 2 2 2"]:
    """Forces (x, z) of the legs by pair, in the axes of the pitched body."""
    c, s = np.cos(pitch)[:, None], np.sin(pitch)[:, None]
    x, z = force[..., 0], force[..., 2]
    return np.stack([c * x + s * z, c * z - s * x], axis=-1).reshape(-1, 2, 2, 2)


def _mean_of(
    values: Float[np.ndarray, "T 2 2 2"], legs: Bool[np.ndarray, "T 2 2"]
) -> Float[np.ndarray, "T 2 2"]:
    """Mean over the chosen legs of each pair (front, rear), 0 without any."""
    weight = legs[..., None].astype(float)
    return (values * weight).sum(axis=2) / np.maximum(weight.sum(axis=2), 1.0)


def _level(
    height: Float[np.ndarray, "T 2 2"], legs: Bool[np.ndarray, "T 2 2"]
) -> Float[np.ndarray, "T"]:
    """Mean height of the feet that stand, or stood last."""
    count = legs.sum(axis=(1, 2))
    mean = (height * legs).sum(axis=(1, 2)) / np.maximum(count, 1)
    last = np.maximum.accumulate(np.where(count > 0, np.arange(len(count)), -1))
    return np.where(last >= 0, mean[last], 0.0)
