"""What has become of modules and names of earlier versions: importing one gives the new one."""

import sys
from collections.abc import Callable, Sequence
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
    "kjax.sim.push": "kjax.sim.resolve",
}

_GAIT = "kjax.config.gaits.LIBRARY['{}']: gaits are data, their phases gait.phases(...)"
# Module -> old name -> what to use now.
NAMES = {
    "kjax.cli": {
        "build_parser": "a dataclass of kjax.options.RunOptions and parse_config",
        "script_parser": "a dataclass of kjax.options.Options and parse",
        "parse_study": "a dataclass of kjax.options.StudyOptions and parse",
        "parse": "kjax.options.parse_config",
        "require": "kjax.options.require",
    },
    "kjax.viz.report": {"write_page": "kjax.viz.page.write_page"},
    "kjax": {"build_params": "resolve(config, robot), then condense(spec, params)"},
    "kjax.config": {"BoundConfig": "GaitConfig, and config.gaits.LIBRARY['bound']: gaits are data"},
    "kjax.gait": {name: _GAIT.format(name) for name in ("trot", "bound", "stand")},
    "kjax.koopman.observables": {"own": "custom_dictionary"},
    "kjax.koopman.dataset": {"ranges_from_config": "sample_ranges(DatasetSpec(...))"},
    "kjax.sim.episode": {
        **dict.fromkeys(("Trajectory", "sagittal"), "kjax.sim.trajectory"),
        **dict.fromkeys(
            ("metrics", "metric_names", "foot_slip", "reference_height", "SETTLE_TIME"),
            "kjax.sim.metrics",
        ),
        **dict.fromkeys(("FALL_HEIGHT", "FALL_TILT"), "kjax.sim.closed_loop"),
    },
    "kjax.sim.resolve": {
        "push_at": "kjax.sim.episode.push_at",
        "stack_episodes": "kjax.sim.episode.stack_params(episodes)",
        "stack_tables": "kjax.sim.batching.stack_tables(episodes, dtype)",
    },
    "kjax.sim.scene": {"apply_scene": "apply_world(robot, model, resolve_world(config))"},
    "kjax.sim.excitation": dict.fromkeys(("force_noise", "force_deviation"), "kjax.sim.noise"),
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


def moved_names(module: str) -> Callable[[str], object]:
    """``__getattr__`` of a module: an ImportError with the new name of an old one."""

    def find(name: str) -> object:
        new = NAMES[module].get(name)
        if new is None:
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        raise ImportError(f"{module}.{name} has gone: use {new}", name=module)

    return find
