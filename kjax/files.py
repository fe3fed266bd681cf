"""Files that a config names: results depend on their content."""

import hashlib
import importlib
from pathlib import Path
from typing import Any

from kjax.prediction.storage import resolve
from kjax.robots import get_robot
from kjax.robots.foreign import is_foreign, model_file

# Config keys that name a file whose content a result depends on.
FILE_KEYS = ("koopman.file", "spatial.file")


def file_hashes(config: Any) -> dict[str, str]:
    """Hash of the content of every file that a config names: key -> hash; of none, "none".

    Of a robot or a kind of model of one's own: of its module, the robot's MJCF included. What such
    a module imports in its turn is not seen.
    """
    hashes = {}
    for key in FILE_KEYS:
        section, name = key.split(".")
        file = getattr(getattr(config, section, None), name, "")
        if file:
            path = resolve(file)
            hashes[key] = _hash(path.read_bytes()) if path.is_file() else "none"
    robot = getattr(config, "robot", "")
    if is_foreign(robot):
        hashes["robot"] = _hash(model_file(robot).read_bytes())
    elif ":" in robot:
        hashes["robot"] = own_module_hash(robot, _model_bytes(robot))
    model = getattr(getattr(config, "koopman", None), "model", "")
    if ":" in model:
        hashes["koopman.model"] = own_module_hash(model)
    return hashes


def _model_bytes(robot: str) -> bytes:
    """Content of the MJCF of a robot in a module; an MjSpec as it is written out."""
    mjcf = get_robot(robot).mjcf
    return mjcf.read_bytes() if hasattr(mjcf, "read_bytes") else mjcf.to_xml().encode()


def own_module_hash(name: str, more: bytes = b"") -> str:
    """Hash of the source of the module in ``"module:NAME"``; of kjax's own, "kjax"."""
    if ":" not in name:
        return "kjax"
    module = importlib.import_module(name.partition(":")[0])
    source = getattr(module, "__file__", None)
    return _hash(more + (Path(source).read_bytes() if source else b""))


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
