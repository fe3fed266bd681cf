"""What figures need of an episode, thinned and in single precision: small enough to keep of all."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kjax.sim.trajectory import Trajectory

PERIOD = 0.005  # s between two samples, a control tick by default


class Series(NamedTuple):
    """A ``Trajectory`` thinned to one sample per ``PERIOD``; fields as there.

    Attributes:
      time: (N,) [s].
      x: (N, 6) SRB state [m, rad, m/s, rad/s].
      foot_force: (N, 4) [N].
      stance: (N, 4) scheduled stance.
      gait: (N,) index of the gait.
      velocity_command: (N,) [m/s].
      velocity_reference: (N,) [m/s].
    """

    time: np.ndarray
    x: np.ndarray
    foot_force: np.ndarray
    stance: np.ndarray
    gait: np.ndarray
    velocity_command: np.ndarray
    velocity_reference: np.ndarray


def save_series(run: Trajectory, path: Path) -> None:
    """Write the series of a run to an ``.npz``, whole or not at all.

    Args:
      run: sampled at the physics rate, or from a batch at the control rate.
      path: of the file.
    """
    every = max(1, round(PERIOD / run.dt))
    values = {name: np.asarray(getattr(run, name))[::every] for name in Series._fields}
    single: dict[str, Any] = {
        name: value.astype(np.float32) if value.dtype == np.float64 else value
        for name, value in values.items()
    }
    scratch = path.with_name(f".{path.name}.part.npz")
    np.savez_compressed(scratch, **single)
    scratch.replace(path)


def load_series(path: Path) -> Series:
    """Read what ``save_series`` wrote."""
    with np.load(path) as data:
        return Series(**{name: data[name] for name in Series._fields})
