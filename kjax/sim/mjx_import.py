"""MuJoCo's MJX without two of its notes that tell a user of kjax nothing.

kjax uses the JAX implementation of MJX. ``mujoco.mjx`` prints to stdout that it found no Warp;
whatever else it prints, other reasons of a failed import included, comes through. In float32 beside
JAX's float64 its sensors make JAX warn of a cast that is meant.
"""

import contextlib
import io
import sys
import warnings
from typing import Any

# What mujoco.mjx.warp prints where the package is absent, and nothing else.
_ABSENT = frozenset(
    f"Failed to import {name}: No module named 'warp'" for name in ("warp", "mujoco_warp")
)


def pass_on(text: str) -> str:
    """The text without the lines that say that Warp is not installed."""
    return "".join(line for line in text.splitlines(True) if line.rstrip("\n") not in _ABSENT)


said = io.StringIO()
try:
    with contextlib.redirect_stdout(said):
        from mujoco import mjx
finally:
    sys.stdout.write(pass_on(said.getvalue()))


def mjx_step(model: Any, data: Any) -> Any:
    """``mjx.step``."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "scatter inputs have incompatible types", FutureWarning)
        return mjx.step(model, data)


__all__ = ["mjx", "mjx_step"]
