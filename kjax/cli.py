"""Command line, output folders and provenance of the experiments.

A user's mistake ends with exit code 2 and one line; nothing here is imported by the library.
"""

import argparse
import difflib
import json
import multiprocessing
import os
import platform
import subprocess
import sys
import tomllib
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import jax
import tomli_w

from kjax.config import ConfigError, GaitConfig, RunConfig, fields, load_config, to_dict
from kjax.config.gaits import LIBRARY
from kjax.config.loading import replacement_of
from kjax.robots import get_robot

T = TypeVar("T")

_PACKAGES = ("kjax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")


def fail(message: str) -> NoReturn:
    """Print one line to stderr and end with exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


class _Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        fail(message)


def run(main: Callable[[Sequence[str] | None], int], argv: Sequence[str] | None = None) -> NoReturn:
    """End the program with the exit code of a script's ``main``.

    Ctrl-C, a full disk and a bad config end it without a traceback.

    Args:
      main: takes the words of the command line; returns the exit code.
      argv: those words; of this process if ``None``.
    """
    try:
        code = main(argv)
    except KeyboardInterrupt:
        print("interrupted before there was anything to keep", file=sys.stderr)
        raise SystemExit(130) from None
    except OSError as error:
        fail(f"{error.filename or 'output'}: {error.strerror or error}")
    except ConfigError as error:  # what only shows when a config is put to use
        fail(str(error))
    raise SystemExit(code)


def script_parser(description: str) -> argparse.ArgumentParser:
    """Parser with ``--out`` for a script that takes no config; its errors are one line too."""
    parser = _Parser(description=description, allow_abbrev=False)
    parser.add_argument("--out", type=Path, help="output folder (default: in results/)")
    parser.set_defaults(config=None)
    return parser


def parse_study(
    argv: Sequence[str] | None,
    description: str,
    names: Sequence[str],
    *,
    counts: Mapping[str, tuple[int, str]],
    base: str,
    quick: str,
    default_out: str,
) -> argparse.Namespace:
    """Command line of a script that runs many episodes; a mistake ends the program.

    Args:
      argv: words of the command line; of this process if ``None``.
      description: of the script.
      names: of its parts, for ``--only``.
      counts: options that are integers from 1 on: default and help.
      base: default of ``--base``.
      quick: help of ``--quick``.
      default_out: folder in results/.

    Returns:
      The options; ``bases`` lists those that are asked for.
    """
    parser = script_parser(description)
    parser.add_argument("--only", nargs="+", default=list(names), metavar="NAME",
                        help=f"of: {', '.join(names)} (default: all)")  # fmt: skip
    whole = {**counts, "jobs": (2, "worker processes, one core each")}
    for name, (default, text) in whole.items():
        text = f"{text} (default: {default})"
        parser.add_argument(f"--{name}", type=int, default=default, help=text)
    parser.add_argument("--base", choices=("planar", "free", "both"), default=base,
                        help=f"of the trunk (default: {base})")  # fmt: skip
    parser.add_argument("--quick", action="store_true", help=quick)
    args = parser.parse_args(argv)
    for name in args.only:
        if name not in names:
            fail(f"--only: got '{name}', wanted some of {', '.join(names)}")
    require(args, *whole, least=1)
    args.out = args.out or Path("results") / default_out
    args.bases = ("planar", "free") if args.base == "both" else (args.base,)
    return args


def require(
    args: argparse.Namespace, *names: str, least: float | None = None, above: float | None = None
) -> None:
    """End the program where an option is out of range; one that was not given passes."""
    for name in names:
        value, option = getattr(args, name), f"--{name.replace('_', '-')}"
        if value is None:
            continue
        if least is not None and not value >= least:
            fail(f"{option}: got {value}, wanted at least {least:g}")
        if above is not None and not value > above:
            fail(f"{option}: got {value}, wanted more than {above:g}")


def build_parser(cls: type, description: str) -> argparse.ArgumentParser:
    """Parser with the config file, ``--out`` and one option per config key."""
    parser = _Parser(
        description=description,
        allow_abbrev=False,
        usage="%(prog)s [CONFIG.toml] [options] [--any.config.key VALUE ...]",
    )
    parser.add_argument("config", nargs="?", help="TOML file; without it, the defaults below")
    parser.add_argument("--out", type=Path, help="output folder (default: results/CONFIG)")
    sections: dict[str, Any] = {}
    for name, info, default in fields(cls):
        section = name.rsplit(".", 1)[0] if "." in name else "run"
        text = f"{info.description} default: {_shown(default)}"
        hidden = False
        if section.startswith("gaits."):  # the same keys for each of them
            hidden = section != "gaits.trot"
            section = f"gaits.NAME, of {', '.join(LIBRARY)}, or your own"
        if section not in sections:
            sections[section] = parser.add_argument_group(f"config: {section}")
        sections[section].add_argument(
            f"--{name}",
            dest=f"key:{name}",
            metavar=_type_name(info.annotation),
            help=argparse.SUPPRESS if hidden else text.replace("%", "%%"),
        )
    return parser


def _shown(default: Any) -> Any:
    return list(default) if isinstance(default, tuple) else default


def _add_own_gaits(parser: argparse.ArgumentParser, words: Sequence[str]) -> None:
    """Options for gaits that the command line names and the library has not."""
    own = {word.split(".")[1] for word in words if word.startswith("--gaits.") and "." in word[8:]}
    for gait in sorted(own - LIBRARY.keys()):
        for name, _, _ in fields(GaitConfig, f"gaits.{gait}."):
            parser.add_argument(f"--{name}", dest=f"key:{name}", help=argparse.SUPPRESS)


def parse(
    cls: type[T], parser: argparse.ArgumentParser, argv: Sequence[str] | None = None
) -> tuple[T, argparse.Namespace]:
    """Config and the other options from a command line; a mistake ends the program."""
    words = sys.argv[1:] if argv is None else argv
    if cls is RunConfig:
        _add_own_gaits(parser, words)
    known = [action.option_strings[0] for action in parser._actions if action.option_strings]
    # A value such as -0.1 or [-1, 2] must not look like an option.
    args, unknown = parser.parse_known_args(_join_values(words))
    for word in unknown:
        name = word.split("=")[0]
        became = replacement_of(name.removeprefix("--"))
        if became:
            fail(f"{name}: {became}")
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        fail(f"unknown option {name}" + (f"; did you mean {near[0]}?" if near else ""))
    overrides = {
        key.removeprefix("key:"): _value(text)
        for key, text in vars(args).items()
        if key.startswith("key:") and text is not None
    }
    try:
        config = load_config(cls, args.config, overrides)
        if isinstance(config, RunConfig):
            _require_walkable(config)
    except ValueError as error:
        fail(str(error))
    return config, args


def _require_walkable(config: RunConfig) -> None:
    """Raise a ValueError for a config that no controller can be made from, before it takes long."""
    from kjax.controllers.resolve_model import resolve_model
    from kjax.controllers.walkable import check_walkable

    resolve_model(config.koopman)
    with warnings.catch_warnings(action="ignore"):  # said again when the controller is made
        check_walkable(config, get_robot(config.robot).params)


def _join_values(words: Sequence[str]) -> list[str]:
    joined: list[str] = []
    for word in words:
        negative = word.startswith("-") and word[1:2] in "0123456789.i"
        if negative and joined and joined[-1].startswith("--") and "=" not in joined[-1]:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _value(text: str) -> Any:
    """A command-line value read as TOML, or as a plain string where it is none."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _type_name(annotation: Any) -> str:
    if typing.get_origin(annotation) is typing.Literal:
        return "{" + ",".join(str(option) for option in typing.get_args(annotation)) + "}"
    if typing.get_origin(annotation) is tuple:
        return "LIST"
    return getattr(annotation, "__name__", "VALUE").upper()


def configure_jax(
    *, one_core: bool = False, core: int | None = None, parallel: bool = False
) -> None:
    """JAX as the experiments want it: float64, compile cache on disk, synchronous dispatch.

    Call it before anything is computed.

    Args:
      one_core: bind the process to one core. A single robot's controller is many small kernels,
        which waking a second thread only delays.
      core: which of the cores that the process may use, counted round; by the process id if None.
      parallel: let XLA spread single operations over the cores, which large batches on MJX and
        large fits gain by. A controller's small kernels take up to four times as long then.
    """
    if one_core and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        number = os.getpid() if core is None else core
        os.sched_setaffinity(0, {cores[number % len(cores)]})
    # A pool of one thread spares small kernels the handing over. Where there are more, jaxlib
    # spreads a batch of LAPACK calls over the pool that it runs them in, and waits: with as many of
    # these at once as the pool has threads, nothing moves any more. So make it one or many.
    os.environ.setdefault("NPROC", str(max(8, 4 * (os.cpu_count() or 1))) if parallel else "1")
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    jax.config.update("jax_default_matmul_precision", "highest")  # MJX's too: no TF32 on a GPU
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = compilation_cache()
        jax.config.update("jax_compilation_cache_dir", None if folder is None else str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def compilation_cache() -> Path | None:
    """Folder of compiled programs, where it can be written; ``None`` with a note on stderr.

    A container may run as a user that has no name and no home folder. A shared folder such as /tmp
    is no substitute: what lies there would be executed.
    """
    chosen = os.environ.get("XDG_CACHE_HOME")
    try:
        folder = (Path(chosen) if chosen else Path.home() / ".cache") / "kjax" / "jax"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
        reason = f"{folder} cannot be written to"
    except RuntimeError:
        reason = "HOME is not set and the user has no entry"
    except OSError as error:
        reason = f"{error.filename}: {error.strerror}"
    if multiprocessing.parent_process() is None:
        print(
            f"note: compiled programs are not kept ({reason}); set JAX_COMPILATION_CACHE_DIR to a "
            "folder of your own",
            file=sys.stderr,
        )
    return None


def output_folder(args: argparse.Namespace, default: str) -> Path:
    """The folder to write to, made and probed; ends the program where it is not writable."""
    name = Path(args.config).stem if args.config else default
    folder: Path = args.out or Path("results") / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        fail(f"--out {folder}: cannot be written to: {error.strerror}")
    return folder


def provenance() -> dict[str, Any]:
    """Versions, git revision and machine, for the record of a run."""
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "created": datetime.now().astimezone().isoformat(timespec="seconds"),
        "git_revision": _git_revision(),
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cpus",
        "versions": versions,
    }


def _git_revision() -> str:
    """Revision of the checkout that this package lies in, '+' where it has local changes."""
    here = Path(__file__).resolve().parent
    try:
        return subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"],
            cwd=here,
            capture_output=True,
            text=True,
            check=True,
            timeout=5,
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def save_config(path: Path, config: Any) -> None:
    """Write the resolved config as TOML, with versions and revision in comments above it."""
    record = provenance()
    lines = [f"# {key}: {value}" for key, value in record.items() if key != "versions"]
    lines += [f"# {name} {number}" for name, number in record["versions"].items()]
    write_text(path, "\n".join(lines) + "\n\n" + tomli_w.dumps(_without_none(to_dict(config))))


def _without_none(data: dict[str, Any]) -> dict[str, Any]:
    """The data without what is ``None``: TOML has no word for it, and leaves it out."""
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in data.items()
        if value is not None
    }


def save_json(path: Path, data: Any) -> None:
    """Write JSON; NaN and infinity become null, since JSON has neither."""
    write_text(path, json.dumps(plain(data), indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    scratch = path.with_name(path.name + ".part")
    scratch.write_text(text, encoding="utf-8")
    scratch.replace(path)


def plain(value: Any) -> Any:
    """Plain data for JSON: lists for arrays and tuples, null for NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not (-1e308 < value < 1e308):
        return None
    return value
