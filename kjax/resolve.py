"""From a config to what a controller is made of: its spec (static) and its parameters (data)."""

from math import inf
from typing import Any

from kjax.config import RunConfig
from kjax.koopman.prediction import model_spec
from kjax.params import ControllerParams, build_params
from kjax.spec import ControllerSpec, CycleSpec
from kjax.types import RobotParams
from kjax.walkable import build_gaits, cycle_nodes


def resolve(
    config: RunConfig, robot: RobotParams, *, dtype: Any = None
) -> tuple[ControllerSpec, ControllerParams]:
    """Spec and parameters of a controller.

    Args:
      config: of the run.
      robot: e.g. ``kjax.robots.go1.PARAMS``.
      dtype: floating type of the parameters; JAX's current default if ``None``.

    Returns:
      What ``build_controller`` takes, and what the controller's functions take.

    Raises:
      ValueError: for a config that this robot cannot walk with, naming the key.
    """
    return controller_spec(config), build_params(config, robot, dtype=dtype)


def controller_spec(config: RunConfig) -> ControllerSpec:
    """The static choices of a config.

    Raises:
      ConfigError: for a file of a model that cannot be used.
    """
    lmpc, chosen = config.lmpc, config.multiphase
    gaits = build_gaits(config)
    nodes = int(cycle_nodes(gaits, config).sum(axis=1).max())
    cycle = CycleSpec(nodes=nodes, tolerance=chosen.tolerance, max_iterations=chosen.max_iterations)
    return ControllerSpec(
        base=config.sim.base,
        act_dt=config.leg.act_dt,
        control_dt=lmpc.control_dt,
        model_dt=lmpc.model_dt,
        horizon=lmpc.horizon,
        model=model_spec(config.koopman),
        cautious=lmpc.caution > 0,
        friction_rows=lmpc.friction < inf,
        torque_rows=lmpc.torque_fraction < inf,
        solver=lmpc.solver,
        warm_start=lmpc.warm_start,
        tolerance=lmpc.tolerance,
        max_iterations=lmpc.max_iterations,
        cycle=cycle if nodes else None,
        gaits=tuple((len(one.phases), one.ramp_cycles) for one in gaits),
    )
