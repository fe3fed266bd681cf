"""What the sections share: strictness, kinds of numbers, and checks across keys."""

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


WEIGHT = Tunable(low=1e-12)
FORCE = Tunable(low=1.0, high=1000.0)
MIN_FORCE = Tunable(unit=10.0, low=-100.0, high=100.0)
HEIGHT = Tunable(low=0.15, high=0.33)
GAIN = Tunable(unit=0.02, high=0.5)
RATE = Tunable(unit=0.5, high=20.0)
FOOT_DISTANCE = Tunable(low=0.02, high=0.30)
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
    if not config.force_z_min <= config.force_z_max:
        raise ValueError(
            f"force_z_min must not exceed force_z_max, got {config.force_z_min} and "
            f"{config.force_z_max}"
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
