"""kjax: Koopman-operator linear MPC for legged robots, in JAX.

    from kjax import RunConfig, build_controller, condense, load_config, resolve
    from kjax.robots import get_robot

The core imports jax, numpy and pydantic only; ``kjax.sim`` needs the extra ``sim`` (MuJoCo),
``kjax.viz`` the extra ``viz`` (matplotlib).
"""

from kjax.config import ConfigError, RunConfig, load_config
from kjax.controllers.control_loop import ControlLoop
from kjax.controllers.controller import Controller, build_controller
from kjax.controllers.observation import check_observation
from kjax.controllers.params import ControllerParams, Tables, condense
from kjax.controllers.resolve import resolve
from kjax.moved import install_moved_finder, moved_names
from kjax.spec import ControllerSpec
from kjax.types import Command, JointCommand, Leg, Mode, Observation

__version__ = "0.2.0"

install_moved_finder()

__getattr__ = moved_names(__name__)


__all__ = [
    "Command",
    "ConfigError",
    "ControlLoop",
    "Controller",
    "ControllerParams",
    "ControllerSpec",
    "JointCommand",
    "Leg",
    "Mode",
    "Observation",
    "RunConfig",
    "Tables",
    "build_controller",
    "check_observation",
    "condense",
    "load_config",
    "resolve",
]
