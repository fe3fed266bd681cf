"""Options that several benchmarks have."""

from dataclasses import dataclass

from kjax.options import Options, RunOptions


@dataclass(kw_only=True)
class BenchOptions(Options):
    """Options of a benchmark."""

    quick: bool = False
    """Less of it: to check the script."""


@dataclass(kw_only=True)
class ControllerOptions(RunOptions):
    """Options of the benchmark of the single-robot loop."""

    no_startup: bool = False
    """Leave out the start-up times."""
