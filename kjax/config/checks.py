"""What the sections share: strictness, ranges and units, and checks across keys."""

import difflib
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Annotated, Any

from pydantic import ConfigDict, Field

STRICT = ConfigDict(extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(gt=0)]
# The only quantities that may be infinite: bounds that a user wants to switch off.
Bound = Annotated[float, Field(allow_inf_nan=True)]
# Rows that a user may switch off by inf. Feet that hold no force along the ground balance nothing,
# and no joint gives more than its limit.
Friction = Annotated[float, Field(ge=0.05, allow_inf_nan=True)]
TorqueFraction = Annotated[float, Field(gt=0, allow_inf_nan=True)]


@dataclass(frozen=True, kw_only=True)
class Tunable:
    """That a parameter may be tuned by gradients, in which coordinate and range.

    Attributes:
      unit: a change that matters, of a parameter of either sign; ``None`` for its logarithm.
      low: least value.
      high: largest value.
    """

    unit: float | None = None
    low: float = 0.0
    high: float = inf


@dataclass(frozen=True, kw_only=True)
class Unit:
    """The unit of a key that scales with the robot, see ``kjax.config.units``.

    Attributes:
      text: as an error says it.
      powers: of weight m g, leg length L and time sqrt(L / g), one entry for each component.
    """

    text: str
    powers: tuple[tuple[int, int, int], ...]


FORCE = Unit(text="m g", powers=((1, 0, 0),))
LENGTH = Unit(text="L", powers=((0, 1, 0),))
DURATION = Unit(text="sqrt(L / g)", powers=((0, 0, 1),))
STIFFNESS = Unit(text="m g L / rad", powers=((1, 1, 0),))
DAMPING = Unit(text="m g L sqrt(L / g) / rad", powers=((1, 1, 1),))
LINEAR_DAMPING = Unit(text="m g / sqrt(g L)", powers=((1, -1, 1),))
STATE_COST = Unit(
    text="1 / (L^2, L^2, rad^2, g L, g L, g / L)",
    powers=((0, -2, 0), (0, -2, 0), (0, 0, 0), (0, -2, 2), (0, -2, 2), (0, 0, 2)),
)
POSITION_COST = Unit(text="1 / L^2", powers=((0, -2, 0),) * 3)
OMEGA_COST = Unit(text="L / g", powers=((0, 0, 2),) * 3)
VELOCITY_COST = Unit(text="1 / (g L)", powers=((0, -2, 2),) * 3)
INPUT_COST = Unit(text="1 / (m g)^2", powers=((-2, 0, 0),))
WRENCH_COST = Unit(
    text="1 for forces and 1 / L^2 for moments", powers=((0, 0, 0),) * 3 + ((0, -2, 0),) * 3
)

Six = tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]
Three = tuple[NonNegative, NonNegative, NonNegative]
COST = Tunable(low=1e-12)
GRF = Tunable(low=0.01, high=8.0)
MIN_GRF = Tunable(unit=0.08, low=-0.8, high=0.8)
HEIGHT = Tunable(low=0.35, high=0.775)
GAIN = Tunable(unit=0.1, high=2.4)
RATE = Tunable(unit=0.5, high=20.0)
FOOT_DISTANCE = Tunable(low=0.05, high=0.7)
TIME = Tunable(low=0.02, high=2.0)


def require_timeline(times: Sequence[float], name: str, values: Sequence[object]) -> None:
    """Refuse pieces in time that are not as many as their values, or not in order from 0 on."""
    if not times or len(times) != len(values):
        raise ValueError(
            f"times and {name} must be equally long and not empty, got {len(times)} and "
            f"{len(values)}"
        )
    if times[0] != 0.0:
        raise ValueError(f"times must start at 0, got {list(times)}")
    if any(b <= a for a, b in itertools.pairwise(times)):
        raise ValueError(f"times must increase, got {list(times)}")


def require_multiple(name: str, value: float, base_name: str, base: float) -> None:
    """Refuse a time that is not a whole multiple of another one [s]."""
    ratio = value / base
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
        raise ValueError(
            f"{name} must be a whole multiple of {base_name}, got {value} s and {base} s"
        )


def require_order(config: Any) -> None:
    """Refuse bounds of F_z that leave nothing between them."""
    if not config.grf_z_min <= config.grf_z_max:
        raise ValueError(
            f"grf_z_min must not exceed grf_z_max, got {config.grf_z_min} and {config.grf_z_max}"
        )


def require_fraction(config: Any) -> None:
    """Refuse a part of the joint torque limits above 1 that is not inf."""
    if 1.0 < config.torque_fraction < inf:
        raise ValueError(
            f"torque_fraction must be at most 1, or inf for no rows, got {config.torque_fraction}"
        )


def require_name(key: str, name: str, known: Iterable[str]) -> None:
    """Refuse a name that is none of those known, with the nearest of them."""
    known = list(known)
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise ValueError(f"{key}: got '{name}', wanted one of {', '.join(known)}{hint}")
