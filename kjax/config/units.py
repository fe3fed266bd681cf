"""Units that scale with the robot, so that one config suits robots of all sizes.

A key that is marked with a ``Unit`` is written in powers of the robot's weight m g, its leg length
L (thigh and calf) and the time sqrt(L / g). ``in_si`` reads a config in SI units, for one robot.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from kjax.config.checks import Unit
from kjax.config.gaits import GaitConfig, Gaits
from kjax.config.run import RunConfig
from kjax.types import GRAVITY, RobotParams


class Scale(NamedTuple):
    """What the units of a config are for one robot.

    Attributes:
      weight: m g [N].
      length: of thigh and calf together [m].
      time: sqrt(length / g) [s].
    """

    weight: float
    length: float
    time: float

    def of(self, unit: Unit) -> Any:
        """One of a unit in SI units, or one of each of its components."""
        factors = [
            self.weight**weight * self.length**length * self.time**time
            for weight, length, time in unit.powers
        ]
        return factors[0] if len(factors) == 1 else np.stack(factors)


class InSi:
    """A view of a config, or of an ``Overlay``, whose values are in SI units; see ``in_si``."""

    def __init__(self, section: Any, cls: type, scale: Scale):
        """View of a section of class ``cls``."""
        self._section, self._cls, self._scale = section, cls, scale

    def __getattr__(self, name: str) -> Any:
        """A section, or a value in SI units; ``None`` stays."""
        info = self._cls.__pydantic_fields__[name]  # type: ignore[attr-defined]
        value, kind = getattr(self._section, name), info.annotation
        if kind is Gaits:
            return _GaitsInSi(value, self._scale)
        if dataclasses.is_dataclass(kind):
            return InSi(value, kind, self._scale) if _scales(kind) else value  # type: ignore[arg-type]
        for mark in info.metadata:
            if isinstance(mark, Unit) and value is not None:
                return (np.asarray(value) if isinstance(value, tuple) else value) * self._scale.of(
                    mark
                )
        return value


class _GaitsInSi(Mapping[str, InSi]):
    """The gaits of a config, each in SI units."""

    def __init__(self, gaits: Any, scale: Scale):
        self._gaits, self._scale = gaits, scale

    def __getitem__(self, name: str) -> InSi:
        return InSi(self._gaits[name], GaitConfig, self._scale)

    def __iter__(self) -> Iterator[str]:
        return iter(self._gaits)

    def __len__(self) -> int:
        return len(self._gaits)


def robot_scale(robot: RobotParams) -> Scale:
    """Weight, leg length and sqrt(L / g) of a robot."""
    length = float(robot.thigh_length + robot.calf_length)
    return Scale(float(robot.mass) * GRAVITY, length, math.sqrt(length / GRAVITY))


def in_si(config: Any, robot: RobotParams) -> Any:
    """A config as what is below ``resolve`` takes it: every value in SI units.

    Args:
      config: of a run, or an ``Overlay`` with traced values.
      robot: that it is for.
    """
    return InSi(config, RunConfig, robot_scale(robot))


def _scales(cls: type) -> bool:
    """Whether a class of sections has keys whose units scale with the robot."""
    fields = cls.__pydantic_fields__.values()  # type: ignore[attr-defined]
    return any(isinstance(mark, Unit) for info in fields for mark in info.metadata)
