"""Files that a config names: results depend on their content."""

import hashlib
import sys
from pathlib import Path
from typing import Any

from kjax.prediction.storage import resolve
from kjax.robots import get_robot

# Config keys that name a file whose content a result depends on.
FILE_KEYS = ("koopman.file",)


def file_hashes(config: Any) -> dict[str, str]:
    """Hash of the content of every file that a config names: key -> hash; of none, "none".

    Of a robot of one's own: of its module and its MJCF.
    """
    hashes = {}
    for key in FILE_KEYS:
        section, name = key.split(".")
        file = getattr(getattr(config, section, None), name, "")
        if file:
            path = resolve(file)
            hashes[key] = _hash(path.read_bytes()) if path.is_file() else "none"
    name = getattr(config, "robot", "")
    if ":" in name:
        mjcf = get_robot(name).mjcf.read_bytes()
        source = getattr(sys.modules[name.partition(":")[0]], "__file__", None)
        hashes["robot"] = _hash(mjcf + (Path(source).read_bytes() if source else b""))
    return hashes


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
