"""The results of a sweep as one labelled dataset, which is also its file."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from kjax.runs.cache import CacheError
from kjax.runs.sweeps.grid import Plan

_ENGINE = "h5netcdf"
_UNITS = {"mps": "m/s", "deg": "deg", "m": "m", "s": "s", "nm": "N m", "fraction": "-"}


def merged(
    plan: Plan, rows: Sequence[Mapping[str, Any]], attributes: Mapping[str, Any]
) -> xr.Dataset:
    """All cases of a sweep as one dataset with labels and units.

    Args:
      plan: of the sweep.
      rows: metrics of each case, in its order.
      attributes: for the record.
    """
    variables: dict[str, Any] = {}
    for name, values in columns(rows).items():
        unit = _UNITS.get(name.rsplit("_", 1)[-1], "-")
        variables[name] = (plan.dims, values.reshape(plan.shape), {"units": unit})
    coords = {
        name: (dims, values, {"units": unit}) for name, (dims, values, unit) in plan.coords.items()
    }
    flat = {key: json.dumps(value) for key, value in attributes.items()}
    return xr.Dataset(variables, coords, attrs=flat)


def write(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset whole or not at all; a full disk is a CacheError."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        dataset.to_netcdf(scratch, engine=_ENGINE)
        with scratch.open("rb+") as file:
            os.fsync(file.fileno())
        scratch.replace(path)
    except OSError as error:
        scratch.unlink(missing_ok=True)
        raise CacheError(
            f"{path}: cannot be written ({error.strerror or error}); what was finished is kept, "
            "run again to go on"
        ) from None


def columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """One float array per metric from a list of metrics; NaN where a metric is missing."""
    names = sorted({name for row in rows for name in row})

    def number(value: Any) -> float:
        return float("nan") if value is None else float(value)

    return {name: np.array([number(row.get(name)) for row in rows]) for name in names}
