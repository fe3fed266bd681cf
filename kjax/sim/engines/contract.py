"""What every engine takes and returns: episodes of one spec, a ``Recording``."""

import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, Literal, Protocol

import numpy as np

from kjax.lookup import look_up
from kjax.sim.episode import BatchSpec, Episode, EpisodeParams
from kjax.sim.recording import Recording

Torques = Literal["every_step", "held"]
# Called from time to time with the robot-ticks (or steps) done and those in all.
OnProgress = Callable[[int, int], None]


class Engine(Protocol):
    """Closed loops of episodes that share a spec.

    Attributes:
      spec: what all episodes have in common.
    """

    spec: BatchSpec

    def __init__(
        self,
        spec: BatchSpec,
        *,
        torques: Torques = "every_step",
        threads: int | None = None,
        dtype: Any = np.float32,
    ):
        """An engine for episodes of a spec.

        Args:
          spec: from ``sim.resolve.batch_spec``.
          torques: computed at every ``leg.act_dt``, or once per control tick and held.
          threads: at most; as many as cores if ``None``.
          dtype: floating type of the controller.
        """

    def run(self, episodes: Sequence[Episode], on_progress: OnProgress | None = None) -> Recording:
        """Closed loops of all episodes, each until its end or its fall."""
        ...

    @staticmethod
    def check(spec: BatchSpec, params: EpisodeParams, torques: Torques) -> None:
        """Raise a ValueError that says why the engine cannot walk an episode, if it cannot."""


def get_engine(name: str) -> type[Engine]:
    """An engine by its name: of a module beside this one, or ``"module:NAME"`` for one's own.

    Raises:
      ValueError: for a name that is none.
    """
    import kjax.sim.engines as package

    modules = sorted(one.name for one in pkgutil.iter_modules(package.__path__))
    known = {one: f"{package.__name__}.{one}:ENGINE" for one in modules if one != "contract"}
    engine: type[Engine] = look_up("engine", name, known, type)
    missing = [one for one in ("run", "check") if not callable(getattr(engine, one, None))]
    if missing:
        raise ValueError(f"engine: '{name}' has no {missing[0]}; see {__name__}.Engine")
    return engine


def check_delay(spec: BatchSpec, params: EpisodeParams, torques: Torques) -> None:
    """Refuse a delay that ends between two calls of the controller."""
    held, dt = torques == "held", spec.scene.sim_dt
    name, unit = ("lmpc.control_dt", spec.per_tick) if held else ("leg.act_dt", spec.per_act)
    if int(params.delay) % unit:
        raise ValueError(
            f"with torques = '{torques}' sim.delay must be a multiple of {name} {unit * dt:g} s, "
            f"got {int(params.delay) * dt:g} s"
        )


def require_options(spec: BatchSpec, torques: str) -> None:
    """Refuse what is no spec, and a name that is no ``Torques``."""
    if not isinstance(spec, BatchSpec):
        raise TypeError(
            f"spec: wanted kjax.sim.resolve.batch_spec(config), got {type(spec).__name__}"
        )
    if torques not in ("every_step", "held"):
        raise ValueError(f"torques must be 'every_step' or 'held', got {torques!r}")


def require_one_spec(spec: BatchSpec, episodes: Sequence[Episode]) -> None:
    """Raise a ValueError that says which episode needs another engine, and why."""
    if not episodes:
        raise ValueError("episodes must hold at least one episode, got none")
    for i, episode in enumerate(episodes):
        if not isinstance(episode, Episode):
            raise TypeError(
                f"episodes[{i}]: wanted an Episode of kjax.sim.resolve.resolve_episode, got "
                f"{type(episode).__name__}"
            )
        if episode.spec != spec:
            raise ValueError(
                f"episodes[{i}] needs another engine: {_difference(episode.spec, spec)}"
            )


def require_one_batch(spec: BatchSpec, episodes: Sequence[Episode], torques: Torques) -> None:
    """The same, of episodes that walk at once: they have one duration."""
    require_one_spec(spec, episodes)
    for i, episode in enumerate(episodes):
        if episode.ticks != episodes[0].ticks:
            raise ValueError(
                f"episodes[{i}] takes {episode.goal.duration} s, the first one "
                f"{episodes[0].goal.duration} s; one batch has one duration"
            )
        check_delay(spec, episode.params, torques)


def _difference(one: BatchSpec, first: BatchSpec) -> str:
    """Where two specs differ."""
    for part in ("scene", "controller"):
        own, other = (getattr(spec, part) for spec in (one, first))
        for entry in fields(own):
            values = [getattr(spec, entry.name) for spec in (own, other)]
            if values[0] != values[1]:
                return f"{part}.{entry.name} is {values[0]!r}, the engine's {values[1]!r}"
    return "it has another spec"
