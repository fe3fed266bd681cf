"""Benchmarks: medians, with a floor measured in the same run.

controller: latency of plan and act in the single-robot loop, beside an empty jitted call of the
same signature and the bare physics step; real-time factor; first and second start of the main job.
qp: the QP solvers on the QPs of closed loops, beside daqp, quadprog, OSQP, ProxQP, PIQP, Clarabel,
qpSWIFT and qpax, as far as these are installed; single, in a scan and batched.
simulation: closed loops per second on C MuJoCo and on MJX against the number of robots, beside the
bare engines and a Python loop over single robots; compile time, memory, two processes against one.
edmd: fits beside pykoopman and pykoop, the drawing of their data beside NumPy, 10^7 snapshots in a
stream; --peers names a Python that has the two.
gradient: gradients of a closed loop of 1 s on the rigid body, 200 QPs, against differences; time
and memory for 256 scenarios.
device: what a GPU gains: controllers, QPs, data and fits, closed loops on MJX, on each kind of
device of this machine.
"""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from kjax import cli
from kjax.bench.options import BenchOptions, ControllerOptions
from kjax.options import called, fail, parse, parse_config, program

# Each has ``run(folder, args)``, and ``OPTIONS``, their dataclass, where it has some of its own.
# They are imported when they are asked for: not everybody has what they need.
MODULES = {
    "qp": "kjax.bench.qp.benchmark",
    "simulation": "kjax.bench.simulation.benchmark",
    "edmd": "kjax.bench.edmd.benchmark",
    "gradient": "kjax.bench.gradient",
    "device": "kjax.bench.device",
}
BENCHMARKS = ("controller", *MODULES)


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run one benchmark; exit code 0 if it did."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in ("-h", "--help"):
        print(f"usage: {called()} {{{','.join(BENCHMARKS)}}} [options]\n\n{__doc__}")
        return 0
    if not words or words[0] not in BENCHMARKS:
        fail(f"which benchmark? one of: {', '.join(BENCHMARKS)}")
    with program(f"{called()} {words[0]}"):
        if words[0] == "controller":
            controller_benchmark(words[1:])
        else:
            benchmark(words[0], words[1:])
    return 0


def part(name: str) -> str:
    """What the module's head says of a benchmark."""
    text = " ".join(__doc__.split())
    begin = text.index(f" {name}: ") + 1
    others = [text.find(f" {other}: ", begin) for other in BENCHMARKS]
    return text[begin : min((end for end in others if end > 0), default=len(text))]


def controller_benchmark(words: Sequence[str]) -> None:
    """The benchmark that takes the config of a run."""
    config, args = parse_config(ControllerOptions, words, part("controller"))
    args.out = args.out or Path("results") / "benchmark_controller"
    folder = cli.output_folder(args, "benchmark")
    cli.configure_jax(one_core=True)
    from kjax.bench import controller

    result = controller.run(config, args)
    record = {"config": args.config, "provenance": cli.provenance(), **result}
    cli.save_json(folder / "metrics.json", record)
    print(f"results in {folder}/")


def benchmark(name: str, words: Sequence[str]) -> None:
    """One of ``MODULES``; leaves metrics.json, table.md and figure.png."""
    module = importlib.import_module(MODULES[name])
    args = parse(getattr(module, "OPTIONS", BenchOptions), words, part(name))
    args.out = args.out or Path("results") / f"benchmark_{name}"
    folder = cli.output_folder(args, f"benchmark_{name}")
    cli.configure_jax(one_core=name in ("qp", "edmd", "gradient"))
    result = module.run(folder, args)
    cli.save_json(folder / "metrics.json", {"provenance": cli.provenance(), **result})
    print((folder / "table.md").read_text(encoding="utf-8"))
    print(f"results in {folder}/")
