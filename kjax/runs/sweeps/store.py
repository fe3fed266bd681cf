"""Results of a sweep on disk: a manifest, a netCDF file per finished chunk, one of all at the end.

A chunk's file appears whole or not at all, and carries a checksum of its values.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from kjax import cli
from kjax.runs.sweeps.grid import Plan

_ENGINE = "h5netcdf"
_UNITS = {"mps": "m/s", "deg": "deg", "m": "m", "s": "s", "nm": "N m", "fraction": "-"}
_MANIFEST = "manifest.json"


class StoreError(RuntimeError):
    """Results that cannot be used or written; the message names the folder or file and the cure."""


class Store:
    """The folder of one sweep.

    Attributes:
      folder: where it is.
      chunks: number of chunks in all.
      provenance: of the first run of this sweep.
    """

    def __init__(self, folder: Path, spec: Mapping[str, Any], code: str, chunks: int):
        """Open the folder of a sweep, or begin it.

        Args:
          folder: of the sweep.
          spec: the sweep's resolved config, and the base's.
          code: label of the code that simulates.
          chunks: number of chunks.

        Raises:
          StoreError: if the folder holds another sweep's results, or those of other code.
        """
        self.folder, self.chunks = folder, chunks
        (folder / "chunks").mkdir(parents=True, exist_ok=True)
        path = folder / _MANIFEST
        spec = json.loads(json.dumps(spec), parse_constant=str)  # JSON has no infinity
        if path.exists():
            old = _read_manifest(path)
            changed = sorted(_differences(old["spec"], spec))
            if changed:
                # The hash of the cases says something only where nothing else does.
                changed = [text for text in changed if not text.startswith("cases ")] or [
                    "a file that it names, or how its cases are made, has changed"
                ]
                raise StoreError(
                    f"{folder} holds results of another config ({'; '.join(changed[:3])}"
                    f"{'; ...' if len(changed) > 3 else ''}): give --out another folder, or "
                    "--restart to drop them"
                )
            if old["code"] != code:
                raise StoreError(
                    f"{folder} holds results of other code or versions ({old['code']}, now {code}):"
                    " give --out another folder, or --restart to drop them"
                )
            self.provenance: dict[str, Any] = old["provenance"]
        else:
            self.provenance = cli.provenance()
            cli.save_json(
                path,
                {"spec": spec, "code": code, "chunks": chunks, "provenance": self.provenance},
            )

    def path(self, chunk: int) -> Path:
        """File of a chunk."""
        return self.folder / "chunks" / f"{chunk:05d}.nc"

    def missing(self) -> list[int]:
        """Chunks that are not there.

        Raises:
          StoreError: naming a chunk's file that is damaged.
        """
        out = []
        for chunk in range(self.chunks):
            if self.path(chunk).exists():
                self.read(chunk)
            else:
                out.append(chunk)
        return out

    def write(self, chunk: int, data: Mapping[str, np.ndarray]) -> None:
        """Keep a chunk's values, one array (cases,) per metric."""
        dataset = xr.Dataset({name: ("case", value) for name, value in sorted(data.items())})
        dataset.attrs["sha256"] = _checksum(dataset)
        _write_whole(dataset, self.path(chunk))

    def read(self, chunk: int) -> xr.Dataset:
        """A chunk's values.

        Raises:
          StoreError: if the file is damaged.
        """
        path = self.path(chunk)
        try:
            with xr.open_dataset(path, engine=_ENGINE) as file:
                dataset = file.load()
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            raise StoreError(
                f"{path}: damaged ({error}); delete it and run again: only it is repeated"
            ) from None
        if dataset.attrs.get("sha256") != _checksum(dataset):
            raise StoreError(
                f"{path}: damaged (its checksum differs); delete it and run again: only it is "
                "repeated"
            )
        return dataset

    def merge(self, plan: Plan, order: np.ndarray, attributes: Mapping[str, Any]) -> xr.Dataset:
        """All chunks as one labelled dataset, also written as ``sweep.nc``.

        Args:
          plan: of the sweep.
          order: numbers of the cases, as the chunks hold them.
          attributes: for the record.
        """
        parts = [self.read(chunk) for chunk in range(self.chunks)]
        names = sorted({str(name) for part in parts for name in part.data_vars})
        variables: dict[str, Any] = {}
        for name in names:
            rows = [
                part[name].values if name in part else np.full(part.sizes["case"], np.nan)
                for part in parts
            ]
            whole = np.zeros(len(order))
            whole[order] = np.concatenate(rows)
            unit = _UNITS.get(name.rsplit("_", 1)[-1], "-")
            variables[name] = (plan.dims, whole.reshape(plan.shape), {"units": unit})
        coords = {
            name: (dims, values, {"units": unit})
            for name, (dims, values, unit) in plan.coords.items()
        }
        flat = {key: json.dumps(value) for key, value in attributes.items()}
        flat["provenance"] = json.dumps(self.provenance)
        dataset = xr.Dataset(variables, coords, attrs=flat)
        _write_whole(dataset, self.folder / "sweep.nc")
        return dataset


@contextmanager
def lock(folder: Path, name: str = "lock") -> Iterator[None]:
    """Keep the folder to this process; the system frees it however the process ends.

    Raises:
      StoreError: if another process has it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / name).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StoreError(
                f"{folder} is in use by another run; wait for it, or give --out another folder"
            ) from None
        yield


def restart(folder: Path) -> None:
    """Drop all results in a sweep's folder."""
    for path in [folder / _MANIFEST, folder / "sweep.nc", *(folder / "chunks").glob("*.nc")]:
        path.unlink(missing_ok=True)


def _write_whole(dataset: xr.Dataset, path: Path) -> None:
    """Write a file whole or not at all; a full disk is a StoreError."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        dataset.to_netcdf(scratch, engine=_ENGINE)
        with scratch.open("rb+") as file:
            os.fsync(file.fileno())
        scratch.replace(path)
    except OSError as error:
        scratch.unlink(missing_ok=True)
        raise StoreError(
            f"{path}: cannot be written ({error.strerror or error}); what was finished is kept, "
            "run again to go on"
        ) from None


def _checksum(dataset: xr.Dataset) -> str:
    digest = hashlib.sha256()
    for name in sorted(map(str, dataset.data_vars)):
        values = dataset[name].values
        digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for key in ("spec", "code", "provenance"):
            data[key]
    except (ValueError, KeyError, TypeError):
        raise StoreError(f"{path}: damaged; --restart begins afresh") from None
    return data


def _differences(old: Any, new: Any, key: str = "") -> Iterator[str]:
    """What differs between two specs, as text."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in dict.fromkeys([*old, *new]):
            path = f"{key}.{name}" if key else name
            yield from _differences(old.get(name), new.get(name), path)
    elif old != new:
        yield f"{key} was {old!r}, is {new!r}"


def columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """One float array per metric from a list of metrics; NaN where a metric is missing."""
    names = sorted({name for row in rows for name in row})

    def number(value: Any) -> float:
        return float("nan") if value is None else float(value)

    return {name: np.array([number(row.get(name)) for row in rows]) for name in names}
