"""What every engine takes and returns: configs of one spec, a ``Recording``."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Literal, Protocol

from kjax.config import RunConfig
from kjax.sim.recording import Recording
from kjax.sim.resolve import BatchSpec, batch_spec, check_engine

Torques = Literal["every_step", "held"]
# Called from time to time with the robot-ticks (or steps) done and those in all.
OnProgress = Callable[[int, int], None]


class Engine(Protocol):
    """Closed loops of configs that share a spec.

    Attributes:
      spec: what all configs have in common.
    """

    spec: BatchSpec

    def run(self, configs: Sequence[RunConfig], on_progress: OnProgress | None = None) -> Recording:
        """Closed loops of all configs, each until its end or its fall."""
        ...


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
        check_engine(config, torques=torques)


def _difference(one: BatchSpec, first: BatchSpec) -> str:
    """Where two specs differ."""
    for part in ("scene", "controller"):
        own, other = (getattr(spec, part) for spec in (one, first))
        for entry in fields(own):
            values = [getattr(spec, entry.name) for spec in (own, other)]
            if values[0] != values[1]:
                return f"{part}.{entry.name} is {values[0]!r}, the engine's {values[1]!r}"
    return "it has another spec"
