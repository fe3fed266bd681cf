"""Run a whole sweep of closed loops: a grid or a random sample of configs, times seeds.

Leaves sweep.nc (labelled, xarray), summary.json, figure.png of what its [figure] asks for, both in
one index.html, and in cache/ a file per chunk, in the output folder. Run again, it goes on where it
stopped; finished, it only draws.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
from tyro.conf import Positional, arg

from kjax import cli
from kjax.config import ConfigError, SweepConfig, load_config, to_dict
from kjax.config.shipped import find_config
from kjax.options import Count, Options, Text, fail, parse, require


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run; exit code 0 if the sweep is finished."""
    sweep, args = _parse(argv)
    folder = args.out or Path("results") / "sweeps" / Path(args.config).stem
    if args.draw:
        draw(sweep, folder, args.config)
        return 0
    cli.configure_jax(parallel=sweep.engine == "mjx")
    jax.config.update("jax_enable_x64", sweep.precision == "float64")
    barrier = start_processes(args)
    process, processes = jax.process_index(), jax.process_count()

    from kjax.runs.cache import CacheError
    from kjax.runs.sweeps.runner import run_sweep

    clock = time.perf_counter()
    try:
        dataset = run_sweep(
            sweep,
            Path(args.config),
            folder,
            threads=args.threads,
            process=process,
            processes=processes,
            barrier=barrier,
            fresh=args.restart,
        )
    except (ConfigError, CacheError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        print(f"stopped; finished chunks are kept in {folder}/, run again to go on")
        return 130
    if dataset is None:
        return 0
    try:
        report(dataset, sweep, folder)
    except ValueError as error:
        fail(f"{args.config}: {error}")
    print(f"{time.perf_counter() - clock:.0f} s in all; results in {folder}/")
    return 0


@dataclass(kw_only=True)
class SweepOptions(Options):
    """Options of a sweep."""

    config: Annotated[str, Positional, arg(metavar="CONFIG")]
    """A shipped sweep's name, such as sweeps/trot_rough, or a TOML file of one."""

    engine: Text = None
    """Instead of the file's: mujoco_batch, mjx, mujoco."""

    torques: Annotated[
        Literal["every_step", "held"] | None,
        arg(metavar="{every_step,held}", help_behavior_hint=""),
    ] = None
    """Instead of the file's."""

    seeds: Count = None
    """Episodes per point, instead of the file's."""

    chunk: Count = None
    """Robots at once, instead of the file's."""

    threads: Count = None
    """Of the C engine; one per core if left out."""

    restart: bool = False
    """Drop all results that the folder holds."""

    draw: bool = False
    """Only draw the sweep.nc of a finished sweep."""

    distributed: bool = False
    """One of several processes, as Slurm or Open MPI tell."""

    coordinator: Text = None
    """The same by hand: HOST:PORT of process 0."""

    processes: Count = None
    """Their number."""

    process: Count = None
    """Number of this one, from 0 on."""


def _parse(argv: Sequence[str] | None) -> tuple[SweepConfig, SweepOptions]:
    """The sweep, with what the command line says instead of its file, and the other options."""
    args = parse(SweepOptions, argv, __doc__.splitlines()[0])
    require(args, "seeds", "chunk", "threads", least=1)
    given = {name: getattr(args, name) for name in ("engine", "torques", "seeds", "chunk")}
    try:
        args.config = str(find_config(args.config))
        sweep = load_config(
            SweepConfig, args.config, {k: v for k, v in given.items() if v is not None}
        )
    except ConfigError as error:
        fail(str(error))
    return sweep, args


def start_processes(args: SweepOptions) -> Any:
    """Join the other processes, if there are any; a barrier for them, or ``None``."""
    by_hand = [args.coordinator, args.processes, args.process]
    if not args.distributed and all(value is None for value in by_hand):
        return None
    if not args.distributed and any(value is None for value in by_hand):
        fail("--coordinator, --processes and --process: wanted all three, or --distributed")
    try:
        if args.distributed:
            jax.distributed.initialize()
        else:
            jax.distributed.initialize(args.coordinator, args.processes, args.process)
    except (RuntimeError, ValueError) as error:
        fail(f"jax.distributed: {str(error).splitlines()[0]}")
    from jax.experimental import multihost_utils

    return multihost_utils.sync_global_devices


def draw(sweep: SweepConfig, folder: Path, config: str) -> None:
    """Figure and summary of a finished sweep, from its dataset alone."""
    import xarray as xr

    try:
        with xr.open_dataset(folder / "sweep.nc") as dataset:
            require_sweep(dataset, sweep, folder)
            report(dataset.load(), sweep, folder)
    except (OSError, ValueError) as error:
        fail(f"--draw: {folder / 'sweep.nc'} with {config}: {error}")


# What decides which cases a sweep has, but for the number of their seeds.
CASES = ("base", "set", "sample", "sample_seed")
VALUES = ("values", "low", "high", "count")


def require_sweep(dataset: Any, sweep: SweepConfig, folder: Path) -> None:
    """End the program where the folder holds another sweep; figure, units and labels may differ."""

    def cases_of(spec: dict[str, Any]) -> Any:
        axes = {name: [axis[key] for key in VALUES] for name, axis in spec["axes"].items()}
        return json.loads(json.dumps([axes, *(spec[key] for key in CASES)]))

    try:
        held = cases_of(json.loads(dataset.attrs["sweep"]))
    except (KeyError, TypeError, ValueError):
        fail(f"--draw: {folder / 'sweep.nc'} does not say which sweep it is of")
    if held != cases_of(to_dict(sweep)):
        fail(f"--draw: {folder / 'sweep.nc'} holds another sweep: its base, axes or keys differ")


def report(dataset: Any, sweep: SweepConfig, folder: Path) -> None:
    """Draw the figure and print what came out, in one line."""
    from kjax.viz.sweep_plots import sweep_figure, sweep_summary

    sweep_figure(dataset, sweep, folder / "figure.png")
    record = {
        "provenance": json.loads(dataset.attrs["provenance"]),
        **sweep_summary(dataset, sweep),
    }
    cli.save_json(folder / "summary.json", record)
    save_page(folder, record, [summary_line(dataset)], drawn=sweep.figure is not None)
    print(summary_line(dataset))


def save_page(folder: Path, record: dict[str, Any], notes: list[str], *, drawn: bool) -> None:
    """The finished sweep as one file: its figure if it asks for one, a row for each point."""
    from kjax.viz.page import Page, write_page

    header, rows = points(record)
    count = record["episodes_per_point"]
    notes = [*notes, f"{count} episodes at each point; in parentheses the 95 % interval."]
    page = Page(
        title=f"Sweep {folder.name}", notes=notes, header=header, rows=rows,
        figures=[(folder / "figure.png", "What the sweep found")] if drawn else [],
        provenance=record["provenance"],
    )  # fmt: skip
    write_page(folder / "index.html", page)


def points(record: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header, and for each point of a summary the values of its axes and its metrics."""
    dims = record["dimensions"]
    metrics = [name for name, one in record.items() if isinstance(one, dict) and "value" in one]
    shape = np.shape(record[metrics[0]]["value"])
    # A random sample has one dimension, its points, along which every axis has a value.
    axes = dims if all(dim in record for dim in dims) else [
        name for name, one in record.items()
        if np.ndim(one) == 1 and len(one) == shape[0] and name not in (*metrics, "dimensions")
    ]  # fmt: skip
    rows = []
    for index in np.ndindex(*shape):
        own = index if axes is dims else index * len(axes)
        row = [_shown(record[axis][i]) for axis, i in zip(axes, own, strict=True)]
        for name in metrics:
            value, low, high = (_shown(np.asarray(record[name][part])[index]) for part in PARTS)
            row.append(f"{value} ({low} to {high})")
        rows.append(row)
    return [*axes, *metrics], rows


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float | int | np.number) else str(value)


PARTS = ("value", "low", "high")


def summary_line(dataset: Any) -> str:
    """What came out of all episodes, and what counts as a success."""
    from kjax.viz.sweep_plots import criterion, success

    good, fell = success(dataset), dataset["fell"] > 0
    text = f"{good.size} episodes, {int(good.sum())} succeeded ({criterion(dataset)}), "
    text += f"{int(fell.sum())} fell"
    if "velocity_rmse_mps" in dataset and not bool(fell.all()):
        median = float(dataset["velocity_rmse_mps"].where(~fell).median())
        text += f"; median RMSE of the others {median:.4f} m/s"
    return text


if __name__ == "__main__":
    cli.run(main)
