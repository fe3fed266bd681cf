"""What has become of modules of earlier versions: importing one says where its content is now."""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

_CONTROLLER = (
    "command", "control_loop", "controller", "observation", "params", "planning", "reference",
    "resolve", "rigid_body", "state", "walkable",
)  # fmt: skip
MOVED = {
    "kjax.srb": "kjax.dynamics.srb_planar",
    **{f"kjax.{name}": f"kjax.controllers.{name}" for name in _CONTROLLER},
    **{
        f"kjax.koopman.{name}": f"kjax.prediction.{name}"
        for name in ("families", "features", "learned", "storage")
    },
    "kjax.koopman.prediction": "kjax.prediction.build",
    "kjax.koopman.validate": "kjax.prediction.evaluation",
    **{
        f"kjax.koopman.{name}": f"kjax.sysid.{name}"
        for name in ("open_loop", "transitions", "whole_body")
    },
    "kjax.episodes": "kjax.runs.pool",
    "kjax.batches": "kjax.runs.batches",
    "kjax.sweep": "kjax.runs.sweeps",
    "kjax.sim.bisection": "kjax.runs.bisection",
    "kjax.sim.batch_loop": "kjax.sim.engines.mujoco_batch",
    "kjax.sim.mjx_loop": "kjax.sim.engines.mjx",
    "kjax.sim.mujoco_loop": "kjax.sim.engines.mujoco",
    "kjax.sim.walk": "kjax.sim.closed_loop",
}


class MovedFinder:
    """Asked for a module that no other finder has found."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Raise an ImportError that names the new module of an old one."""
        if name in MOVED:
            raise ImportError(f"{name} has moved: import {MOVED[name]}", name=name)
        return None


def install_moved_finder() -> None:
    """Let imports of old modules fail with the new name."""
    if MovedFinder not in sys.meta_path:
        sys.meta_path.append(MovedFinder)
