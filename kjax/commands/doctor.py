"""``kjax doctor``: what this installation has, what it misses, and the command that remedies it."""

import importlib.metadata
import importlib.util
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

import kjax
from kjax import cli
from kjax.commands.main import EXTRAS
from kjax.config.shipped import shipped_names
from kjax.options import Options, parse

# Package on the index -> the extra that brings it; "" for the core's.
PACKAGES = {
    "jax": "", "jaxlib": "", "numpy": "", "pydantic": "", "tyro": "",
    "mujoco": "sim", "mujoco-mjx": "sim", "filelock": "sim",
    "matplotlib": "viz", "imageio": "viz", "imageio-ffmpeg": "viz",
    "xarray": "sweep", "h5netcdf": "sweep", "optax": "learn", "cma": "learn",
}  # fmt: skip
RENDERERS = ("egl", "osmesa", "glfw")  # values of MUJOCO_GL, as tried
_DRAW = (
    "import mujoco; model = mujoco.MjModel.from_xml_string('<mujoco/>'); "
    "renderer = mujoco.Renderer(model, 16, 16); "
    "renderer.update_scene(mujoco.MjData(model)); renderer.render(); print('drawn')"
)


class Finding(NamedTuple):
    """A line of the report: what was looked at, what was found, and the remedy, if anything."""

    what: str
    found: str
    remedy: str = ""


def main(argv: Sequence[str] | None = None) -> int:
    """Print the report; exit code 1 if something that ``kjax run`` needs is missing."""
    parse(Options, argv, "What this installation has, what it misses, and the remedy.")
    needed = True
    for finding in findings():
        print(f"{finding.what:16} {finding.found}")
        if finding.remedy:
            needed = needed and not finding.remedy.startswith("pip install 'kjax[sim")
            print(f"{'':16} -> {finding.remedy}")
    return 0 if needed else 1


def findings() -> Iterator[Finding]:
    """The report, line by line: the slow parts last."""
    yield Finding("kjax", f"{kjax.__version__}, in {Path(kjax.__file__).parent}")
    yield Finding("python", f"{platform.python_version()}, {platform.platform()}")
    yield from packages()
    names = shipped_names()
    yield Finding("configs", f"{len(names)} shipped",
                  "" if names else "pip install --force-reinstall kjax")  # fmt: skip
    yield threads()
    yield compile_cache()
    yield devices()
    yield graphics()


def packages() -> Iterator[Finding]:
    """Versions of what kjax uses, the missing ones by extra."""
    found: list[str] = []
    missing: dict[str, list[str]] = {}
    for name, extra in PACKAGES.items():
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.setdefault(extra, []).append(name)
    yield Finding("packages", ", ".join(found))
    for extra, names in missing.items():
        command = f"pip install 'kjax[{extra}]'" if extra in EXTRAS else "pip install kjax"
        yield Finding("missing", ", ".join(names), command)


def threads() -> Finding:
    """Cores, and how many threads XLA would use."""
    from kjax.threads import usable_cores

    cores = usable_cores()
    chosen = os.environ.get("NPROC")
    text = f"{cores} cores, NPROC {'= ' + chosen if chosen else 'not set'}"
    if chosen is None:
        return Finding("threads", text, "in your own programs set NPROC=1 before JAX starts: a "
                       "controller's small kernels run up to four times as fast")  # fmt: skip
    return Finding("threads", text)


def compile_cache() -> Finding:
    """Where compiled programs are kept, and how much of them."""
    given = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    folder = Path(given) if given else cli.compilation_cache()
    if folder is None:
        return Finding("compile cache", "none: compiled programs are not kept",
                       "set JAX_COMPILATION_CACHE_DIR to a folder of your own")  # fmt: skip
    files = [file for file in folder.rglob("*") if file.is_file()] if folder.is_dir() else []
    size = sum(file.stat().st_size for file in files) / 1e6
    return Finding("compile cache", f"{folder}, {len(files)} files, {size:.0f} MB")


def devices() -> Finding:
    """What JAX computes on."""
    try:
        found = ", ".join(f"{one.platform} ({one.device_kind})" for one in jax.devices())
    except RuntimeError as error:
        return Finding("devices", f"JAX does not start: {str(error).splitlines()[0]}",
                       "JAX_PLATFORMS=cpu leaves accelerators out")  # fmt: skip
    nvidia = Path("/proc/driver/nvidia/version").exists()
    if nvidia and jax.default_backend() == "cpu":
        return Finding("devices", f"{found}; an NVIDIA driver is here, its GPU is not used",
                       "pip install 'kjax[cuda12]'")  # fmt: skip
    return Finding("devices", found)


def graphics() -> Finding:
    """Which of MuJoCo's ways to draw without a window works, for videos."""
    if importlib.util.find_spec("mujoco") is None:
        return Finding("graphics", "not tried: no mujoco")
    chosen = os.environ.get("MUJOCO_GL")
    tried = (chosen,) if chosen else RENDERERS
    for name in tried:
        done = subprocess.run(
            [sys.executable, "-c", _DRAW],
            env={**os.environ, "MUJOCO_GL": name},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode == 0 and "drawn" in done.stdout:
            return Finding("graphics", f"MUJOCO_GL={name} draws")
    return Finding("graphics", f"none of {', '.join(tried)} draws: no videos",
                   "install a renderer, such as libegl1 or libosmesa6")  # fmt: skip
