"""Output folders, settings of JAX and provenance of the experiments.

A user's mistake ends with exit code 2 and one line; nothing here is imported by the library.
"""

import json
import multiprocessing
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NoReturn

import jax
import tomli_w

from kjax.config import ConfigError, to_dict
from kjax.moved import moved_names
from kjax.options import Options, fail
from kjax.threads import one_blas_thread

__getattr__ = moved_names(__name__)

_PACKAGES = ("kjax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")


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
    one_blas_thread()
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


def output_folder(args: Options, default: str) -> Path:
    """The folder to write to, made and probed; ends the program where it is not writable."""
    config = getattr(args, "config", None)
    name = Path(config).stem if config else default
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


def save_study(
    folder: Path,
    record: dict[str, Any],
    text: str,
    draw: Callable[[Path], None],
    *,
    file: str = "metrics.json",
) -> None:
    """What a study leaves: its results with their provenance, a table and a figure; says so.

    Args:
      folder: of the study.
      record: its results.
      text: the table, Markdown.
      draw: writes the figure to a path.
      file: name of the results' file.
    """
    save_json(folder / file, {"provenance": provenance(), **record})
    write_text(folder / "table.md", text)
    draw(folder / "figure.png")
    print(f"\n{text}\nresults in {folder}/: {file}, table.md, figure.png")


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
