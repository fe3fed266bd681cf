"""What every engine takes and returns: configs of one spec, a ``Recording``."""

import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, Literal, Protocol

import numpy as np

from kjax.config import RunConfig
from kjax.lookup import look_up
from kjax.sim.recording import Recording
from kjax.sim.resolve import BatchSpec, batch_spec

Torques = Literal["every_step", "held"]
# Called from time to time with the robot-ticks (or steps) done and those in all.
OnProgress = Callable[[int, int], None]


class Engine(Protocol):
    """Closed loops of configs that share a spec.

    Attributes:
      spec: what all configs have in common.
    """

    spec: BatchSpec

    def __init__(
        self,
        config: RunConfig,
        *,
        torques: Torques = "every_step",
        threads: int | None = None,
        dtype: Any = np.float32,
    ):
        """An engine for configs like this one.

        Args:
          config: one of those to come.
          torques: computed at every ``leg.act_dt``, or once per control tick and held.
          threads: at most; as many as cores if ``None``.
          dtype: floating type of the controller.
        """

    def run(self, configs: Sequence[RunConfig], on_progress: OnProgress | None = None) -> Recording:
        """Closed loops of all configs, each until its end or its fall."""
        ...

    @staticmethod
    def check(config: RunConfig, torques: Torques) -> None:
        """Raise a ValueError that says why the engine cannot walk a config, if it cannot."""


def get_engine(name: str) -> type[Engine]:
    """An engine by its name: of a module beside this one, or ``"module:NAME"`` for one's own.

    Raises:
      ValueError: for a name that is none.
    """
    import kjax.sim.engines as package

    modules = sorted(one.name for one in pkgutil.iter_modules(package.__path__))
    known = {one: f"{package.__name__}.{one}:ENGINE" for one in modules if one != "contract"}
    engine: type[Engine] = look_up("engine", name, known, type)
    return engine


def check_delay(config: RunConfig, torques: Torques) -> None:
    """Refuse a delay that ends between two calls of the controller."""
    held, delay = torques == "held", config.sim.delay
    name, tick = (
        ("lmpc.control_dt", config.lmpc.control_dt) if held else ("leg.act_dt", config.leg.act_dt)
    )
    if abs(delay / tick - round(delay / tick)) > 1e-6:
        raise ValueError(
            f"with torques = '{torques}' sim.delay must be a multiple of {name} {tick} s, got "
            f"{delay} s"
        )


def ticks_of(config: RunConfig) -> int:
    """Control ticks of an episode."""
    per_tick = round(config.lmpc.control_dt / config.sim.sim_dt)
    return -(-round(config.duration / config.sim.sim_dt) // per_tick)


def require_one_spec(spec: BatchSpec, configs: Sequence[RunConfig]) -> None:
    """Raise a ValueError that says which config needs another engine, and why."""
    if not configs:
        raise ValueError("configs must hold at least one config, got none")
    for i, config in enumerate(configs):
        if batch_spec(config) != spec:
            raise ValueError(
                f"configs[{i}] needs another engine: {_difference(batch_spec(config), spec)}"
            )


def require_one_batch(spec: BatchSpec, configs: Sequence[RunConfig], torques: Torques) -> None:
    """The same, of configs that walk at once: they have one duration."""
    require_one_spec(spec, configs)
    for i, config in enumerate(configs):
        if config.duration != configs[0].duration:
            raise ValueError(
                f"configs[{i}].duration is {config.duration} s, the first one's "
                f"{configs[0].duration} s; one batch has one duration"
            )
        check_delay(config, torques)


def _difference(one: BatchSpec, first: BatchSpec) -> str:
    """Where two specs differ."""
    for part in ("scene", "controller"):
        own, other = (getattr(spec, part) for spec in (one, first))
        for entry in fields(own):
            values = [getattr(spec, entry.name) for spec in (own, other)]
            if values[0] != values[1]:
                return f"{part}.{entry.name} is {values[0]!r}, the engine's {values[1]!r}"
    return "it has another spec"
