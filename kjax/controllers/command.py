"""What of a command a controller follows; the rest is refused, or told while it runs."""

from collections.abc import Mapping, Sequence

import numpy as np

from kjax.types import COMMAND_NAMES

FOLLOWED = ("v_x", "height")
V_X, V_Y, YAW_RATE, HEIGHT, ROLL, PITCH = range(len(COMMAND_NAMES))
# Columns that have no effect.
IGNORED = np.array([name not in FOLLOWED for name in COMMAND_NAMES])


def check_command(columns: Mapping[str, Sequence[float]], *, planar: bool) -> None:
    """Refuse a command that a controller does not follow.

    Args:
      columns: values by name of the column.
      planar: whether it is the planar controller; the spatial one follows all columns.

    Raises:
      ValueError: naming the column, for a value that is not finite, and for one other than 0 where
        the controller follows none.
    """
    for name, values in columns.items():
        if not np.isfinite(values).all():
            raise ValueError(f"command.{name}: got {list(values)}, wanted finite values")
        if planar and name not in FOLLOWED and np.any(values):
            raise ValueError(
                f"command.{name}: got {list(values)}, but the planar controller follows "
                f"{' and '.join(FOLLOWED)} only; leave it at 0, or set controller = 'spatial'"
            )
