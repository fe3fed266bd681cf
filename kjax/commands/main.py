"""The command ``kjax``: its verbs, and what each of them starts.

    kjax run trot_velocity --lmpc.horizon 10

A verb is a module with ``main(argv) -> int``, imported when it is asked for.
"""

import difflib
import importlib
import importlib.util
import sys
from collections.abc import Sequence
from typing import NoReturn

from kjax import __version__, cli
from kjax.options import fail, program

# Verb -> module, and what it does in a line.
VERBS = {
    "run": ("kjax.studies.closed_loop", "walk a config in MuJoCo: metrics, figure, video"),
    "fit": ("kjax.studies.koopman_fit", "fit Koopman models and test them (the paper's Fig. 3)"),
    "sweep": ("kjax.studies.sweep", "closed loops over a grid or a sample of configs, times seeds"),
    "reproduce": ("kjax.studies.reproduce.study", "all of the paper's figures and results"),
    "envelope": (
        "kjax.studies.envelope",
        "limits of each gait: speed, blocks, pushes, friction",
    ),
    "tune": ("kjax.studies.tune.study", "tune weights by gradients through the closed loop"),
    "bench": ("kjax.bench.main", "benchmarks: controller, qp, simulation, edmd, gradient, device"),
    "study": ("kjax.commands.study", "other studies by name"),
    "robot": ("kjax.commands.robot", "what was read of a robot, and whether it walks"),
    "configs": ("kjax.commands.configs", "the shipped configs, or the text of one"),
    "doctor": ("kjax.commands.doctor", "versions, devices, graphics, cache: what is missing"),
}
# Extras without which a verb cannot end well; the others' modules say it when they are imported.
NEEDS = {"run": ("sim", "viz"), "fit": ("viz",), "sweep": ("sim", "sweep", "viz"),
         "reproduce": ("sim", "viz"), "envelope": ("sim", "viz"), "tune": ("sim", "learn", "viz"),
         "bench": ("sim", "viz"), "study": ("sim", "viz"),
         "robot": ("sim", "viz")}  # fmt: skip
# What is imported, and the extra that brings it.
EXTRAS = {
    "sim": ("mujoco", "filelock", "tqdm"),
    "viz": ("matplotlib", "imageio", "imageio_ffmpeg", "PIL", "jinja2"),
    "sweep": ("xarray", "h5netcdf", "h5py"),
    "learn": ("optax", "cma"),
    "dev": ("scipy", "daqp"),
}


def start() -> NoReturn:
    """Entry point of the console script."""
    cli.run(main)


def main(argv: Sequence[str] | None = None) -> int:
    """Start a verb with the words after it; returns its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return 0
    if words[0] in ("-V", "--version"):
        print(f"kjax {__version__}")
        return 0
    verb = words[0]
    if verb not in VERBS:
        near = difflib.get_close_matches(verb, VERBS, n=1)
        fail(f"kjax {verb}: no such command" + (f"; did you mean kjax {near[0]}?" if near else "")
             + " (kjax --help lists them)")  # fmt: skip
    if not {"-h", "--help"} & set(words):
        require_extras(f"kjax {verb}", NEEDS.get(verb, ()))
    return start_module(VERBS[verb][0], f"kjax {verb}", words[1:])


def require_extras(called: str, extras: Sequence[str]) -> None:
    """End the program, before it has spent any time, where a package of the extras is missing."""
    for extra in extras:
        for name in EXTRAS[extra]:
            if importlib.util.find_spec(name) is None:
                fail_missing(called, name, extra)


def fail_missing(called: str, name: str, extra: str) -> NoReturn:
    """Say which package is missing, and how to get it."""
    fail(f"{called} needs {name}; install it with: pip install 'kjax[all]' "
         f"(or the extra '{extra}' alone)")  # fmt: skip


def start_module(name: str, called: str, words: Sequence[str]) -> int:
    """Run a module's ``main``; a package that is not installed ends it in a line."""
    try:
        module = importlib.import_module(name)
        with program(called):
            return int(module.main(words))
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        extra = next((key for key, names in EXTRAS.items() if missing in names), None)
        if extra is None:
            raise
        fail_missing(called, missing, extra)


def usage() -> str:
    """What ``kjax --help`` prints."""
    verbs = "\n".join(f"  {verb:10} {text}" for verb, (_, text) in VERBS.items())
    return (
        "usage: kjax COMMAND [options]\n\n"
        "Koopman-operator linear MPC for quadrupeds: batched, differentiable, in MuJoCo.\n\n"
        f"{verbs}\n\n"
        "  kjax run trot_velocity           walks the paper's velocity profile\n"
        "  kjax run my.toml --duration 5    a config of your own; every key is an option\n"
        "  kjax COMMAND --help              the options of one of them"
    )
